"""Motion: what the robot does to its pose, and what walls do to the robot."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import BOOLS, cast, clearance, open_map, wrap_map
from rollouts import Rollout

from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env, reset_to, step
from sqn_jax.env.dynamics import move

STAND, FORWARD, BACKWARD, LEFT, RIGHT = range(5)


@pytest.fixture(scope="module")
def room_params() -> EnvParams:
    """A room of 3 m x 2 m, walls one cell thick at its edge, and a point robot."""
    occupancy_map = wrap_map(open_map(rows=40, columns=60), [(1.0, 1.0), (2.0, 1.0)])
    return make_env(occupancy_map, EnvConfig(robot_radius=0.0))


@pytest.fixture(scope="module")
def act():
    """One step without reward or goal in view: pose, action, params -> pose, collision."""

    @jax.jit
    def act(pose, action, params):
        key = jax.random.key(0)
        _, state = reset_to(key, pose, jnp.array([1.0, 1.0]), params)
        _, state, _, _, _, info = step(key, state, action, params)
        return state.pose, info["collision"]

    return lambda pose, action, params: tuple(
        np.asarray(leaf) for leaf in act(jnp.asarray(pose, jnp.float32), action, params)
    )


_move = jax.jit(partial(move, iterations=12))


def go(pose, velocity, params: EnvParams, time_step: float = 0.1) -> tuple[np.ndarray, bool]:
    new_pose, refused = _move(
        jnp.asarray(pose, jnp.float32),
        jnp.asarray(velocity, jnp.float32),
        params.body,
        time_step=jnp.float32(time_step),
    )
    return np.asarray(new_pose), bool(refused)


def test_no_pose_of_a_whole_episode_lies_in_an_obstacle(
    any_rollout: tuple[BOOLS, float, Rollout],
) -> None:
    occupied, _, run = any_rollout
    column, row = np.floor(run.poses[..., :2].astype(np.float64) / 0.05).astype(int).T
    assert not occupied[row, column].any()


def test_the_body_keeps_its_radius_from_obstacles_to_half_a_cell(
    any_rollout: tuple[BOOLS, float, Rollout],
) -> None:
    # The centre may be anywhere in a cell whose centre is a radius away: 0.05 / sqrt 2 = 0.0354.
    occupied, radius, run = any_rollout
    places = np.unique(run.poses[:, ::5, :2].reshape(-1, 2), axis=0)
    assert clearance(occupied, 0.05, places).min() > radius - 0.0354


def test_no_step_of_a_whole_episode_crosses_an_obstacle(
    any_rollout: tuple[BOOLS, float, Rollout],
) -> None:
    occupied, _, run = any_rollout
    poses = run.poses.astype(np.float64)
    x, y = poses[:, :-1, 0].ravel(), poses[:, :-1, 1].ravel()
    d_x, d_y = np.diff(poses[..., 0]).ravel(), np.diff(poses[..., 1]).ravel()
    length = np.hypot(d_x, d_y)
    # A corner may be cut by a thousandth of a cell; without noise nothing is cut in practice.
    free = cast(occupied, 0.05, x, y, np.arctan2(d_y, d_x), length, shortest_chord=2e-3)
    np.testing.assert_allclose(free, length, atol=1e-9)
    assert length.max() > 0.2


def test_episodes_meet_walls_and_refused_moves_do_not_move_the_robot(
    any_rollout: tuple[BOOLS, float, Rollout],
) -> None:
    _, _, run = any_rollout
    refused = run.info["collision"]
    assert refused.mean() > 0.01
    still = np.all(run.poses[:, 1:, :2] == run.poses[:, :-1, :2], axis=-1)
    assert still[refused].all()


@pytest.mark.parametrize("heading", [0.0, 0.3, 2.0, -2.5])
def test_the_five_actions_stand_drive_and_turn(heading: float, act, room_params) -> None:
    # 0.1 s at 2.5 m/s are 0.25 m, backwards half of it; 0.1 s at pi rad/s are 0.314 rad.
    start = np.array([1.5, 1.0, heading])
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    turn = np.array([0.0, 0.0, 0.1 * np.pi])
    for action, expected in (
        (STAND, start),
        (FORWARD, start + 0.25 * ahead),
        (BACKWARD, start - 0.125 * ahead),
        (LEFT, start + turn),
        (RIGHT, start - turn),
    ):
        pose, collision = act(start, action, room_params)
        np.testing.assert_allclose(pose, expected, atol=1e-6)
        assert not collision


def test_the_heading_stays_within_one_revolution(act, room_params) -> None:
    pose, _ = act([1.5, 1.0, 3.0], LEFT, room_params)
    assert pose[2] == pytest.approx(3.0 + 0.1 * np.pi - 2 * np.pi, abs=1e-5)
    pose, _ = act([1.5, 1.0, -3.0], RIGHT, room_params)
    assert pose[2] == pytest.approx(2 * np.pi - 3.0 - 0.1 * np.pi, abs=1e-5)


def test_a_refused_move_stops_the_robot(act, room_params) -> None:
    # The wall begins at x = 59 x 0.05 = 2.95 m: 0.2 m are left, the step is 0.25 m.
    for heading in (0.0, 0.2):
        pose, collision = act([2.75, 1.0, heading], FORWARD, room_params)
        np.testing.assert_array_equal(pose[:2], np.float32([2.75, 1.0]))
        assert pose[2] == pytest.approx(heading, abs=1e-6)
        assert collision
    # Backwards 0.125 m do fit into the 0.2 m.
    pose, collision = act([2.75, 1.0, np.pi], BACKWARD, room_params)
    np.testing.assert_allclose(pose[:2], [2.875, 1.0], atol=1e-6)
    assert not collision


def test_a_turn_at_a_wall_still_turns(act, room_params) -> None:
    for action, sign in ((LEFT, 1), (RIGHT, -1)):
        # 0.3 mm before the wall: turning is no collision, however close.
        pose, collision = act([2.9497, 1.0, 0.0], action, room_params)
        np.testing.assert_allclose(pose, [2.9497, 1.0, sign * 0.1 * np.pi], atol=1e-6)
        assert not collision
    # A refused move that also turns, as velocity noise makes it: the turn is made.
    pose, refused = go([2.9, 1.0, 0.0], [2.5, 1.0], room_params)
    np.testing.assert_allclose(pose, [2.9, 1.0, 0.1], atol=1e-6)
    assert refused


def test_a_wall_of_one_cell_cannot_be_jumped_at_any_speed(thin_walls) -> None:
    # The wall stands in column 40, x from 2.00 to 2.05 m, y from 1.0 to 3.5 m.
    params = make_env(thin_walls, EnvConfig(robot_radius=0.0, forward_speed=20.0))
    for x in (1.2, 1.7, 1.99):
        for length in (0.25, 0.9, 2.0):
            pose, refused = go([x, 2.3, 0.05], [length / 0.1, 0.0], params)
            reaches = length * np.cos(0.05) >= 2.0 - x
            assert refused == reaches
            assert pose[0] < 2.0
            assert (pose[0] == np.float32(x)) == reaches


@pytest.mark.parametrize("velocity", [(2.5, 1.0), (2.5, -4.0), (-1.25, 2.0), (0.7, 1e-4), (2, 0)])
def test_the_arc_ends_where_fine_steps_of_euler_end(
    velocity: tuple[float, float], room_params: EnvParams
) -> None:
    pose = np.array([1.5, 1.0, 0.6])
    parts = 200_000
    heading = 0.6 + velocity[1] * 0.1 * np.arange(parts) / parts
    way = velocity[0] * 0.1 / parts
    end = [1.5 + way * np.cos(heading).sum(), 1.0 + way * np.sin(heading).sum()]
    got, refused = go(pose, velocity, room_params)
    np.testing.assert_allclose(got, [*end, 0.6 + velocity[1] * 0.1], atol=3e-6)
    assert not refused


@pytest.mark.parametrize(("radius", "closest"), [(0.0, 2.95), (0.1, 2.85), (0.25, 2.70)])
def test_a_robot_stops_a_radius_from_the_wall(radius: float, closest: float) -> None:
    # The wall begins at 2.95 m; a cell is open to the robot if its centre is a radius away, so
    # the last open cell ends half a cell or less after the exact place.
    occupancy_map = wrap_map(open_map(rows=40, columns=60), [(1.0, 1.0), (2.0, 1.0)])
    params = make_env(occupancy_map, EnvConfig(robot_radius=radius))
    x = 2.0
    while x < 3.0:
        pose, refused = go([x, 1.0, 0.0], [0.01, 0.0], params)
        if refused:
            break
        x = float(pose[0])
    assert closest - 0.026 <= x <= closest + 0.025


def test_a_robot_of_some_size_does_not_fit_through_a_gap_for_a_point() -> None:
    # A wall of one cell with a gap of three cells, 0.15 m, at y from 0.95 to 1.10 m.
    occupied = open_map(rows=40, columns=60)
    occupied[:, 30] = True
    occupied[19:22, 30] = False
    points = [(0.5, 1.025), (1.0, 1.025)]
    for radius, fits in ((0.0, True), (0.05, True), (0.1, False)):
        params = make_env(wrap_map(occupied, points), EnvConfig(robot_radius=radius))
        pose, refused = go([1.4, 1.025, 0.0], [2.5, 0.0], params)
        assert refused != fits
        assert (pose[0] > 1.6) == fits


def test_a_move_that_would_end_in_the_corner_of_an_obstacle_is_refused() -> None:
    # The occupied cell's lower left corner is (0.5, 0.5); the way down and to the right passes it
    # at x + y = 1.00002 and ends on the short piece inside.
    occupied = open_map(rows=30, columns=40)
    occupied[10, 10] = True
    occupancy_map = wrap_map(occupied, [(1.0, 1.0), (1.5, 1.0)])
    params = make_env(occupancy_map, EnvConfig(robot_radius=0.0))
    side = 0.1 / np.sqrt(2)
    pose, _ = go([0.50001 - side, 0.50001 + side, -np.pi / 4], [1.0, 0.0], params)
    column, row = np.floor(pose[:2].astype(np.float64) / 0.05).astype(int)
    assert not occupied[row, column]
