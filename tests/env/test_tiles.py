"""A robot in one of several maps side by side does what it does in that map alone."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly

from sqn_jax.env import EnvParams, make_env, navigation
from sqn_jax.maps import OccupancyMap, load_map
from sqn_jax.maps.atlas import side_by_side
from sqn_jax.maps.generate import generate


@pytest.fixture(scope="module")
def maps() -> list[OccupancyMap]:
    return [load_map("maze"), generate("column", 1), generate("forest", 2)]


@pytest.fixture(scope="module")
def together(maps: list[OccupancyMap]) -> EnvParams:
    return make_env(side_by_side(maps, "three"))


def test_it_sees_covers_and_is_rewarded_alike(
    maps: list[OccupancyMap], together: EnvParams
) -> None:
    """Two by two tiles of 17 m; positions there have one bit or two less behind the point."""
    corners = np.array([[0, 0, 0], [17, 0, 0], [0, 17, 0]], np.float32)
    rng = np.random.default_rng(0)
    with compiling_quickly():
        step, reset_to = jax.jit(navigation.step), jax.jit(navigation.reset_to)
        for corner, occupancy_map in zip(corners, maps, strict=True):
            alone = make_env(occupancy_map)
            places = np.asarray(alone.spawn_positions).reshape(-1, 2)
            pose = jnp.append(jnp.asarray(rng.choice(places)), rng.uniform(-3, 3))
            goal, key = pose[:2] + 1.5, jax.random.key(0)
            obs, state = reset_to(key, pose, goal, alone)
            obs_there, state_there = reset_to(key, pose + corner, goal + corner[:2], together)
            for action in rng.integers(0, 5, 40):
                np.testing.assert_allclose(obs_there.ranges, obs.ranges, atol=2e-4)
                np.testing.assert_allclose(obs_there.goal, obs.goal, atol=1e-5)
                different = np.asarray(state.covered) ^ np.asarray(state_there.covered)
                assert int(np.bitwise_count(different).sum()) <= 1
                obs, state, reward, _, _, _ = step(key, state, action, alone)
                obs_there, state_there, reward_there, _, _, _ = step(
                    key, state_there, action, together
                )
                assert abs(float(reward - reward_there)) < 0.11  # One point of the lattice.
            assert int(np.bitwise_count(np.asarray(state.covered)).sum()) > 100


def test_start_and_goal_lie_in_the_same_map_and_every_map_is_visited(
    maps: list[OccupancyMap], together: EnvParams
) -> None:
    sample = jax.jit(jax.vmap(navigation.sample_task, in_axes=(0, None)))
    near = together.replace(near_goal_fraction=jnp.float32(0.5))
    poses, goals = sample(jax.random.split(jax.random.key(1), 4000), near)
    starts = np.floor(np.asarray(poses)[:, :2] / 17).astype(int)
    ends = np.floor(np.asarray(goals) / 17).astype(int)
    np.testing.assert_array_equal(starts, ends)
    tiles = starts[:, 1] * 2 + starts[:, 0]
    counts = np.array([len(each.spawn_points) for each in maps])
    found = np.bincount(tiles, minlength=4)
    assert found[3] == 0
    np.testing.assert_allclose(found[:3] / 4000, counts / counts.sum(), atol=0.03)
    distance = np.hypot(*(np.asarray(poses)[:, :2] - np.asarray(goals)).T)
    assert distance.min() > 0


def test_a_weight_makes_tasks_more_frequent_and_no_other(maps: list[OccupancyMap]) -> None:
    """64 and 40 and 40 points, weights 1, 5 and 2: of 344 draws 64, 200 and 80."""
    weighed = make_env(side_by_side(maps, "three", [1, 5, 2]))
    sample = jax.jit(jax.vmap(navigation.sample_task, in_axes=(0, None)))
    poses, goals = sample(jax.random.split(jax.random.key(4), 4000), weighed)
    tile = np.floor(np.asarray(poses)[:, :2] / 17).astype(int) @ [1, 2]
    counts = np.array([len(each.spawn_points) for each in maps])
    expected = counts * [1, 5, 2] / (counts @ [1, 5, 2])
    np.testing.assert_allclose(np.bincount(tile, minlength=3) / 4000, expected, atol=0.03)
    assert np.hypot(*(np.asarray(poses)[:, :2] - np.asarray(goals)).T).min() > 0


def test_every_goal_of_a_map_is_drawn_but_the_start(maps: list[OccupancyMap]) -> None:
    together = make_env(side_by_side(maps, "three"), spawn="evaluation")
    sample = jax.jit(jax.vmap(navigation.sample_task, in_axes=(0, None)))
    poses, goals = sample(jax.random.split(jax.random.key(2), 2000), together)
    pairs = {
        (tuple(np.round(pose[:2], 2)), tuple(np.round(goal, 2)))
        for pose, goal in zip(np.asarray(poses).tolist(), np.asarray(goals).tolist(), strict=True)
    }
    counts = [len(each.evaluation_points) for each in maps]
    assert len(pairs) == sum(count * (count - 1) for count in counts)


def test_a_small_map_in_the_tile_of_a_large_one(maps: list[OccupancyMap]) -> None:
    """The second maze lies 17 m to the right in a tile of 51 m. Its points of the lattice are
    others than alone, so areas agree as two counts of the same area do."""
    second = generate("maze", 4)
    mixed = make_env(side_by_side([maps[0], second, generate("cave", 0)], "mixed"))
    alone = make_env(second)
    assert mixed.tile == (51.0, 51.0)
    rng = np.random.default_rng(1)
    places = np.asarray(alone.spawn_positions).reshape(-1, 2)
    key, areas = jax.random.key(0), []
    with compiling_quickly():
        step, reset_to = jax.jit(navigation.step), jax.jit(navigation.reset_to)
        for _ in range(4):
            pose = jnp.append(jnp.asarray(rng.choice(places)), rng.uniform(-3, 3))
            there, corner = pose + jnp.array([17.0, 0, 0]), jnp.array([17.0, 0])
            obs, state = reset_to(key, pose, pose[:2] + 1.5, alone)
            obs_there, state_there = reset_to(key, there, pose[:2] + 1.5 + corner, mixed)
            for action in rng.choice([1, 1, 1, 2, 3, 3], 60):
                np.testing.assert_allclose(obs_there.ranges, obs.ranges, atol=2e-4)
                np.testing.assert_allclose(obs_there.goal, obs.goal, atol=1e-5)
                obs, state, *_, info = step(key, state, action, alone)
                obs_there, state_there, *_, info_there = step(key, state_there, action, mixed)
                areas.append((float(info["covered_area"]), float(info_there["covered_area"])))
    ours, theirs = np.sum(areas, axis=0)
    assert ours > 50
    assert abs(ours - theirs) < 0.03 * ours
