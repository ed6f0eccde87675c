"""Weights of skills by situation, against counts by hand."""

from __future__ import annotations

from typing import Any, cast

import jax
import numpy as np
import pytest
from rooms import random_params, small_room

from experiments.skills import (
    AS_IT_IS,
    information,
    mutual_information,
    over_seeds,
    variants,
    weights_by_situation,
    weights_over_time,
)
from sqn_jax.agent import QOutput, Trajectory, initial_carry, make_network
from sqn_jax.config import NetworkConfig, TrainConfig
from sqn_jax.env import NUM_ACTIONS, Observation
from sqn_jax.policies.pretrained import load_pretrained
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.state import network_of


def trajectory(steps: list[tuple[float, float, bool, float]]) -> Trajectory:
    """One robot, a row a step: distance to goal, newly seen area, refused, weight of skill 2."""
    distance, area, refused, second = (np.array(x)[:, None] for x in zip(*steps, strict=True))
    weights: Any = np.stack([1 - second, second], axis=-1)
    info = {"goal_distance": distance, "covered_area": area, "collision": refused.astype(bool)}
    return Trajectory(info=info, output=QOutput(weights, weights, weights))


def test_each_step_counts_where_it_belongs() -> None:
    found = weights_by_situation(
        trajectory(
            [
                (5.0, 1.0, False, 0.2),  # New ground,
                (5.0, 0.5, False, 0.4),  # and again.
                (5.0, 0.05, False, 0.9),  # Known ground.
                (5.0, 0.0, True, 0.7),  # Refused,
                (0.5, 0.0, True, 0.0),  # but not at the goal,
                (0.5, 1.0, False, 0.1),  # where new ground does not count, either.
                (0.9, 0.0, False, 0.2),
                (1.1, 0.0, False, 0.7),  # Known ground.
            ]
        )
    )
    expected = {
        "at the goal": (3 / 8, 0.1),
        "new ground": (2 / 8, 0.3),
        "known ground": (2 / 8, 0.8),
        "refused": (1 / 8, 0.7),
    }
    assert found.keys() == expected.keys()
    for name, (share, second) in expected.items():
        assert found[name]["share"] == pytest.approx(share)
        assert found[name]["weights"] == pytest.approx([1 - second, second])


def test_a_situation_that_never_came_is_not_told() -> None:
    assert list(weights_by_situation(trajectory([(5.0, 1.0, False, 0.5)]))) == ["new ground"]


def test_every_skill_is_tried_alone() -> None:
    names = list(variants(load_pretrained("sqn")))
    assert names == ["as it is", "skill 1 alone", "skill 2 alone", "exchanged"]


@pytest.mark.parametrize("gate", ["equal", "reachable"])
def test_every_skill_is_tried_alone_where_the_gate_was_not_learned(gate: Any) -> None:
    config = TrainConfig(network=NetworkConfig(hidden_size=8, gate=gate))
    network = make_network("sqn", config.network, NUM_ACTIONS, config.env)
    found = variants(Policy("made up", config, (random_params(network, small_room(9)),)))
    assert list(found) == ["as it is", "skill 1 alone", "skill 2 alone"]

    obs = Observation(
        ranges=jax.random.uniform(jax.random.key(1), (6, 2, 71)),
        goal=jax.random.uniform(jax.random.key(2), (6, 2, 2)),
    )

    def output(policy: Policy) -> QOutput:
        carry = initial_carry(config.network, 2)
        result: Any = network_of(policy.config).apply(policy.params[0], obs, carry)
        return cast(QOutput, result[1])

    for index in range(2):
        alone = output(found[f"skill {index + 1} alone"])
        expected = output(found["as it is"]).skill_q_values[:, :, index]
        np.testing.assert_allclose(alone.q_values, expected, rtol=1e-4, atol=1e-4)


