"""Scores worked out by hand from a few made-up episodes."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from sqn_jax.evaluation.agents import EpisodeBatch
from sqn_jax.evaluation.scores import (
    describe,
    improvement,
    markdown_table,
    records,
    results_table,
    table_note,
)
from sqn_jax.training.rollout import EpisodeMetrics

RADIUS = 0.3
POINTS = np.array([[0.0, 0.0], [1.0, 1.0], [9.0, 0.0]])
WORLD: Any = SimpleNamespace(
    tasks="evaluation points",
    occupancy_map=SimpleNamespace(evaluation_points=POINTS, spawn_points=POINTS[:2]),
)


def batch(
    training_seed: int | None,
    eval_seed: int,
    success: list[bool],
    starts: Any = None,
    **changes: Any,
) -> EpisodeBatch:
    count = len(success)
    reached = np.array(success)
    fields = {
        "success": reached,
        "time_steps": np.where(reached, 10 * (1 + np.arange(count)), 400),
        "mean_reward": np.arange(count) / 4,
        "collisions": np.arange(count),
        "covered_area": np.full(count, 7.0),
        "path_length": np.full(count, 8.0),
        **changes,
    }
    return EpisodeBatch(
        agent=cast(Any, None),
        world=WORLD,
        training_seed=training_seed,
        eval_seed=eval_seed,
        metrics={RADIUS: EpisodeMetrics(**fields)},
        starts=np.zeros((count, 3)) if starts is None else starts,
        goals=np.ones((count, 2)),
        shortest_paths=np.full(count, 6.0),
    )


def test_failures_count_at_the_limit_and_are_left_out_of_the_successes() -> None:
    metrics = describe([batch(0, 1000, [True, False, True, True])], RADIUS)
    assert metrics["success"]["mean"] == 0.75
    assert metrics["time_steps"]["mean"] == (10 + 400 + 30 + 40) / 4
    assert metrics["time_steps_success"]["mean"] == (10 + 30 + 40) / 3
    assert metrics["spl"]["mean"] == pytest.approx(3 / 4 * 6 / 8)
    assert metrics["collisions"]["mean"] == 1.5
    assert metrics["coverage_m2"]["mean"] == 7.0
    assert metrics["success_per_seed"] == [0.75]
    assert "iqm" not in metrics["success"], "one training seed has no spread over training seeds"


def test_steps_over_the_oracle_s_are_those_of_tasks_in_which_both_arrive() -> None:
    """Evaluation seeds are told apart, training seeds meet the same oracle."""
    ours = [
        batch(0, 1000, [True, False, True, True]),
        batch(1, 1000, [True, True, False, False]),
        batch(0, 1001, [True, True, False, False]),
    ]
    oracle = [
        batch(None, 1001, [True, False, True, True], time_steps=np.array([8, 400, 9, 9])),
        batch(None, 1000, [True, True, True, True], time_steps=np.array([5, 10, 20, 40])),
    ]
    metrics = describe(ours, RADIUS, oracle)["steps_over_oracle"]
    expected = [10 / 5, 30 / 20, 40 / 40, 10 / 5, 20 / 10, 10 / 8]
    assert metrics["mean"] == pytest.approx(np.mean(expected))
    assert metrics["std"] == pytest.approx(np.std(expected, ddof=1))
    assert describe(ours, RADIUS)["steps_over_oracle"] is None
    nowhere = batch(0, 1000, [False] * 4)
    assert describe([nowhere], RADIUS, oracle)["steps_over_oracle"] is None


def test_the_paper_s_spread_is_that_of_the_means_of_the_evaluation_seeds() -> None:
    metrics = describe(
        [batch(0, 1000, [True, True, True, True]), batch(0, 1001, [True, False, False, True])],
        RADIUS,
    )
    assert metrics["success"]["mean"] == 0.75
    # Means 1 and 0.5; six successes in eight episodes. Divided by n - 1.
    assert metrics["success"]["std_of_means"] == pytest.approx(np.sqrt(2 * 0.25**2 / 1))
    assert metrics["success"]["std"] == pytest.approx(np.sqrt(8 * 0.75 * 0.25 / 7))


def test_a_single_seed_has_no_spread() -> None:
    metrics = describe([batch(0, 1000, [True, False])], RADIUS)
    assert metrics["success"]["std_of_means"] is None
    assert metrics["success"]["std"] == pytest.approx(np.sqrt(0.5))
    alone = describe([batch(0, 1000, [True])], RADIUS)
    assert alone["time_steps"]["std"] is None
    assert alone["time_steps_success"]["std"] is None


def test_training_seeds_are_summed_up_by_their_interquartile_mean() -> None:
    rates = ([True, True], [True, False], [False, False], [True, True])
    metrics = describe([batch(seed, 1000, rate) for seed, rate in enumerate(rates)], RADIUS)
    assert metrics["success_per_seed"] == [1.0, 0.5, 0.0, 1.0]
    assert metrics["success"]["iqm"] == pytest.approx((0.5 + 1.0) / 2)
    low, high = metrics["success"]["iqm_ci95"]
    assert 0 <= low < 0.75 < high <= 1


def test_episodes_of_one_training_are_no_independent_evidence() -> None:
    """One training always arrives, the other never: anything from 0 to 1 may come of a third."""
    metrics = describe([batch(0, 1000, [True] * 50), batch(1, 1000, [False] * 50)], RADIUS)
    assert metrics["success"]["mean"] == 0.5
    assert metrics["success"]["ci95"] == [0.0, 1.0]
    assert metrics["ci95_over"] == "training seeds and tasks"


def test_episodes_between_the_same_points_are_no_independent_evidence() -> None:
    """From one point a robot always arrives, from the other never."""
    starts = np.zeros((50, 3))
    starts[25:, 0] = 8.6
    success = [True] * 25 + [False] * 25
    one = batch(0, 1000, success, starts)
    np.testing.assert_array_equal(one.routes, [1] * 25 + [7] * 25)  # Points 0 to 1, and 2 to 1.
    metrics = describe([one, batch(0, 1001, success, starts)], RADIUS)
    assert metrics["success"]["ci95"] == [0.0, 1.0]
    assert metrics["ci95_over"] == "tasks"
    pairs = dataclasses.replace(one, world=SimpleNamespace(**vars(WORLD) | {"tasks": "pairs"}))
    assert pairs.routes.max() == 3, "by the two points that training starts from"
    # On a single route tasks are drawn alone: near the normal approximation.
    (low, high) = describe([batch(0, 1000, success)], RADIUS)["success"]["ci95"]
    assert low == pytest.approx(0.5 - 1.96 * np.sqrt(0.25 / 50), abs=0.03)
    assert high == pytest.approx(0.5 + 1.96 * np.sqrt(0.25 / 50), abs=0.03)


def test_the_note_of_the_table_says_what_intervals_are_over() -> None:
    one, two = (
        {"training_seeds": seeds, "success": {"std_of_means": 0.1}} for seeds in ([0], [0, 1])
    )
    assert table_note([one, one]) == (
        "±: over the means of the evaluation seeds; "
        "95 % intervals (file): over tasks only, one training seed"
    )
    assert "evaluation seeds of each training seed; 95" in table_note([one, two])
    assert "over training seeds and tasks" in table_note([one, two])
    without = {"training_seeds": [0], "success": {"std_of_means": None}}
    assert "±" not in table_note([without])


def test_no_success_and_no_shortest_way_are_said_and_not_made_up() -> None:
    lost = batch(None, 1000, [False, False])
    blind = dataclasses.replace(lost, shortest_paths=None)
    metrics = describe([blind], RADIUS)
    assert metrics["time_steps_success"] is None
    assert metrics["spl"] is None


def test_improvement_needs_several_training_seeds_of_both() -> None:
    good = [[batch(seed, 1000, [True, True]) for seed in range(3)]]
    bad = [[batch(seed, 1000, [seed == 0, False]) for seed in range(3)]]
    comparison = improvement(good, bad, RADIUS)
    assert comparison["probability"] == 1.0
    assert improvement(bad, good, RADIUS)["probability"] == 0.0
    assert improvement(good, good, RADIUS)["probability"] == 0.5
    assert improvement(good, [[batch(None, 1000, [True, True])]], RADIUS) is None


def test_a_record_says_what_an_episode_was_and_came_to() -> None:
    rows = list(records([batch(3, 1001, [False, True])], RADIUS, map="maze", agent="sqn"))
    assert len(rows) == 2
    assert rows[1] == {
        "map": "maze",
        "agent": "sqn",
        "training_seed": 3,
        "eval_seed": 1001,
        "episode": 1,
        "start": [0.0, 0.0, 0.0],
        "goal": [1.0, 1.0],
        "success": True,
        "time_steps": 20,
        "collisions": 1,
        "mean_reward": 0.25,
        "coverage_m2": 7.0,
        "path_length_m": 8.0,
        "spl": 0.75,
    }


def test_a_markdown_table_is_one() -> None:
    table = markdown_table(["a", "long"], [["x", "1"], ["yyy", "22"]])
    assert table == "| a   | long |\n|-----|------|\n| x   | 1    |\n| yyy | 22   |"


def test_the_table_has_one_row_an_agent_and_world_and_a_column_a_radius() -> None:
    entries = []
    for noise in (0.0, 0.2):
        for radius, success in ((0.3, [True, False]), (0.5, [True, True])):
            entries.append(
                {
                    **{"map": "maze", "agent": "sqn", "tasks": "evaluation points"},
                    **{"velocity_noise": noise, "range_noise": 0.0, "goal_radius": radius},
                    **describe([batch(0, seed, success) for seed in (1000, 1001)], RADIUS),
                }
            )
    header, _, quiet, noisy = results_table(entries).splitlines()
    assert "success 0.3 m" in header
    assert "success 0.5 m" in header
    assert [cell.strip() for cell in quiet.split("|")[1:6]] == [
        "maze",
        "sqn",
        "none",
        "0.50 ± 0.00",
        "1.00",
    ]
    assert "velocity 0.2" in noisy
    alone = entries[0] | describe([batch(0, 1000, [True, False])], RADIUS)
    assert results_table([alone]).splitlines()[2].split("|")[4].strip() == "0.50"
