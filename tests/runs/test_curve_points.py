"""When a run is evaluated while it trains, and what it came to then."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from sqn_jax.agent.learner import LearnerState
from sqn_jax.config import EvalConfig, LearnerConfig, TrainConfig
from sqn_jax.runs.learning_curve import (
    LearningCurve,
    curve_keys,
    is_point,
    stacked_params,
    summary_of,
)

CONFIG = TrainConfig(total_episodes=500, num_envs=50)


@pytest.mark.parametrize(
    ("points", "chunks", "expected"),
    [
        (5, 10, [2, 4, 6, 8, 10]),
        (3, 7, [3, 5, 7]),
        (1, 4, [4]),
        (20, 3, [1, 2, 3]),
        (0, 5, []),
    ],
)
def test_points_lie_evenly_over_the_run_and_the_last_at_its_end(
    points: int, chunks: int, expected: list[int]
) -> None:
    config = TrainConfig(
        total_episodes=50 * chunks, num_envs=50, eval=EvalConfig(curve_points=points)
    )
    assert [chunk for chunk in range(1, chunks + 1) if is_point(chunk, config)] == expected


@pytest.mark.parametrize("num_seeds", [1, 3])
def test_between_the_points_each_seed_has_a_gap(num_seeds: int) -> None:
    config = dataclasses.replace(CONFIG, num_seeds=num_seeds, eval=EvalConfig(curve_points=1))
    curve: Any = LearningCurve(map, config)  # type: ignore[arg-type]
    for value in curve.point(1, None).values():
        assert np.shape(value) == (() if num_seeds == 1 else (num_seeds,))
        assert np.isnan(value).all()


def test_the_tasks_do_not_depend_on_the_training_seed_and_are_no_others() -> None:
    def numbers(**changes: Any) -> Any:
        return curve_keys(dataclasses.replace(CONFIG, **changes))

    same = [numbers(), numbers(seed=7), numbers(num_seeds=2), numbers(total_episodes=800)]
    assert all((keys == same[0]).all() for keys in same)
    assert len(same[0]) == 100
    assert not (numbers(eval=EvalConfig(seed=1_001)) == same[0]).any()


def learner(shape: tuple[int, ...]) -> Any:
    latest, average = jnp.ones(shape), jnp.full(shape, 2.0)
    return LearnerState(*({"w": latest}, {"w": average}), *[None] * 5)  # type: ignore[arg-type]


def test_evaluated_is_what_is_shipped_with_an_axis_of_seeds() -> None:
    (latest,) = stacked_params(learner((4, 2)), CONFIG).values()
    np.testing.assert_array_equal(latest, np.ones((1, 4, 2)))
    averaging = TrainConfig(
        method="pqn", num_envs=64, num_seeds=3, learner=LearnerConfig(average_share=0.1)
    )
    (average,) = stacked_params(learner((3, 4)), averaging).values()
    np.testing.assert_array_equal(average, np.full((3, 4), 2.0))
    assert isinstance(average, np.ndarray), "on the host: the next chunk takes the state"


def test_the_summary_has_the_last_point_beside_the_paper() -> None:
    def row(reward: Any) -> dict[str, Any]:
        return {"eval_mean_reward": reward, "eval_success": 0.5, "eval_time_steps": 90.0}

    rows: list[dict[str, Any]] = [{}, row(0.5), row(None), row(1.25), row(math.nan)]
    assert summary_of(rows, CONFIG) == {
        **{"points": 2, "episodes_per_point": 100, "paper_mean_reward": 1.35},
        **{"mean_reward": 1.25, "success": 0.5, "time_steps": 90.0},
    }
    seeds = summary_of([row([1.0, 2.0]), row([None, None])], CONFIG)
    assert seeds is not None
    assert seeds["mean_reward"] == [1.0, 2.0]
    assert summary_of([{}, row(None)], CONFIG) is None
    elsewhere = summary_of(rows, dataclasses.replace(CONFIG, map="cave"))
    assert elsewhere is not None
    assert elsewhere["paper_mean_reward"] is None