def test_mutual_information_by_hand() -> None:
    coin = np.array([0, 1, 0, 1])
    assert mutual_information(coin, coin) == pytest.approx(1.0)
    assert mutual_information(coin, 1 - coin) == pytest.approx(1.0)
    assert mutual_information(coin, [0, 0, 1, 1]) == pytest.approx(0.0)
    assert mutual_information(coin, np.zeros(4, int)) == pytest.approx(0, abs=1e-12)
    # Joint 1/2, 1/4, 0, 1/4; marginals 3/4, 1/4 and 1/2, 1/2.
    expected = 0.5 * np.log2(0.5 / 0.375) + 0.25 * np.log2(0.25 / 0.375) + 0.25 * np.log2(2)
    assert mutual_information([0, 0, 0, 1], [0, 0, 1, 1]) == pytest.approx(expected)
    assert mutual_information([], []) == 0.0


def test_information_is_about_the_step_that_a_skill_saw_and_up_to_the_arrival() -> None:
    """Skill 2 has the weight right after each step in which the goal was reachable."""
    rng = np.random.default_rng(0)
    reachable = rng.random((40, 30)) < 0.5
    second = np.concatenate([rng.random((1, 30)) < 0.5, reachable[:-1]]).astype(float)
    second[20:] = rng.random((20, 30)) < 0.5  # After the arrival anything may be.
    near = rng.random((41, 30)) < 0.5
    weights: Any = np.stack([1 - second, second], axis=-1)
    info = {
        "reward_navigation": np.where(reachable, 0.1, 0.0),
        "goal_distance": np.full((40, 30), 5.0),
        "covered_area": np.zeros((40, 30)),
        "collision": np.zeros((40, 30), bool),
    }
    ranges: Any = np.where(near, 0.04, 0.5)[..., None]
    obs = Observation(ranges=ranges, goal=ranges)
    given = Trajectory(info=info, obs=obs, output=QOutput(weights, weights, weights))
    found = information(given, np.full(30, 20), max_range=5.0)
    shares = np.array([reachable[:19].mean(), 1 - reachable[:19].mean()])
    entropy = -(shares * np.log2(shares)).sum()
    assert found["goal reachable"]["bits"] == pytest.approx(entropy)
    assert found["goal reachable"]["by_chance"] < 0.05
    assert found["wall near"]["bits"] < 0.05
    assert found["situation"]["bits"] == pytest.approx(0, abs=1e-12)
    near[1:20] = reachable[:19]
    ranges = np.where(near, 0.04, 0.5)[..., None]
    moved = Trajectory(info=info, obs=Observation(ranges, ranges), output=given.output)
    again = information(moved, np.full(30, 20), max_range=5.0)
    assert again["wall near"]["bits"] == pytest.approx(entropy)


def test_weights_over_time_are_those_of_quarters_of_the_way() -> None:
    weights = np.zeros((10, 2, 1))
    weights[:8, 0, 0], weights[8:, 0, 0] = np.repeat([1, 2, 3, 4], 2), 99  # Arrives at step 8.
    weights[:4, 1, 0], weights[4:, 1, 0] = [5, 6, 7, 8], 99
    # Of each quarter two steps of the first robot and one of the second.
    expected = [[(2 * a + b) / 3] for a, b in ((1, 5), (2, 6), (3, 7), (4, 8))]
    np.testing.assert_allclose(weights_over_time(weights, np.array([8, 4])), expected)


def test_the_table_has_the_mean_over_seeds_and_each_of_them() -> None:
    def seed(success: float, alone: float) -> dict[str, Any]:
        about = {"goal reachable": {"bits": success / 10, "by_chance": 0.01}}
        entry = {"success": success, "mean_weights": [0.3, 0.7], "information": about}
        return {"maps": {"maze": {AS_IT_IS: entry, "skill 1 alone": {"success": alone}}}}

    rows = {row[1]: row for row in over_seeds([seed(0.8, 0.1), seed(0.6, 0.3)])}
    # Student's t of one degree of freedom is 12.706; the standard error is 0.1.
    assert rows["success as it is"][2:] == ["0.700 [-0.571, 1.971]", "0.800, 0.600"]
    assert rows["success skill 1 alone"][3] == "0.100, 0.300"
    assert rows["largest mean weight"][2] == "0.700 [0.700, 0.700]"
    assert rows["bits about goal reachable"][3] == "0.080, 0.060"
    assert over_seeds([seed(0.8, 0.1)])[0][2] == "0.800"
