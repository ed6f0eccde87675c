"""The interface of the simulator: `reset` and `step`, under jit and vmap."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import clearance, open_map, wrap_map
from rollouts import Rollout, run_robots
from scipy import ndimage

import sqn_jax
from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env, reset, reset_to, sample_task, step
from sqn_jax.maps import OccupancyMap

many_tasks = jax.jit(jax.vmap(sample_task, in_axes=(0, None)))
start_at = jax.jit(reset_to)
take = jax.jit(step)

INFO = {
    "reached",
    "collision",
    "refused",
    "goal_distance",
    "covered_area",
    "reward_navigation",
    "reward_exploration",
    "reward_time",
    "reward_collision",
}


@pytest.fixture(scope="module")
def tasks(maze_params: EnvParams) -> tuple[np.ndarray, np.ndarray]:
    """Starts [4000, 3] and goals [4000, 2] in the maze."""
    poses, goals = many_tasks(jax.random.split(jax.random.key(8), 4000), maze_params)
    return np.asarray(poses, np.float64), np.asarray(goals, np.float64)


@pytest.fixture(scope="module")
def some_states(maze_params: EnvParams):
    """Forty keys, the states after as many resets, and actions for them."""
    keys = jax.random.split(jax.random.key(9), 40)
    _, states = jax.jit(jax.vmap(reset, in_axes=(0, None)))(keys, maze_params)
    return keys, states, jnp.arange(40) % 5


def assert_same(one, other) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_step_returns_six_values_with_the_documented_types(
    maze_params: EnvParams, some_states
) -> None:
    keys, states, _ = some_states
    state = jax.tree.map(lambda leaf: leaf[0], states)
    assert sqn_jax.step is step
    obs, new_state, reward, terminated, truncated, info = take(
        keys[0], state, jnp.int32(1), maze_params
    )
    assert obs.ranges.shape == (71,)
    assert obs.goal.shape == (2,)
    assert reward.shape == ()
    assert reward.dtype == jnp.float32
    assert terminated.dtype == truncated.dtype == bool
    assert set(info) == INFO
    assert info["reached"].dtype == info["collision"].dtype == bool
    before = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), state)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), new_state) == before
    np.testing.assert_array_equal(new_state.goal, state.goal)
    assert new_state.step == state.step + 1 == 1


def test_an_episode_is_never_terminated_and_truncated_at_its_last_step(
    maze_rollout: Rollout,
) -> None:
    assert not maze_rollout.terminated.any()
    assert not maze_rollout.truncated[:, :399].any()
    assert maze_rollout.truncated[:, 399].all()


def test_reaching_the_goal_ends_nothing(hall_params: EnvParams) -> None:
    run = run_robots(hall_params.replace(goal_radius=jnp.float32(100.0)), seed=0, robots=16)
    assert run.info["reached"].all()
    assert not run.terminated.any()
    assert not run.truncated[:, :399].any()


def test_the_length_of_an_episode_is_the_maps_unless_the_config_sets_it(
    hall: OccupancyMap,
) -> None:
    for limit in (400, 1200):
        longer = dataclasses.replace(hall, max_steps=limit)
        assert make_env(longer).max_steps == limit
        assert make_env(longer, EnvConfig(max_steps=7)).max_steps == 7


def test_starts_and_goals_lie_near_two_different_spawn_points(
    maze: OccupancyMap, tasks: tuple[np.ndarray, np.ndarray]
) -> None:
    nearest = []
    for places in (tasks[0][:, :2], tasks[1]):
        away = np.linalg.norm(places[:, None] - maze.spawn_points[None], axis=-1)
        assert away.min(axis=1).max() <= maze.spawn_radius + 1e-5
        nearest.append(away.argmin(axis=1))
    # The maze's spawn points are 2.1 m apart, more than twice the radius: nearest is unmistakable.
    assert np.all(nearest[0] != nearest[1])
    for points in nearest:
        counts = np.bincount(points, minlength=len(maze.spawn_points))
        mean = 4000 / len(maze.spawn_points)
        assert np.abs(counts - mean).max() < 5 * np.sqrt(mean)


def test_starts_and_goals_are_traversable_and_connected(
    maze: OccupancyMap, tasks: tuple[np.ndarray, np.ndarray]
) -> None:
    # Cells whose centre is 0.1 m or more from every occupied square: a slow dilation.
    offsets = [(i, j) for i in range(-3, 4) for j in range(-3, 4)]
    near = np.zeros((7, 7), bool)
    for i, j in offsets:
        near[i + 3, j + 3] = np.hypot(max(abs(i) - 0.5, 0), max(abs(j) - 0.5, 0)) * 0.05 < 0.0999
    open_cells = ~ndimage.binary_dilation(maze.occupied, near)
    labels, _ = ndimage.label(open_cells)
    found = set()
    for places in (tasks[0][:, :2], tasks[1]):
        column, row = np.floor(places / 0.05).astype(int).T
        found |= set(labels[row, column].tolist())
    assert len(found) == 1
    assert 0 not in found


def test_starts_and_goals_avoid_walls_and_closed_pockets_near_a_spawn_point() -> None:
    # 0.3 m east of the first spawn point stands a closed box, free inside; 0.25 m to its west is
    # the outer wall.
    occupied = open_map(rows=40, columns=80)
    occupied[14:26, 12:24] = True
    occupied[15:25, 13:23] = False
    points = [(0.3, 1.0), (3.0, 1.0)]
    params = make_env(wrap_map(occupied, points, spawn_radius=0.8))
    poses, goals = many_tasks(jax.random.split(jax.random.key(8), 500), params)
    places = np.concatenate([np.asarray(poses)[:, :2], np.asarray(goals)]).astype(np.float64)
    in_box = np.all((places > [0.6, 0.7]) & (places < [1.2, 1.3]), axis=1)
    assert not in_box.any()
    assert clearance(occupied, 0.05, places).min() > 0.0999
    # Both sides of the wall's surroundings are in reach: the test looks where it matters.
    assert (np.linalg.norm(places - points[0], axis=1) < 0.8).sum() > 300
    assert clearance(occupied, 0.05, places).min() < 0.15


def test_start_headings_are_uniform_and_places_vary(tasks: tuple[np.ndarray, np.ndarray]) -> None:
    heading = tasks[0][:, 2]
    counts, _ = np.histogram(heading, bins=8, range=(-np.pi, np.pi))
    assert counts.sum() == 4000
    assert np.abs(counts - 500).max() < 5 * np.sqrt(500)
    # About 300 cells lie within 0.5 m of each of 64 points.
    assert len(np.unique(tasks[0][:, :2], axis=0)) > 3000


def test_evaluation_starts_are_the_evaluation_points(maze: OccupancyMap) -> None:
    params = make_env(maze, spawn="evaluation")
    poses, goals = many_tasks(jax.random.split(jax.random.key(8), 100), params)
    points = {tuple(point) for point in maze.evaluation_points.astype(np.float32).tolist()}
    starts = [tuple(place) for place in np.asarray(poses)[:, :2].tolist()]
    ends = [tuple(place) for place in np.asarray(goals).tolist()]
    assert set(starts) == set(ends) == points
    assert all(start != end for start, end in zip(starts, ends, strict=True))


def test_a_start_given_is_the_start(maze_params: EnvParams) -> None:
    pose, goal = jnp.array([1.1, 1.2, 0.3]), jnp.array([3.2, 1.1])
    _, state = start_at(jax.random.key(0), pose, goal, maze_params)
    np.testing.assert_array_equal(state.pose, pose)
    np.testing.assert_array_equal(state.goal, goal)
    assert state.step == 0


def test_the_same_key_gives_the_same_episode_and_another_key_another(
    maze_params: EnvParams, maze_rollout: Rollout
) -> None:
    assert_same(run_robots(maze_params, seed=0, robots=16), maze_rollout)
    other = run_robots(maze_params, seed=1, robots=16)
    assert not np.any(np.all(other.poses[:, 0] == maze_rollout.poses[:, 0], axis=-1))


def test_robots_under_vmap_do_what_single_robots_do_bit_for_bit(
    maze_params: EnvParams, some_states
) -> None:
    keys, states, actions = some_states
    together = jax.jit(jax.vmap(step, in_axes=(0, 0, 0, None)))(keys, states, actions, maze_params)
    for i in range(40):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        single = take(keys[i], state, actions[i], maze_params)
        assert_same(single, jax.tree.map(lambda leaf, i=i: leaf[i], together))


def test_the_step_compiles_once_for_all_actions_states_and_maps_of_one_shape(
    hall: OccupancyMap, hall_params: EnvParams
) -> None:
    traces = 0

    @jax.jit
    def counted(key, state, action, params):
        nonlocal traces
        traces += 1
        return step(key, state, action, params)

    key = jax.random.key(0)
    _, state = jax.jit(reset)(key, hall_params)
    for action in range(5):
        _, state, *_ = counted(key, state, jnp.int32(action), hall_params)
    assert traces == 1
    # The same map turned by half a revolution: another map of the same shape.
    turned = make_env(
        dataclasses.replace(
            hall,
            occupied=hall.occupied[::-1, ::-1],
            spawn_points=np.array([300, 200]) * 0.05 - hall.spawn_points,
            evaluation_points=np.array([300, 200]) * 0.05 - hall.evaluation_points,
        )
    )
    assert turned.spawn_positions.shape == hall_params.spawn_positions.shape
    turned_state = state.replace(pose=jnp.append(turned.spawn_positions[0, 0], 0.0))
    counted(key, turned_state, jnp.int32(1), turned)
    # Another speed, goal radius and other weights.
    other = hall_params.replace(
        commands=2 * hall_params.commands,
        goal_radius=jnp.float32(0.5),
        reward_weights=jnp.array([1.0, 2.0, 3.0, 4.0]),
    )
    counted(key, state, jnp.int32(1), other)
    assert traces == 1


def test_another_speed_is_a_replace(hall_params: EnvParams) -> None:
    pose = jnp.append(hall_params.spawn_positions[0, 0], 0.0)
    fast = hall_params.replace(commands=0.1 * hall_params.commands)
    _, state = start_at(jax.random.key(0), pose, jnp.array([1.0, 1.0]), fast)
    _, moved, *_ = take(jax.random.key(0), state, 1, fast)
    assert moved.pose[0] - pose[0] == pytest.approx(0.025, abs=1e-6)
