"""Thickened scans against rays that are walked in small steps, and against a slimmer robot."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import BEAMS, wrap_map
from hypothesis import given, settings
from hypothesis import strategies as st

from sqn_jax.config import EnvConfig
from sqn_jax.env import make_env, reset_to
from sqn_jax.env.scan_margin import thickened

MAX_RANGE = 5.0
STRIDE = 0.01  # m


def walked(ranges: np.ndarray, margin: float, least_ahead: float = 0.0) -> np.ndarray:
    """How far one gets along each beam before a hit is nearer than the margin, and nearer still.

    A robot that stands within the margin of a hit may go away from it.
    """
    hits = ranges[:, None] * np.stack([np.cos(BEAMS), np.sin(BEAMS)], axis=-1)
    hits = hits[ranges < MAX_RANGE]
    along = np.arange(0.0, MAX_RANGE, STRIDE)
    readings = []
    for angle, own in zip(BEAMS, ranges, strict=True):
        direction = np.array([np.cos(angle), np.sin(angle)])
        away = np.hypot(*(hits[:, None] - along[None, :, None] * direction).T).T
        ahead = hits @ direction > least_ahead
        blocked = ((away < margin) & ahead[:, None]).any(axis=0)
        first = along[blocked.argmax()] if blocked.any() else MAX_RANGE
        readings.append(min(first, own))
    return np.array(readings)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.6))
def test_it_is_the_scan_of_discs_around_the_hits(seed: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    ranges = np.where(rng.random(71) < 0.3, MAX_RANGE, rng.uniform(0.05, MAX_RANGE, 71))
    got = thickened(jnp.float32(ranges), jnp.float32(BEAMS), margin=margin, max_range=MAX_RANGE)
    expected = walked(ranges, margin)
    # A beam that grazes a disc, or has a hit just beside it, may or may not meet it: the others
    # agree to a stride.
    sure = np.abs(walked(ranges, margin + 1e-3) - walked(ranges, margin - 1e-3)) < 0.1
    sure &= walked(ranges, margin, 1e-4) == walked(ranges, margin, -1e-4)
    assert sure.mean() > 0.8
    np.testing.assert_allclose(got[sure], expected[sure], atol=2 * STRIDE)


def test_a_post_ahead_is_nearer_and_wider() -> None:
    # One beam, straight ahead, hits something 2 m away; with 0.3 m around it the reading is 1.7 m,
    # and a beam at 5 degrees, which passes 0.174 m beside it, meets the disc at 1.748 m:
    # 2 cos(5 deg) - sqrt(0.09 - (2 sin(5 deg))^2) = 1.99239 - 0.24416.
    ranges = jnp.full(71, MAX_RANGE).at[35].set(2.0)
    got = thickened(ranges, jnp.float32(BEAMS), margin=0.3, max_range=MAX_RANGE)
    assert got[35] == pytest.approx(1.7, abs=1e-5)
    assert got[34] == pytest.approx(1.74823, abs=1e-4)
    assert got[36] == pytest.approx(1.74823, abs=1e-4)
    # At 10 degrees it passes 0.347 m beside.
    assert got[33] == MAX_RANGE


def test_nothing_in_sight_stays_nothing() -> None:
    free = jnp.full(71, MAX_RANGE)
    np.testing.assert_array_equal(
        thickened(free, jnp.float32(BEAMS), margin=0.3, max_range=MAX_RANGE), free
    )


def test_within_the_margin_the_way_back_is_open() -> None:
    # A wall 0.1 m ahead, nothing behind.
    ahead = np.abs(BEAMS) < 1.2
    ranges = jnp.float32(np.where(ahead, 0.1 / np.cos(np.where(ahead, BEAMS, 0.0)), MAX_RANGE))
    got = thickened(ranges, jnp.float32(BEAMS), margin=0.2, max_range=MAX_RANGE)
    assert (got[np.abs(BEAMS) < 0.8] == 0.0).all()
    assert (got[np.abs(BEAMS) > 2.8] == MAX_RANGE).all()


def test_a_wide_robot_sees_what_a_slim_one_sees_between_thicker_walls() -> None:
    # Walls that are 0.3 m thicker on all sides, and the scan thickened by as much: but for corners,
    # which a disc rounds off, for what hides between two beams, and for walls of which only the
    # thicker part is within the range of 5 m.
    occupied = np.zeros((200, 200), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[80:120, 90:110] = True
    thick = occupied.copy()
    for _ in range(6):
        thick = thick | np.roll(thick, 1, 0) | np.roll(thick, -1, 0)
        thick = thick | np.roll(thick, 1, 1) | np.roll(thick, -1, 1)
    spawn = [(2.0, 5.0), (8.0, 2.0)]
    wide = make_env(wrap_map(occupied, spawn), EnvConfig(scan_margin=0.3))
    slim = make_env(wrap_map(thick, spawn), EnvConfig())
    for x, y, heading in ((2.0, 5.0, 0.0), (3.0, 3.5, 0.7), (7.0, 7.0, -2.0)):
        pose, goal = jnp.array([x, y, heading]), jnp.array([8.0, 2.0])
        seen = [
            np.asarray(reset_to(jax.random.key(0), pose, goal, world)[0].ranges)
            for world in (wide, slim)
        ]
        difference = np.abs(np.subtract(*np.minimum(seen, 1 - 0.3 / MAX_RANGE))) * MAX_RANGE
        assert np.median(difference) < 0.03
        assert (difference < 0.1).mean() > 0.85


def test_reward_and_coverage_see_the_true_scan(maze_params) -> None:
    config = dataclasses.replace(maze_params.config, scan_margin=0.25)
    margin = dataclasses.replace(maze_params, config=config)
    pose = jnp.append(maze_params.spawn_positions[0, 0], 0.3)
    goal = maze_params.spawn_positions[1, 0]
    (seen, state), (thick, as_thick) = (
        reset_to(jax.random.key(0), pose, goal, world) for world in (maze_params, margin)
    )
    assert (thick.ranges < seen.ranges).mean() > 0.5
    np.testing.assert_array_equal(state.covered, as_thick.covered)
