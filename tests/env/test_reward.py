"""The three terms of the reward, recomputed by hand along scripted episodes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import BEAMS, BOOLS, FIELD_OF_VIEW, open_map, scan, seen_areas, wrap_map
from rollouts import Rollout

from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env, reset_to, step
from sqn_jax.env.reward import (
    collision_reward,
    exploration_reward,
    goal_is_reachable,
    navigation_reward,
    time_reward,
    total_reward,
)

STAND, FORWARD, BACKWARD, LEFT, RIGHT = range(5)
KEY = jax.random.key(0)
start_at = jax.jit(reset_to)
take = jax.jit(step)


@pytest.fixture(scope="module")
def walled() -> BOOLS:
    """8 m x 14 m with a wall from the south, x from 7.0 to 7.15 m, y up to 5 m."""
    occupied = open_map(rows=160, columns=280)
    occupied[:100, 140:143] = True
    return occupied


@pytest.fixture(scope="module")
def walled_params(walled: BOOLS) -> EnvParams:
    """Coverage cells of 0.05 m, so that areas may be compared step by step."""
    occupancy_map = wrap_map(walled, [(1.0, 1.0), (13.0, 1.0)])
    return make_env(occupancy_map, EnvConfig(robot_radius=0.0, coverage_cell=0.05))


def stand_still(pose, goal, params: EnvParams) -> tuple[float, dict]:
    """Reward and info of one step on the spot, where nothing new is seen."""
    _, state = start_at(KEY, jnp.array(pose, jnp.float32), jnp.array(goal, jnp.float32), params)
    _, _, reward, _, _, info = take(KEY, state, STAND, params)
    return float(reward), {name: float(value) for name, value in info.items()}


def test_standing_still_before_a_visible_goal_earns_navigation_minus_time(walled_params) -> None:
    # The goal 1 m ahead: 2.0 x exp(-1) + 1.0 x 0 - 0.2 = 0.735759 - 0.2.
    reward, info = stand_still((2.0, 2.0, 0.0), (3.0, 2.0), walled_params)
    assert reward == pytest.approx(0.535759, abs=1e-5)
    assert info["reward_navigation"] == pytest.approx(0.367879, abs=1e-5)
    assert info["reward_exploration"] == 0.0
    assert info["reward_time"] == -1.0
    # The first scan saw tens of m2, none of it rewarded; this one sees nothing new.
    assert info["covered_area"] == 0.0


def test_driving_straight_to_the_goal_earns_what_the_distances_say(walled_params) -> None:
    # From 1 m before the goal in steps of 0.25 m: 0.75, 0.5, 0.25, 0, then 0.25 m behind it,
    # where the goal lies in the blind wedge.
    goal = jnp.array([3.0, 2.0])
    _, state = start_at(KEY, jnp.array([2.0, 2.0, 0.0]), goal, walled_params)
    navigation, reached = [], []
    for _ in range(5):
        _, state, _, _, _, info = take(KEY, state, FORWARD, walled_params)
        navigation.append(float(info["reward_navigation"]))
        reached.append(bool(info["reached"]))
    np.testing.assert_allclose(
        navigation[:3], [0.472367, 0.606531, 0.778801], rtol=1e-4
    )  # exp(-0.75), exp(-0.5), exp(-0.25)
    assert navigation[3] == pytest.approx(1.0, abs=1e-3)
    assert navigation[4] == 0.0
    # Within 0.3 m: at 0.25, 0 and 0.25 m.
    assert reached == [False, False, True, True, True]


def test_every_term_of_a_scripted_episode_is_what_a_slow_recomputation_gives(
    walled: BOOLS, walled_params: EnvParams
) -> None:
    # Towards the wall until it stops the robot, aside, along it, back, and round to the goal.
    script = [FORWARD] * 14 + [LEFT] * 5 + [FORWARD] * 9 + [STAND, BACKWARD, RIGHT, RIGHT]
    script += [BACKWARD, FORWARD] + [RIGHT] * 4 + [FORWARD] * 6 + [LEFT, STAND]
    goal = np.array([7.6, 6.5])
    _, state = start_at(KEY, jnp.array([3.8, 3.1, 0.05]), jnp.asarray(goal), walled_params)
    poses, records = [np.asarray(state.pose, np.float64)], []
    for action in script:
        _, state, reward, _, _, info = take(KEY, state, action, walled_params)
        poses.append(np.asarray(state.pose, np.float64))
        records.append({"reward": float(reward)} | {k: float(v) for k, v in info.items()})
    readings = scan(walled, 0.05, poses)
    growth = np.diff(seen_areas(walled, 0.05, poses, spacing=0.04))
    seen_goal = []
    for pose, reading, area, record in zip(poses[1:], readings[1:], growth, records, strict=True):
        away = goal - pose[:2]
        distance = np.hypot(*away)
        bearing = np.angle(np.exp(1j * (np.arctan2(away[1], away[0]) - pose[2])))
        beam = np.argmin(np.abs(BEAMS - bearing))
        visible = abs(bearing) <= FIELD_OF_VIEW / 2 and distance < reading[beam]
        navigation = np.exp(-distance) if visible else 0.0
        assert record["reward_navigation"] == pytest.approx(navigation, abs=1e-5)
        # Two lattices of 0.04 and 0.05 m differ by a few points along the edge of what is new.
        assert record["reward_exploration"] == pytest.approx(area, abs=0.1 + 0.03 * area)
        # A float32 sum against the same sum in float64.
        exact = 2.0 * navigation + 1.0 * record["covered_area"] + 0.2 * -1.0
        assert record["reward"] == pytest.approx(exact, abs=1e-4)
        seen_goal.append(visible)
    assert np.sum([record["reward_exploration"] for record in records]) == pytest.approx(
        growth.sum(), rel=0.02
    )
    # The script shows what it should: collisions, both sides of reachability.
    assert sum(record["collision"] for record in records) >= 2
    assert 3 < np.sum(seen_goal) < len(script) - 3


def test_a_goal_behind_a_wall_earns_nothing_however_near(walled_params: EnvParams) -> None:
    # The wall begins 0.1 m ahead, the goal stands 0.4 m ahead, behind it.
    for heading in (0.0, 1.5, -2.0):
        _, info = stand_still((6.9, 3.0, heading), (7.3, 3.0), walled_params)
        assert info["reward_navigation"] == 0.0
        assert info["goal_distance"] == pytest.approx(0.4, abs=1e-5)
    # The same goal where the wall has ended: 2 m farther north.
    _, info = stand_still((6.9, 5.5, 0.0), (7.3, 5.5), walled_params)
    assert info["reward_navigation"] == pytest.approx(np.exp(-0.4), rel=1e-4)


@pytest.mark.parametrize("bearing", [0, 90, -90, 174.5, -174.5, 175.5, -175.5, 180])
def test_a_goal_in_the_blind_ten_degrees_behind_earns_nothing(
    bearing: float, walled_params: EnvParams
) -> None:
    heading = 0.7
    direction = heading + np.deg2rad(bearing)
    goal = (3.0 + 0.8 * np.cos(direction), 4.0 + 0.8 * np.sin(direction))
    _, info = stand_still((3.0, 4.0, heading), goal, walled_params)
    expected = np.exp(-0.8) if abs(bearing) < 175 else 0.0
    assert info["reward_navigation"] == pytest.approx(expected, abs=1e-5)


def test_a_goal_beyond_the_range_of_the_sensor_earns_nothing(walled_params) -> None:
    for distance, expected in ((4.9, np.exp(-4.9)), (5.1, 0.0)):
        _, info = stand_still((1.0, 6.0, 0.0), (1.0 + distance, 6.0), walled_params)
        assert info["reward_navigation"] == pytest.approx(expected, abs=1e-6)


def test_reachability_is_judged_by_the_beam_nearest_to_the_goal() -> None:
    # All beams read 1 m but one, which reads 3 m: beam 50 at 5 x 50 - 175 = 75 degrees.
    ranges = jnp.ones(71).at[50].set(3.0)
    for bearing, distance, expected in (
        (75.0, 2.0, True),
        (77.4, 2.0, True),
        (77.6, 2.0, False),
        (72.6, 2.0, True),
        (72.4, 2.0, False),
        (75.0, 3.01, False),
        (77.6, 0.99, True),
        (-75.0, 2.0, False),
        (-174.9, 0.9, True),
        (-175.1, 0.9, False),
    ):
        heading = jnp.float32(np.deg2rad(bearing))
        got = goal_is_reachable(jnp.float32(distance), heading, ranges, field_of_view=FIELD_OF_VIEW)
        assert bool(got) is expected, (bearing, distance)


def test_the_terms_are_the_equations() -> None:
    assert navigation_reward(jnp.float32(0.5), jnp.bool_(True)) == pytest.approx(0.606531, abs=1e-6)
    assert navigation_reward(jnp.float32(0.5), jnp.bool_(False)) == 0.0
    assert exploration_reward(jnp.float32(1.25)) == 1.25
    assert time_reward() == -1.0
    assert collision_reward(jnp.bool_(True)) == -1.0
    assert collision_reward(jnp.bool_(False)) == 0.0
    # 2.0 x 0.5 + 1.0 x 1.25 + 0.2 x (-1) = 2.05; with unlike weights 0.5 + 12.5 - 100 = -87, and
    # minus 1000 for the collision.
    terms = jnp.float32(0.5), jnp.float32(1.25), -1.0, jnp.float32(-1.0)
    for weights, expected in (
        ((2.0, 1.0, 0.2, 0.0), 2.05),
        ((1.0, 10.0, 100.0, 0.0), -87.0),
        ((1.0, 10.0, 100.0, 1000.0), -1087.0),
    ):
        total = total_reward(*terms, jnp.array(weights))
        assert total == pytest.approx(expected, abs=1e-4)


def test_a_refused_move_costs_its_weight(walled: BOOLS, walled_params: EnvParams) -> None:
    config = dataclasses.replace(walled_params.config, reward_collision=0.75)
    dear = make_env(wrap_map(walled, [(1.0, 1.0), (13.0, 1.0)]), config)
    corner, goal = jnp.array([0.5, 0.5, np.pi]), jnp.array([13.0, 1.0])
    _, state = start_at(KEY, corner, goal, dear)
    refused = 0
    for number in range(20):
        _, state, reward, _, _, info = take(KEY, state, FORWARD, dear)
        expected = 2.0 * info["reward_navigation"] + info["covered_area"] - 0.2
        if info["collision"]:
            refused, expected = refused + 1, expected - 0.75
        assert reward == pytest.approx(float(expected), abs=1e-5), number
        assert info["reward_collision"] == (-1.0 if info["collision"] else 0.0)
    assert 0 < refused < 20  # It drives to the wall, and pushes against it.


def test_the_weights_come_from_the_config(walled: BOOLS, walled_params: EnvParams) -> None:
    config = dataclasses.replace(
        walled_params.config, reward_navigation=3.0, reward_exploration=0.5, reward_time=0.7
    )
    params = make_env(wrap_map(walled, [(1.0, 1.0), (13.0, 1.0)]), config)
    # 3.0 x exp(-1) - 0.7 = 0.403638; half the weight on the wedge that a turn uncovers.
    reward, _ = stand_still((2.0, 2.0, 0.0), (3.0, 2.0), params)
    assert reward == pytest.approx(0.403638, abs=1e-5)
    _, state = start_at(KEY, jnp.array([2.0, 4.0, 0.0]), jnp.array([9.0, 2.0]), params)
    _, _, reward, _, _, info = take(KEY, state, LEFT, params)
    assert info["covered_area"] > 0.3
    assert reward == pytest.approx(0.5 * float(info["covered_area"]) - 0.7, abs=1e-5)


def test_the_rewards_of_whole_episodes_are_the_weighted_sums_of_their_terms(
    maze_rollout: Rollout,
) -> None:
    info = {name: value.astype(np.float64) for name, value in maze_rollout.info.items()}
    expected = 2.0 * info["reward_navigation"] + info["covered_area"] - 0.2
    np.testing.assert_allclose(maze_rollout.rewards, expected, atol=1e-5)
    np.testing.assert_array_equal(info["reward_exploration"], info["covered_area"])
    distance = np.hypot(*(maze_rollout.poses[:, 1:, :2] - maze_rollout.goals[:, None]).T).T
    np.testing.assert_allclose(info["goal_distance"], distance, atol=1e-5)
    # Away from the goal's circle by more than rounding, `reached` is the comparison.
    sure = np.abs(distance - 0.3) > 1e-4
    np.testing.assert_array_equal(info["reached"][sure], (distance < 0.3)[sure])
    seen = info["reward_navigation"] > 0
    np.testing.assert_allclose(info["reward_navigation"][seen], np.exp(-distance[seen]), rtol=1e-4)
    assert seen.any()
