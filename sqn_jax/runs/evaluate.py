"""An evaluation with a progress bar, written to a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sqn_jax.evaluation.agents import Agent
from sqn_jax.evaluation.compare import OnEvaluated, evaluate_agents, load_maps, num_episodes
from sqn_jax.evaluation.settings import Settings
from sqn_jax.runs.progress import episodes_bar
from sqn_jax.storage.compile_cache import cached_programs
from sqn_jax.storage.files import write_json, write_records


@cached_programs()
def evaluate_session(
    agents: Sequence[Agent],
    settings: Settings,
    out: Path | None = None,
    on_evaluated: OnEvaluated | None = None,
    fields: Sequence[str] = (),
) -> dict[str, Any]:
    """Evaluate agents with a progress bar.

    Args:
        agents: see `compare.evaluate_agents`.
        settings: see `compare.evaluate_agents`.
        out: the JSON file to write; the records of the episodes go beside it, as JSON lines.
        on_evaluated: see `compare.evaluate_agents`.
        fields: see `compare.evaluate_agents`.

    Returns:
        The contents of the evaluation file.

    Raises:
        ValueError: a map is unusable for a robot; nothing has been run.
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
