"""The virtual bumper against paths that are walked in small steps, and in whole episodes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import BEAMS, open_map, wrap_map
from hypothesis import given, settings
from hypothesis import strategies as st

from sqn_jax.config import EnvConfig
from sqn_jax.env import make_env, reset, reset_to, step
from sqn_jax.env.bumper import is_blocked
from sqn_jax.maps import load_map

FORWARD, BACKWARD, LEFT = 1, 2, 3
blocked = jax.jit(is_blocked)
take = jax.jit(step)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.25, -0.125]), st.floats(0.05, 0.5))
def test_it_stops_what_comes_nearer_than_its_reach(seed: int, travel: float, reach: float) -> None:
    rng = np.random.default_rng(seed)
    ranges = np.float32(rng.uniform(0.05, rng.choice([0.8, 3.0]), 71))
    hits = ranges[:, None] * np.stack([np.cos(BEAMS), np.sin(BEAMS)], axis=-1)
    places = np.linspace(0.0, travel, 2001)[:, None] * np.array([1.0, 0.0])
    clearances = np.hypot(*(hits - places[:, None]).T).min(axis=0)
    nearest, now = clearances.min(), clearances[0]
    if min(abs(nearest - reach), abs(now - 1e-3 - nearest)) > 1e-4:
        got = blocked(ranges, np.float32(BEAMS), jnp.float32(travel), reach=jnp.float32(reach))
        assert bool(got) is bool(nearest < reach and nearest < now - 1e-3)


def test_it_stops_before_a_wall_and_lets_the_robot_go_along_and_away() -> None:
    # 10 m x 5 m; the wall of one cell ends at x = 0.05 m.
    occupancy_map = wrap_map(open_map(rows=100, columns=200), [(1.0, 1.0), (9.0, 4.0)])
    params = make_env(occupancy_map, EnvConfig(bumper=0.05, robot_radius=0.1))
    goal, key = jnp.array([9.0, 4.0]), jax.random.key(0)

    def moved(pose: tuple[float, float, float], action: int) -> tuple[float, bool, bool]:
        _, state = reset_to(key, jnp.array(pose), goal, params)
        _, after, _, _, _, info = take(key, state, action, params)
        way = np.hypot(*np.asarray(after.pose - state.pose)[:2])
        return float(way), bool(info["refused"]), bool(info["collision"])

    toward, along = np.pi, np.pi / 2
    # From x = 0.46 m a move of 0.25 m ends 0.16 m before the wall, from 0.44 m at 0.14 m.
    assert moved((0.46, 2.0, toward), FORWARD) == (pytest.approx(0.25, abs=1e-5), False, False)
    assert moved((0.44, 2.0, toward), FORWARD) == (0.0, True, False)
    # At 0.16 m from the wall: along it, away from it and about itself it may.
    assert moved((0.21, 2.0, along), FORWARD) == (pytest.approx(0.25, abs=1e-5), False, False)
    assert moved((0.21, 2.0, toward), BACKWARD) == (pytest.approx(0.125, abs=1e-5), False, False)
    assert moved((0.21, 2.0, 0.0), BACKWARD) == (0.0, True, False)
    assert moved((0.21, 2.0, toward), LEFT) == (0.0, False, False)
    # Nearer than its reach already: not nearer still, but away.
    assert moved((0.18, 2.0, toward), FORWARD) == (0.0, True, False)
    assert moved((0.18, 2.0, 0.0), FORWARD) == (pytest.approx(0.25, abs=1e-5), False, False)


@pytest.mark.parametrize("name", ["maze", "forest"])
def test_with_it_random_robots_touch_nothing(name: str) -> None:
    params = make_env(load_map(name), EnvConfig(bumper=0.05))

    def drive(key: jax.Array, world: object) -> tuple[jax.Array, jax.Array]:
        first, then = jax.random.split(key)
        _, state = reset(first, world)

        def act(state, key):
            # Mostly forward, so that they get to the walls.
            action = jax.random.choice(key, 5, p=jnp.array([0.0, 0.7, 0.1, 0.1, 0.1]))
            _, state, _, _, _, info = step(key, state, action, world)
            return state, (info["collision"], info["refused"])

        return jax.lax.scan(act, state, jax.random.split(then, 200))[1]

    drive_all = jax.jit(jax.vmap(drive, in_axes=(0, None)))
    keys = jax.random.split(jax.random.key(3), 32)
    collisions, refused = drive_all(keys, params)
    assert not collisions.any()
    assert refused.mean() > 0.05
    config = dataclasses.replace(params.config, bumper=0.0)
    collisions, refused = drive_all(keys, dataclasses.replace(params, config=config))
    assert collisions.mean() > 0.05
    np.testing.assert_array_equal(collisions, refused)
