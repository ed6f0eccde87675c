"""Saving and loading the state of a run with Orbax.

A checkpoint holds the whole `RunnerState`: parameters, optimiser, replay, keys and the round. The
parameters of the policy stand apart, so that it can be loaded without the rest.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from jax.sharding import SingleDeviceSharding

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
        items = {name: ocp.args.StandardSave(item) for name, item in _split(runner).items()}
        self._manager.save(chunk, args=ocp.args.Composite(**items), force=True)
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
        return _join(self._restored(step, _split(runner_shapes)))

    def restore_policy(self, params_shapes: Params, *, averaged: bool) -> Params:
        """Load only the parameters to evaluate, from the newest checkpoint.

        Args:
            params_shapes: the parameters as arrays or structs.
            averaged: whether the run's policy is the average of its parameters, see
                `train.averages`.

        Raises:
            ValueError: there is no checkpoint.
        """
        step = self._require_step()
        name = "target_params" if averaged else "params"
        return self._restored(step, {name: params_shapes})[name]

    def _restored(self, step: int, shapes: dict[str, Any]) -> Any:
        """Items of the given shapes; on the first device where these do not name any.

        Wherever the arrays lay when they were saved: a run on two devices goes on on one.
        """
        items = {name: ocp.args.StandardRestore(_placed(item)) for name, item in shapes.items()}
        try:
            return self._manager.restore(step, args=ocp.args.Composite(**items))
        except Exception as error:  # Orbax raises bare exceptions, too.
            place = self._manager.directory / str(step)
            told = " ".join(str(error).split())[:200]
            raise ValueError(
                f"checkpoint {place}: damaged, or of another network than the run's config.json "
                f"says ({type(error).__name__}: {told})"
            ) from None

    def _require_step(self) -> int:
        step = self._manager.latest_step()
        if step is None:
            raise ValueError(f"{self._manager.directory}: holds no checkpoint")
        return step


def _split(runner: RunnerState) -> dict[str, Any]:
    """Parameters, their slow copy, and all else as plain trees; keys as their raw numbers."""
    rest = {
        "opt_state": runner.learner.opt_state,
        "num_updates": runner.learner.num_updates,
        "memory": runner.memory,
        "key": _key_data(runner.key),
        "round": runner.round,
    }
    items = {
        "params": runner.learner.params,
        "target_params": runner.learner.target_params,
        "rest": {name: value for name, value in rest.items() if value is not None},
    }
    return {name: item for name, item in items.items() if item is not None}


def _placed(shapes: Any) -> Any:
    first = SingleDeviceSharding(jax.devices()[0])
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(
            x.shape, x.dtype, sharding=getattr(x, "sharding", None) or first
        ),
        shapes,
    )


def _key_data(key: Any) -> Any:
    if isinstance(key, jax.ShapeDtypeStruct):
        return jax.eval_shape(jax.random.key_data, key)
    return jax.random.key_data(key)


def _join(items: Any) -> RunnerState:
    rest = items["rest"]
    learner = LearnerState(
        params=items["params"],
        target_params=items["target_params"] if "target_params" in items.keys() else None,  # noqa: SIM118
        opt_state=rest["opt_state"],
        num_updates=rest["num_updates"],
    )
    return RunnerState(
        learner=learner,
        memory=rest.get("memory"),
        key=jax.random.wrap_key_data(rest["key"]),
        round=rest["round"],
    )
