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
ROOM = wrap_map(open_map(rows=100, columns=200), [(1.0, 1.0), (9.0, 4.0)])
"""10 m x 5 m; the wall of one cell ends at x = 0.05 m."""
blocked = jax.jit(is_blocked)
take = jax.jit(step)


def by_walking(
    ranges: np.ndarray, travel: float, radius: float, reach: float, slack: float
) -> bool:
    """Whether a move of small steps comes nearer to a hit than it may, hit by hit."""
    hits = [
        (reading * np.cos(angle), reading * np.sin(angle))
        for reading, angle in zip(ranges, BEAMS, strict=True)
        if reading < 5.0
    ]
    way = np.linspace(0.0, travel, 501)
    for side in (1, -1):
        there = [(x, y) for x, y in hits if side * y > -0.02]
        beside = [
            np.hypot(x, y) for x, y in there if abs(y) > 0.9 * abs(x) and np.hypot(x, y) >= radius
        ]
        allowed = min([reach, *(distance - 1e-3 for distance in beside)])
        for x, y in there:
            nearest = np.hypot(x - way, y).min()
            if nearest < np.hypot(x, y) - 1e-3 and nearest < allowed - slack:
                return True
    return False


@settings(max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.25, -0.125]),
    st.floats(0.05, 0.3),
    st.floats(0, 0.3),
)
def test_it_stops_what_comes_nearer_than_its_reach(
    seed: int, travel: float, radius: float, bumper: float
) -> None:
    rng = np.random.default_rng(seed)
    ranges = np.float32(rng.uniform(0.05, rng.choice([0.8, 3.0]), 71))
    ranges[rng.random(71) < 0.2] = 5.0
    got = blocked(
        ranges,
        np.float32(BEAMS),
        jnp.float32(travel),
        radius=radius,
        reach=radius + bumper,
        max_range=5.0,
    )
    # Where both agree it is no matter of a tenth of a millimeter.
    expected = {
        by_walking(ranges, travel, radius, radius + bumper, slack) for slack in (1e-4, -1e-4)
    }
    assert bool(got) in expected


@pytest.mark.parametrize("radius", [0.1, 0.33])
def test_what_is_near_elsewhere_does_not_let_it_into_a_wall(radius: float) -> None:
    # A wall 0.3 m and the radius ahead of it; the move of 0.25 m ends 0.05 m from the body.
    def ahead(others: dict[int, float]) -> bool:
        ranges = np.full(71, 5.0, np.float32)
        ranges[30:41] = (radius + 0.29) / np.cos(BEAMS[30:41])
        for beam, reading in others.items():
            ranges[beam] = reading
        return bool(
            blocked(
                ranges,
                np.float32(BEAMS),
                jnp.float32(0.25),
                radius=radius,
                reach=radius + 0.05,
                max_range=5.0,
            )
        )

    assert ahead({})
    # Beams 17 and 53 point to the right and the left, beam 0 backward.
    assert ahead({53: radius + 0.02})  # A wall beside it at the left: the right is not free.
    assert ahead({0: radius + 0.01})
    assert ahead({53: 0.0, 54: 0.0})  # Blind there.
    assert ahead({53: radius - 0.05, 17: radius - 0.05})  # Its own posts.
    # A slot as narrow on both sides as what is ahead: it may go on.
    assert not ahead({53: radius + 0.03, 17: radius + 0.03})


def test_it_stops_before_a_wall_and_lets_the_robot_go_along_and_away() -> None:
    params = make_env(ROOM, EnvConfig(bumper=0.05, robot_radius=0.1))
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


def stopped(config: EnvConfig, x: float, action: int, keys: int = 400) -> tuple[np.ndarray, ...]:
    """Refused and touched [keys] for a robot that faces the wall at 0.05 m, from x m."""
    params = make_env(ROOM, config)
    key, goal = jax.random.key(0), jnp.array([9.0, 4.0])
    _, state = reset_to(key, jnp.array([x, 2.0, np.pi]), goal, params)
    each = jax.jit(jax.vmap(step, in_axes=(0, None, None, None)))
    *_, info = each(jax.random.split(key, keys), state, action, params)
    return np.asarray(info["refused"]), np.asarray(info["collision"])


def test_it_sees_the_readings_with_their_noise() -> None:
    """Of the true scan a move from 0.55 m ends 0.25 m before the wall, and one from 0.4 m at 0.1 m.

    Readings that are 60 % off at most say 0.2 m to 0.8 m and 0.14 m to 0.56 m of the wall ahead.
    """
    config = EnvConfig(bumper=0.05, range_noise=0.6)
    rng, toward = np.random.default_rng(0), np.cos(BEAMS)
    for x in (0.55, 0.7, 0.4):
        true = np.where(toward > 0, (x - 0.05) / np.where(toward > 0, toward, 1.0), np.inf)
        # The near wall alone: the others are too far to stop anything.
        true = np.minimum(true, 5.0)
        stops = [
            by_walking(true * (1 + rng.uniform(-0.6, 0.6, 71)), 0.25, 0.1, 0.15, 0.0)
            for _ in range(200)
        ]
        refused, _ = stopped(config, x, FORWARD)
        assert refused.mean() == pytest.approx(np.mean(stops), abs=0.12), x


def test_it_knows_the_command_and_not_the_move_that_comes_of_it() -> None:
    config = EnvConfig(bumper=0.05, velocity_noise=0.5, velocity_noise_unit="absolute")
    # A turn is no approach, and may end at the wall all the same.
    refused, touched = stopped(config, 0.16, LEFT)
    assert touched.any()
    np.testing.assert_array_equal(refused, touched)
    # A move that would end too near is stopped, however short it would become.
    refused, touched = stopped(config, 0.44, FORWARD)
    assert refused.all()
    assert not touched.any()


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
