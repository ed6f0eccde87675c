"""States of a small run, and a folder with two of its checkpoints."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from compiling import compiling_quickly
from rooms import small_room
from saved_runs import LENGTH, config_for, opened

from sqn_jax.env import EnvParams
from sqn_jax.training import loop
from sqn_jax.training.state import RunnerState


@pytest.fixture(scope="session")
def world() -> EnvParams:
    return small_room(LENGTH)


@pytest.fixture(scope="session")
def states(world: EnvParams) -> list[RunnerState]:
    """Three states of one run in which every number differs from one to the next."""
    with compiling_quickly():
        start = loop.start_run(loop.make_program(world, config_for()))

    def moved(by: int) -> RunnerState:
        def shift(x: Any) -> Any:
            if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
                return jax.random.key(by)
            return ~x if x.dtype == bool and by % 2 else x + jnp.asarray(by, x.dtype)

        return jax.tree.map(shift, start)

    return [moved(by) for by in range(3)]


@pytest.fixture(scope="session")
def shapes(world: EnvParams) -> RunnerState:
    return loop.runner_shapes(loop.make_program(world, config_for()))


@pytest.fixture(scope="session")
def saved(tmp_path_factory: pytest.TempPathFactory, states: list[RunnerState]) -> Path:
    """A run folder with checkpoints after chunks 1 and 2; to be copied, not changed."""
    path = tmp_path_factory.mktemp("saved")
    with opened(path) as checkpoints:
        for chunk in (1, 2):
            checkpoints.save(chunk, states[chunk], score=0.5)
    return path


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    """A copy to do damage to."""
    shutil.copytree(saved, tmp_path / "run")
    return tmp_path / "run"
