"""Sampling for learnability against loops in NumPy and hand arithmetic."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import small_room

from sqn_jax.agent.shards import AXIS
from sqn_jax.config import TrainConfig
from sqn_jax.config.map_names import MAX_MAPS
from sqn_jax.env import EnvParams, reset
from sqn_jax.training.curriculum import (
    LEAST_SHARE,
    RATE,
    by_learnability,
    initial_success,
    map_of_spawn_points,
    with_outcomes,
)

SIZES = (3, 1, 6)
"""Spawn points of three maps."""


@pytest.fixture(scope="module")
def world() -> EnvParams:
    """Three maps; on the last, tasks twice as often; spawn point i at x = 0.3 i m, alone."""
    firsts = np.cumsum([0, *SIZES[:-1]])
    groups = np.repeat(np.stack([firsts, SIZES], axis=1), SIZES, axis=0)
    count = sum(SIZES)
    places = np.stack([0.3 * np.arange(count), np.ones(count)], axis=1)[:, None]
    return dataclasses.replace(
        small_room(6),
        spawn_groups=jnp.asarray(groups, jnp.int32),
        spawn_positions=jnp.asarray(places, jnp.float32),
        spawn_counts=jnp.ones(count, jnp.int32),
        spawn_neighbors=jnp.zeros((count, 4), jnp.int32),
        start_points=jnp.asarray(
            np.repeat(np.arange(count), np.repeat((1, 1, 2), SIZES)), jnp.int32
        ),
    )


@pytest.fixture(scope="module")
def many(world: EnvParams) -> EnvParams:
    """The same with a hundred times the entries to draw from, map by map."""
    entries = jnp.sort(jnp.tile(world.start_points, 100))
    return dataclasses.replace(world, start_points=entries)


def on_maps(points: Any) -> Any:
    """How many of these spawn points lie on each map."""
    return np.bincount(np.repeat(np.arange(3), SIZES)[points], minlength=3)


def success_of(*values: float) -> Any:
    return jnp.full(MAX_MAPS, 0.5).at[: len(values)].set(jnp.array(values))


def test_spawn_points_know_their_map(world: EnvParams) -> None:
    assert map_of_spawn_points(world).tolist() == [0, 0, 0, 1, 2, 2, 2, 2, 2, 2]


def test_equal_success_changes_nothing(world: EnvParams) -> None:
    for p in (0.0, 0.3, 1.0):
        same = by_learnability(world, success_of(p, p, p))
        np.testing.assert_array_equal(same.start_points, world.start_points)
    assert by_learnability(world, None) is world
    assert initial_success(TrainConfig()) is None
    start = initial_success(TrainConfig(task_sampling="learnability"))
    np.testing.assert_array_equal(start, np.full(MAX_MAPS, 0.5))


@pytest.mark.parametrize("seed", range(8))
def test_a_map_has_its_share_to_one_entry(seed: int, many: EnvParams) -> None:
    """p (1 - p) + the least share, times its spawn points and its weight."""
    p = np.round(np.random.default_rng(seed).uniform(size=3), 1)
    drawn = by_learnability(many, success_of(*p)).start_points
    assert drawn.shape == many.start_points.shape
    shares = (p * (1 - p) + LEAST_SHARE) * SIZES * (1, 1, 2)
    assert np.abs(on_maps(drawn) - len(drawn) * shares / shares.sum()).max() <= 1.01


def test_what_is_solved_or_hopeless_is_seldom_drawn(many: EnvParams) -> None:
    """By hand: 3 x 0.02, 1 x 0.27, 12 x 0.02 of 0.57: of 1,600 entries 168, 758 and 674."""
    drawn = by_learnability(many, success_of(1.0, 0.5, 0.0)).start_points
    assert np.abs(on_maps(drawn) - [168, 758, 674]).max() <= 1


def outcomes_by_loop(success: Any, keys: Any, reached: Any, world: EnvParams) -> Any:
    """The spawn point read off where the robot stands."""
    maps = [round(float(reset(key, world)[1].pose[0]) / 0.3) for key in keys]
    maps = np.repeat(np.arange(3), SIZES)[maps]
    after = np.array(success, np.float64)
    for number in range(3):
        tried = reached[maps == number]
        if len(tried):
            kept = (1 - RATE) ** len(tried)
            after[number] = kept * after[number] + (1 - kept) * tried.mean()
    return after


@pytest.mark.parametrize("num_devices", [1, 2])
def test_success_follows_the_outcomes_of_each_map(num_devices: int, world: EnvParams) -> None:
    keys = jax.random.split(jax.random.key(3), 16)
    reached = np.random.default_rng(0).random(16) < 0.6
    before = success_of(0.9, 0.2, 0.4)
    expected = outcomes_by_loop(before, keys, reached, world)
    if num_devices == 1:
        after = with_outcomes(before, keys, jnp.asarray(reached), world, None)
        assert with_outcomes(None, keys, jnp.asarray(reached), world, None) is None
    else:
        update = partial(with_outcomes, before, env_params=world, axis_name=AXIS)
        shards = keys.reshape(2, 8), jnp.asarray(reached).reshape(2, 8)
        both = jax.vmap(update, axis_name=AXIS)(*shards)
        np.testing.assert_array_equal(*both)
        after = both[0]
    np.testing.assert_allclose(after, expected, atol=1e-6)
    assert not np.allclose(after[:3], before[:3])
