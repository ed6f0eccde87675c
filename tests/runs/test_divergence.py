"""When a run is stopped because learning has gone astray, and what it leaves to look at."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from sqn_jax.agent.learner import LearnerState
from sqn_jax.config import TrainConfig
from sqn_jax.runs.divergence import DUMP, Diverged, raise_if_diverged
from sqn_jax.storage.run_folder import RunFolder

CONFIG = TrainConfig(seed=4, max_skipped_updates=3)


def learner(*numbers: float) -> LearnerState:
    return LearnerState(
        params={"a": {"kernel": jnp.ones((2, 2))}, "b": jnp.array(numbers)},
        target_params=None,
        opt_state={"mu": jnp.zeros(3)},
        memory=None,
        round=jnp.int32(7),
        num_updates=jnp.int32(10),
        num_skipped=jnp.int32(0),
    )


def row(skipped: Any, finite: Any) -> dict[str, Any]:
    return {
        **{"chunk": 7, "episodes": 70, "updates": 10},
        **{"skipped_updates": skipped, "finite": finite},
    }


def test_a_few_skipped_updates_are_let_pass(tmp_path: Path) -> None:
    raise_if_diverged(row(3, True), learner(1.0), CONFIG, RunFolder(tmp_path))
    seeds = dataclasses.replace(CONFIG, num_seeds=2)
    raise_if_diverged(row([0, 3], [True, True]), learner(1.0), seeds, RunFolder(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_too_many_are_not(tmp_path: Path) -> None:
    with pytest.raises(Diverged, match=r"chunk 7, seed 4: 4 of 10 updates .* \(3\)"):
        raise_if_diverged(row(4, True), learner(1.0), CONFIG, RunFolder(tmp_path))


def test_parameters_that_are_no_numbers_are_named_with_the_worst_first(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    for chunk in range(1, 30):
        folder.append_metrics({"chunk": chunk})
    found = learner(-5.0, np.nan, np.inf)
    with pytest.raises(Diverged, match=r"seed 4: parameters are no longer finite; .*"):
        raise_if_diverged(row(0, False), found, CONFIG, folder)
    told = json.loads((tmp_path / DUMP).read_text())
    assert list(told["arrays"]) == ["params/b", "params/a/kernel", "opt_state/mu"]
    assert told["arrays"]["params/b"] == {"largest": 5.0, "not_finite": 2, "of": 3}
    assert [each["chunk"] for each in told["last_rows"]] == list(range(10, 30))
    assert told["chunk"] == 7


def test_of_several_seeds_the_lost_ones_are_named(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, num_seeds=3)
    state = learner(1.0)
    several = dataclasses.replace(
        state,
        params={"b": jnp.array([[1.0], [2.0], [np.nan]])},
        opt_state={"mu": jnp.zeros((3, 1))},
    )
    with pytest.raises(Diverged, match="seed 6: parameters are no longer finite"):
        raise_if_diverged(row([0, 0, 0], [True, True, False]), several, config, RunFolder(tmp_path))
    told = json.loads((tmp_path / DUMP).read_text())
    assert told["seeds"] == [6]
    assert told["arrays"]["params/b"] == {"largest": 0.0, "not_finite": 1, "of": 1}
