"""When learning has gone astray: what is checked after every chunk, and what is left to look at."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sqn_jax.agent.learner import LearnerState
from sqn_jax.config import TrainConfig
from sqn_jax.storage.manifest import leaves_of
from sqn_jax.storage.run_folder import RunFolder

DUMP = "divergence.json"
SHOWN_ROWS = 20


class Diverged(FloatingPointError):
    """A run was stopped since it no longer computes with numbers."""


def require_sound(
    row: Mapping[str, Any], learner: LearnerState, config: TrainConfig, folder: RunFolder
) -> None:
    """Stop a run that is lost: nothing of this chunk is to be saved.

    Single updates whose loss or gradient is not finite have been left out already.

    Args:
        row: of metrics.jsonl.
        learner: after the chunk.
        config: of the run.
        folder: where the dump goes.

    Raises:
        Diverged: more updates were skipped than the config allows, or parameters or the
            optimizer's moments are not finite.
    """
    skipped, finite = np.atleast_1d(row["skipped_updates"]), np.atleast_1d(row["finite"])
    lost = (skipped > config.max_skipped_updates) | ~finite
    if not lost.any():
        return
    index = int(np.argmax(lost))
    seed = config.seed + index
    if finite[index]:
        why = (
            f"{skipped[index]:,} of {row['updates']:,} updates had a loss or gradient that is not "
            f"finite, more than max_skipped_updates ({config.max_skipped_updates})"
        )
    else:
        why = "parameters are no longer finite"
    folder.write_json(
        DUMP,
        {
            "chunk": row["chunk"],
            "episodes": row["episodes"],
            "seeds": [config.seed + int(each) for each in np.flatnonzero(lost)],
            "why": why,
            "learning_rate": config.learner.learning_rate,
            "arrays": _arrays(learner, index if config.num_seeds > 1 else None),
            "last_rows": folder.read_metrics()[-SHOWN_ROWS:],
        },
    )
    raise Diverged(
        f"stopped at chunk {row['chunk']}, seed {seed}: {why}; {folder.path / DUMP} says where. "
        "What was saved before is finite"
    )


def _arrays(learner: LearnerState, index: int | None) -> dict[str, dict[str, Any]]:
    """Of every array of the learner, the largest number and how many are none; the worst first."""
    found = {}
    parts = {"params": learner.params, "opt_state": learner.opt_state}
    for path, leaf in leaves_of(parts):
        numbers = np.asarray(leaf if index is None else leaf[index], dtype=np.float64)
        is_finite = np.isfinite(numbers)
        found[path] = {
            "largest": float(np.abs(numbers[is_finite]).max(initial=0.0)),
            "not_finite": int((~is_finite).sum()),
            "of": int(numbers.size),
        }
    worst = sorted(found, key=lambda path: (-found[path]["not_finite"], -found[path]["largest"]))
    return {path: found[path] for path in worst}
