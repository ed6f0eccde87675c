"""Divergence: the check after every chunk, and the dump of a run that has diverged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sqn_jax.agent.learner import LearnerState
from sqn_jax.config import TrainConfig
from sqn_jax.storage.manifest import leaves_of
from sqn_jax.storage.run_folder import RunFolder
from sqn_jax.training import devices, processes

DUMP = "divergence.json"
SHOWN_ROWS = 20


class Diverged(FloatingPointError):
    """A run was stopped because it has diverged."""


def raise_if_diverged(
    row: Mapping[str, Any], learner: LearnerState, config: TrainConfig, folder: RunFolder
) -> None:
    """Stop a run that has diverged, before this chunk is saved; called in all its processes.

    Single updates with a loss or gradient that is not finite have been skipped already.

    Args:
        row: the row of this chunk in metrics.jsonl.
        learner: the learner state after the chunk.
        config: the config of the run.
        folder: the run folder, to which the dump is written.

    Raises:
        Diverged: more updates were skipped than the config allows, or parameters or moments of
            the optimizer are not finite.
    """
    skipped, finite = np.atleast_1d(row["skipped_updates"]), np.atleast_1d(row["finite"])
    has_diverged = (skipped > config.max_skipped_updates) | ~finite
    if not has_diverged.any():
        return
    index = int(np.argmax(has_diverged))
    seed = config.seed + index
    if finite[index]:
        reason = (
            f"{skipped[index]:,} of {row['updates']:,} updates had a loss or gradient that is not "
            f"finite, more than max_skipped_updates ({config.max_skipped_updates})"
        )
    else:
        reason = "parameters are no longer finite"
    arrays = _arrays(learner, index if config.num_seeds > 1 else None)
    if processes.is_first():
        folder.write_json(
            DUMP,
            {
                "chunk": row["chunk"],
                "episodes": row["episodes"],
                "seeds": [config.seed + int(index) for index in np.flatnonzero(has_diverged)],
                "why": reason,
                "learning_rate": config.learner.learning_rate,
                "arrays": arrays,
                "last_rows": folder.read_metrics()[-SHOWN_ROWS:],
            },
        )
    raise Diverged(
        f"stopped at chunk {row['chunk']}, seed {seed}: {reason}; {folder.path / DUMP} says where. "
        "What was saved before is finite"
    )


def _arrays(learner: LearnerState, index: int | None) -> dict[str, dict[str, Any]]:
    """The largest value of each array and how many are not finite; the worst arrays first."""
    arrays = {}
    parts = {"params": learner.params, "opt_state": learner.opt_state}
    for path, leaf in leaves_of(parts):
        whole = devices.on_host(leaf)
        values = np.asarray(whole if index is None else whole[index], dtype=np.float64)
        is_finite = np.isfinite(values)
        arrays[path] = {
            "largest": float(np.abs(values[is_finite]).max(initial=0.0)),
            "not_finite": int((~is_finite).sum()),
            "of": int(values.size),
        }
    worst = sorted(arrays, key=lambda path: (-arrays[path]["not_finite"], -arrays[path]["largest"]))
    return {path: arrays[path] for path in worst}
