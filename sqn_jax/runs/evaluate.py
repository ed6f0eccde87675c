"""An evaluation as a person starts it: under a progress bar, written to a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sqn_jax.evaluation.compare import (
    Agent,
    OnEvaluated,
    Settings,
    evaluate_agents,
    load_maps,
    num_episodes,
)
from sqn_jax.runs.progress import episodes_bar
from sqn_jax.storage.compile_cache import cached_programs
from sqn_jax.storage.files import write_json, write_records


@cached_programs()
def evaluate_session(
    agents: Sequence[Agent],
    settings: Settings,
    out: Path | None = None,
    on_evaluated: OnEvaluated = lambda batch: None,
    fields: Sequence[str] = (),
) -> dict[str, Any]:
    """Evaluate agents under a progress bar.

    Args:
        agents: who acts; see `compare.evaluate_agents`.
        settings: where and how often.
        out: where to write the evaluation, a JSON file, and beside it one record an episode.
        on_evaluated: see `compare.evaluate_agents`.
        fields: see `compare.evaluate_agents`.

    Returns:
        The evaluation as written.

    Raises:
        ValueError: a map is unusable for a robot; nothing was run then.
    """
    maps = load_maps(agents, settings)
    with episodes_bar(num_episodes(agents, settings)) as bar:
        evaluation, records = evaluate_agents(
            agents, maps, settings, bar.update, on_evaluated, fields
        )
    if out is not None:
        write_json(out, evaluation)
        write_records(out.with_suffix(".jsonl"), records)
    return evaluation
