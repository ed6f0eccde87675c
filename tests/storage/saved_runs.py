"""The small run whose checkpoints are tested."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sqn_jax.config import NetworkConfig, ReplayConfig, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.storage.checkpoint import Checkpoints
from sqn_jax.storage.manifest import Origin
from sqn_jax.training.state import RunnerState

LENGTH = 6


def config_for(method: Any = "r2d2", **changes: Any) -> TrainConfig:
    return dataclasses.replace(
        PRESETS["smoke"],
        method=method,
        task_sampling="learnability",
        num_envs=4,
        total_episodes=16,
        network=NetworkConfig(hidden_size=8, layer_norm=True),
        replay=ReplayConfig(capacity=8, min_episodes=8),
        learner=dataclasses.replace(PRESETS["smoke"].learner, batch_size=4, window_length=LENGTH),
        **changes,
    )


def opened(path: Path, config: TrainConfig | None = None, **known: Any) -> Checkpoints:
    return Checkpoints(path, Origin(config or config_for(), **known))


def without_replay(runner: RunnerState) -> RunnerState:
    return dataclasses.replace(runner, learner=dataclasses.replace(runner.learner, memory=None))


def assert_same(one: Any, other: Any) -> None:
    for ours, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jax.dtypes.issubdtype(ours.dtype, jax.dtypes.prng_key):
            ours, theirs = jax.random.key_data(ours), jax.random.key_data(theirs)
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
