"""The covered area against a dense lattice of points, and against areas known in closed form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from driving import Drive
from grid_oracle import open_map, random_map, scan, seen_areas, sees, wrap_map

from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env, reset_to, step
from sqn_jax.env.geometry import polynomial_arctan2
from sqn_jax.maps import OccupancyMap, sample_spawn_points

start_at = jax.jit(reset_to)
FINE = EnvConfig(coverage_cell=0.05, max_steps=100)


def covered_area(covered: np.ndarray, cell: float) -> np.ndarray:
    """Area of coverages [..., rows, bytes], m2."""
    return np.unpackbits(covered, axis=-1).sum(axis=(-1, -2), dtype=np.int64) * cell**2


@pytest.mark.parametrize("place", ["maze", "hall"])
def test_the_area_of_whole_episodes_is_within_two_percent_of_a_dense_brute_force(
    place: str, request: pytest.FixtureRequest
) -> None:
    occupancy_map: OccupancyMap = request.getfixturevalue(place)
    params: EnvParams = request.getfixturevalue(f"{place}_params")
    run: Drive = request.getfixturevalue(f"{place}_drive")
    error = []
    # Half of the robots act at random, half wander; two of each are looked at.
    for robot in (0, 1, -2, -1):
        truth = seen_areas(occupancy_map.occupied, 0.05, run.poses[robot])
        area = covered_area(run.covered[robot], params.config.coverage_cell)
        error.append(area[-1] / truth[-1] - 1)
        # Along the way the area is close too; while it is small, nine cells are more than 2 %.
        np.testing.assert_allclose(area, truth, rtol=0.02, atol=1.0)
        growth = run.info["covered_area"][robot].sum()
        assert area[0] + growth == pytest.approx(area[-1], rel=1e-4)
    assert np.max(np.abs(error)) < 0.02
    assert np.mean(np.abs(error)) < 0.01


def test_the_growth_of_a_step_is_the_area_added_to_the_coverage(
    hall_drive: Drive, hall_params: EnvParams
) -> None:
    area = covered_area(hall_drive.covered, hall_params.config.coverage_cell)
    growth = hall_drive.info["covered_area"]
    np.testing.assert_allclose(growth, np.diff(area, axis=1), atol=1e-3)
    assert np.all(growth >= 0)
    forgotten = hall_drive.covered[:, :-1] & ~hall_drive.covered[:, 1:]
    assert not forgotten.any()


def test_in_the_open_a_scan_sees_a_disc_without_the_blind_wedge_and_a_turn_adds_the_wedge() -> None:
    # 13 m x 11 m, nothing within 5 m of the robot.
    params = make_env(wrap_map(open_map(220, 260), [(6.5, 5.5), (7.0, 5.5)]), FINE)
    key = jax.random.key(0)
    start = jnp.array([6.5, 5.5, 0.4])
    _, state = start_at(key, start, jnp.array([7.0, 5.5]), params)
    # pi r^2 x 350 / 360 = 3.14159 x 25 x 0.97222 = 76.36 m2.
    assert covered_area(np.asarray(state.covered), 0.05) == pytest.approx(76.36, rel=0.005)
    turn_left = jax.jit(step)
    _, state, _, _, _, info = turn_left(key, state, jnp.int32(3), params)
    # The turn is 18 degrees, the wedge 10: pi r^2 x 10 / 360 = 2.18 m2.
    assert info["covered_area"] == pytest.approx(2.18, rel=0.03)
    _, state, _, _, _, info = turn_left(key, state, jnp.int32(3), params)
    assert info["covered_area"] == 0.0


def test_scans_in_every_corner_of_the_map_agree_with_a_dense_brute_force() -> None:
    # 4 m x 7 m: the window of a scan hangs over the map's edges on all sides.
    occupied = random_map(seed=9, rows=80, columns=140, blocks=0, pillars=12)
    places = [(0.3, 0.3), (6.7, 0.3), (0.3, 3.7), (6.7, 3.7), (3.5, 2.0)]
    params = make_env(wrap_map(occupied, sample_spawn_points(occupied, 0.05, 0.1, 2)), FINE)
    for x, y in places:
        for heading in (-2.0, 0.1, 1.0):
            pose = np.array([x, y, heading], np.float32)
            _, state = start_at(jax.random.key(0), pose, jnp.array([1.0, 1.0]), params)
            truth = seen_areas(occupied, 0.05, pose[None], spacing=0.02)[0]
            assert covered_area(np.asarray(state.covered), 0.05) == pytest.approx(truth, rel=0.02)


def test_no_edge_of_what_is_in_range_is_lost_with_coarse_cells() -> None:
    # Cells of 1 m are coarse for one scan, but right on average over many places: a lost row or
    # column at the edge would take a segment of the disc, 1.5 m2.
    params = make_env(
        wrap_map(open_map(260, 400), [(6.5, 6.5), (7.0, 6.5)]), EnvConfig(coverage_cell=1.0)
    )
    rng = np.random.default_rng(2)
    low, high = [10.5, 5.5, -np.pi], [13.5, 7.5, np.pi]
    # x so that the scan begins in the last columns of a byte of eight, too.
    poses = rng.uniform(low, high, (400, 3))
    _, states = jax.jit(jax.vmap(reset_to, in_axes=(None, 0, None, None)))(
        jax.random.key(0), jnp.asarray(poses, jnp.float32), jnp.array([7.0, 5.5]), params
    )
    assert covered_area(np.asarray(states.covered), 1.0).mean() == pytest.approx(76.36, abs=0.6)


def test_the_cells_marked_are_those_that_are_seen() -> None:
    # Which bit stands for which place: x runs along the bytes, the highest bit is not the first.
    occupied = random_map(seed=9, rows=80, columns=140, blocks=3, pillars=12)
    params = make_env(wrap_map(occupied, sample_spawn_points(occupied, 0.05, 0.1, 2)), FINE)
    row, column = np.argwhere(~occupied)[1700]
    pose = np.array([(column + 0.5) * 0.05, (row + 0.5) * 0.05, 0.7], np.float32)
    _, state = start_at(jax.random.key(0), pose, jnp.array([1.0, 1.0]), params)
    marked = np.unpackbits(np.asarray(state.covered), axis=-1, bitorder="little")[:80, :140]
    # A cell's sample point lies somewhere in it; cells seen, or not, at all four corners are sure.
    x, y = np.meshgrid(np.arange(141) * 0.05, np.arange(81) * 0.05)
    corner = sees(pose.astype(float), scan(occupied, 0.05, pose), x, y)
    count = corner[1:, 1:].astype(int) + corner[1:, :-1] + corner[:-1, 1:] + corner[:-1, :-1]
    assert marked[count == 4].mean() > 0.995
    assert marked[count == 0].mean() < 0.005
    assert (count == 4).sum() > 1000
    assert (count == 0).sum() > 1000


def test_the_quick_arctangent_is_the_arctangent() -> None:
    rng = np.random.default_rng(0)
    y, x = rng.normal(size=(2, 100_000)) * 10.0 ** rng.integers(-3, 3, (2, 100_000))
    got = np.asarray(polynomial_arctan2(jnp.asarray(y, jnp.float32), jnp.asarray(x, jnp.float32)))
    np.testing.assert_allclose(got, np.arctan2(y, x), atol=2.1e-5)
    axes = jnp.array([0.0, 1.0, 0.0, -1.0]), jnp.array([1.0, 0.0, -1.0, 0.0])
    np.testing.assert_allclose(
        polynomial_arctan2(*axes), [0, np.pi / 2, np.pi, -np.pi / 2], atol=2.1e-5
    )
    assert np.isfinite(polynomial_arctan2(jnp.float32(0), jnp.float32(0)))
