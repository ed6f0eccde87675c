"""The covered area against a dense lattice of points, and against areas known in closed form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import open_map, random_map, seen_areas, wrap_map
from rollouts import Rollout

from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env, reset_to, step
from sqn_jax.env.coverage import Lattice, add_scan, area, empty
from sqn_jax.maps import OccupancyMap, sample_spawn_points

start_at = jax.jit(reset_to)
FINE = EnvConfig(coverage_cell=0.05, max_steps=100)


def covered_area(covered: np.ndarray, cell: float) -> np.ndarray:
    """Area of coverages [..., words, groups, group_rows], m2."""
    return bits(covered).sum(axis=(-1, -2, -3, -4), dtype=np.int64) * cell**2


def bits(covered: np.ndarray) -> np.ndarray:
    """Coverages [..., words, groups, group_rows] as booleans [..., 32], the lowest bit first."""
    return (np.asarray(covered)[..., None] >> np.arange(32, dtype=np.uint32) & 1).astype(bool)


@pytest.mark.parametrize("place", ["maze", "hall"])
def test_the_area_of_whole_episodes_is_within_two_percent_of_a_dense_brute_force(
    place: str, request: pytest.FixtureRequest
) -> None:
    occupancy_map: OccupancyMap = request.getfixturevalue(place)
    params: EnvParams = request.getfixturevalue(f"{place}_params")
    run: Rollout = request.getfixturevalue(f"{place}_rollout")
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
    hall_rollout: Rollout, hall_params: EnvParams
) -> None:
    area = covered_area(hall_rollout.covered, hall_params.config.coverage_cell)
    growth = hall_rollout.info["covered_area"]
    np.testing.assert_allclose(growth, np.diff(area, axis=1), atol=1e-3)
    assert np.all(growth >= 0)
    forgotten = hall_rollout.covered[:, :-1] & ~hall_rollout.covered[:, 1:]
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


@pytest.mark.parametrize(
    ("field_of_view_deg", "num_beams", "cell"),
    [(350, 71, 0.325), (350, 71, 0.05), (90, 5, 0.1), (359, 12, 0.2), (200, 3, 0.1), (5, 2, 0.05)],
)
def test_the_points_marked_are_those_that_are_seen(
    field_of_view_deg: float, num_beams: int, cell: float
) -> None:
    """Point by point, anywhere on a map that is not square, for sensors of all kinds."""
    view = np.deg2rad(field_of_view_deg)
    lattice = Lattice.over(9.0, 17.0, cell, 5.0)
    x, y = np.moveaxis(lattice.points(), -1, 0)
    on_map = (x >= 0) & (x < 17) & (y >= 0) & (y < 9)
    mark = jax.jit(
        lambda pose, ranges: add_scan(
            empty(lattice), pose, ranges, field_of_view=view, lattice=lattice
        )
    )
    rng = np.random.default_rng(num_beams)
    wrong, seen = 0, 0
    for turn in range(25):
        pose = rng.uniform([0, 0, -9], [17, 9, 9]).astype(np.float32)
        long = np.full(num_beams, rng.uniform(2, 5))
        ranges = (long if turn % 3 == 0 else rng.uniform(0.1, 5, num_beams)).astype(np.float32)
        covered, fresh = mark(pose, ranges)
        bearing = np.arctan2(y - float(pose[1]), x - float(pose[0])) - float(pose[2])
        bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
        nearest = np.rint((bearing + view / 2) / view * (num_beams - 1)).astype(int)
        reading = ranges[np.clip(nearest, 0, num_beams - 1)]
        distance = np.hypot(x - float(pose[0]), y - float(pose[1]))
        truth = (np.abs(bearing) <= view / 2) & (distance <= reading) & on_map
        wrong += np.sum(bits(covered) != truth)
        seen += truth.sum()
        assert fresh == pytest.approx(bits(covered).sum() * cell**2, rel=1e-5)
        assert area(covered, cell) == pytest.approx(bits(covered).sum() * cell**2, rel=1e-5)
    assert seen > 200
    # A point on the very edge of a sector, in single precision.
    assert wrong <= max(1, seen // 20_000)


def test_the_points_of_a_lattice_fill_the_map_evenly() -> None:
    """Each stands for a square of the lattice's cell; the map's corners are within."""
    points = Lattice.over(6.0, 11.0, 0.2, 5.0).points()
    x, y = points[..., 0], points[..., 1]
    for left, bottom, width, height in ((0, 0, 11, 6), (0, 0, 2, 2), (9, 4, 2, 2), (4, 1, 3, 4)):
        inside = (left <= x) & (x < left + width) & (bottom <= y) & (y < bottom + height)
        assert inside.sum() * 0.2**2 == pytest.approx(width * height, rel=0.03)
    assert len(np.unique(points.reshape(-1, 2).round(6), axis=0)) == x.size


def test_no_wall_along_an_axis_runs_beside_a_row_of_points() -> None:
    """The area left of a wall must not jump with the wall: 8 m long, moved by millimetres."""
    points = Lattice.over(8.0, 8.0, 0.325, 5.0).points()
    for axis in (0, 1):
        walls = np.linspace(3, 5, 400)
        inside = np.all((points >= 0) & (points < 8), axis=-1)
        count = np.array([np.sum(inside & (points[..., axis] < wall)) for wall in walls])
        # The lattice of a row a cell would be off by up to 0.16 m x 8 m = 1.3 m2.
        assert np.max(np.abs(count * 0.325**2 - walls * 8)) < 0.65
