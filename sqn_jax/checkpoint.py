"""Saving and loading the state of a run with Orbax.

A checkpoint holds the whole `RunnerState`: parameters, optimiser, replay, keys and the round. The
parameters stand apart, so that a policy can be loaded without the rest.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from sqn_jax.agent.learner import LearnerState
from sqn_jax.agent.networks import Params
from sqn_jax.train import RunnerState

FOLDER = "checkpoints"
KEPT = 2

# Orbax reports every file it touches; a user wants to see the progress of the training.
logging.getLogger("absl").setLevel(logging.ERROR)


class Checkpoints:
    """The checkpoints of one run folder; use as a context manager."""

    def __init__(self, run_dir: Path) -> None:
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEPT, create=True, enable_async_checkpointing=False
        )
        self._manager = ocp.CheckpointManager((run_dir / FOLDER).absolute(), options=options)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self._manager.close()

    def save(self, chunk: int, runner: RunnerState) -> None:
        """Write the state after `chunk` chunks; done when this returns."""
        params, rest = _split(runner)
        self._manager.save(
            chunk,
            args=ocp.args.Composite(
                params=ocp.args.StandardSave(params), rest=ocp.args.StandardSave(rest)
            ),
            force=True,
        )
        self._manager.wait_until_finished()

    def latest(self) -> int | None:
        """Chunks done at the newest checkpoint; None if there is none."""
        return self._manager.latest_step()

    def restore(self, runner_shapes: RunnerState) -> RunnerState:
        """Load the newest checkpoint into a state of the given shapes (arrays or structs).

        Raises:
            ValueError: there is no checkpoint.
        """
        step = self._require_step()
        params, rest = _split(runner_shapes)
        loaded = self._manager.restore(
            step,
            args=ocp.args.Composite(
                params=ocp.args.StandardRestore(params), rest=ocp.args.StandardRestore(rest)
            ),
        )
        return _join(loaded["params"], loaded["rest"])

    def restore_params(self, params_shapes: Params) -> Params:
        """Load only the parameters of the newest checkpoint.

        Raises:
            ValueError: there is no checkpoint.
        """
        step = self._require_step()
        args = ocp.args.Composite(params=ocp.args.StandardRestore(params_shapes))
        return self._manager.restore(step, args=args)["params"]

    def _require_step(self) -> int:
        step = self._manager.latest_step()
        if step is None:
            raise ValueError(f"{self._manager.directory}: holds no checkpoint")
        return step


def _split(runner: RunnerState) -> tuple[Params, Any]:
    """Parameters, and all else as a plain tree; keys as their raw numbers."""
    rest = {
        "target_params": runner.learner.target_params,
        "opt_state": runner.learner.opt_state,
        "num_updates": runner.learner.num_updates,
        "memory": runner.memory,
        "key": _key_data(runner.key),
        "round": runner.round,
    }
    return runner.learner.params, {name: value for name, value in rest.items() if value is not None}


def _key_data(key: Any) -> Any:
    if isinstance(key, jax.ShapeDtypeStruct):
        return jax.eval_shape(jax.random.key_data, key)
    return jax.random.key_data(key)


def _join(params: Params, rest: dict[str, Any]) -> RunnerState:
    learner = LearnerState(
        params=params,
        target_params=rest.get("target_params"),
        opt_state=rest["opt_state"],
        num_updates=rest["num_updates"],
    )
    return RunnerState(
        learner=learner,
        memory=rest.get("memory"),
        key=jax.random.wrap_key_data(rest["key"]),
        round=rest["round"],
    )
