"""Range readings against a traversal of the grid, cell by cell."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import BEAMS, BOOLS, FLOATS, cast, longest_reading, open_map, random_map, wrap_map

from sqn_jax.env import make_env, true_ranges
from sqn_jax.env.raycast import cast_fan, cast_rays
from sqn_jax.maps import OccupancyMap, load_map, sample_spawn_points

BEAMS32 = BEAMS.astype(np.float32)


class Scans(NamedTuple):
    """Poses [P, 3] on a map and the readings [P, 71] there."""

    occupied: BOOLS
    resolution: float
    poses: FLOATS
    readings: FLOATS

    def angles(self) -> FLOATS:
        """Direction of each beam in the grid frame, [P, 71]."""
        return self.poses[:, 2:] + BEAMS


def scan_at(occupancy_map: OccupancyMap, poses: FLOATS) -> Scans:
    params = make_env(occupancy_map)
    poses32 = poses.astype(np.float32)
    readings = jax.jit(jax.vmap(true_ranges, in_axes=(0, None)))(poses32, params)
    return Scans(
        occupancy_map.occupied,
        occupancy_map.resolution,
        poses32.astype(np.float64),
        np.asarray(readings, np.float64),
    )


def random_poses(occupied: BOOLS, resolution: float, count: int) -> FLOATS:
    rng = np.random.default_rng(4)
    free = np.argwhere(~occupied)
    cells = free[rng.integers(0, len(free), count)][:, ::-1]
    places = (cells + rng.uniform(0.001, 0.999, (count, 2))) * resolution
    return np.column_stack([places, rng.uniform(-np.pi, np.pi, count)])


@pytest.fixture(scope="module", params=["maze", "wide", "tall", "coarse", "fine"])
def scans(request: pytest.FixtureRequest, maze: OccupancyMap, hall: OccupancyMap) -> Scans:
    if request.param == "maze":
        occupancy_map = maze
    elif request.param == "wide":
        occupancy_map = hall
    else:
        resolution = {"tall": 0.05, "coarse": 0.1, "fine": 0.025}[request.param]
        occupied = random_map(seed=6, rows=230, columns=130, blocks=25, pillars=60)
        points = sample_spawn_points(occupied, resolution, 0.1, count=2)
        occupancy_map = wrap_map(occupied, points, resolution)
    poses = random_poses(occupancy_map.occupied, occupancy_map.resolution, 300)
    return scan_at(occupancy_map, poses)


def test_readings_agree_with_a_cell_by_cell_traversal(scans: Scans) -> None:
    truth = cast(
        scans.occupied, scans.resolution, scans.poses[:, :1], scans.poses[:, 1:2], scans.angles()
    )
    error = np.abs(scans.readings - truth)
    assert np.median(error) < 0.01
    assert np.mean(error < 0.05) > 0.99
    # Not part of the promise, but the rest are rays cut short: what is not, is exact.
    assert np.mean(error < 0.001) > 0.985


def test_no_reading_is_longer_than_the_truth(scans: Scans) -> None:
    truth = longest_reading(
        scans.occupied, scans.resolution, scans.poses[:, :1], scans.poses[:, 1:2], scans.angles()
    )
    assert np.max(scans.readings - truth) < 0.001


def test_readings_close_to_cell_borders_are_neither_long_nor_lost(hall: OccupancyMap) -> None:
    rng = np.random.default_rng(5)
    poses = random_poses(hall.occupied, 0.05, 400)
    inset = rng.choice([1e-4, 1e-3], (400, 2))
    far_side = rng.integers(0, 2, (400, 2))
    cell = np.floor(poses[:, :2] / 0.05)
    poses[:, :2] = (cell + far_side) * 0.05 + np.where(far_side, -inset, inset)
    scans = scan_at(hall, poses)
    x, y = scans.poses[:, :1], scans.poses[:, 1:2]
    truth = cast(scans.occupied, 0.05, x, y, scans.angles())
    longest = longest_reading(scans.occupied, 0.05, x, y, scans.angles())
    assert np.mean(np.abs(scans.readings - truth) < 0.05) > 0.99
    assert np.max(scans.readings - longest) < 0.001


def test_rays_along_axes_and_diagonals_stop_at_the_first_occupied_cell(
    hall: OccupancyMap,
) -> None:
    grid = make_env(hall).sight
    rng = np.random.default_rng(6)
    free = np.argwhere(~hall.occupied)
    cells = free[rng.integers(0, len(free), 200)]
    centres = ((cells[:, ::-1] + 0.5) * 0.05).astype(np.float32)
    # Turns beyond one revolution are as good. Beside a wall a ray hops by two cells only: 120 hops
    # are enough for any.
    angles = jnp.arange(-8, 17) * (jnp.pi / 4)
    readings = jax.jit(
        jax.vmap(lambda place: cast_rays(grid, place, angles, max_range=5.0, iterations=120))
    )(centres)
    for i, turn in enumerate(range(-8, 17)):
        d_column, d_row = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)][
            turn % 8
        ]
        diagonal = np.hypot(d_column, d_row)
        for (row, column), reading in zip(cells, np.asarray(readings)[:, i], strict=True):
            steps = 0
            while not hall.occupied[row + steps * d_row, column + steps * d_column]:
                steps += 1
            # From the centre of the first cell to the near side, or corner, of the last.
            expected = min((steps - 0.5) * diagonal * 0.05, 5.0)
            assert reading == pytest.approx(expected, abs=1e-4)


def test_rays_that_graze_borders_far_from_the_corner_of_the_map_go_on() -> None:
    """Within two degrees of an axis, up to 51 m from the map's corner."""
    cave = load_map("cave")
    grid = make_env(cave).sight
    rng = np.random.default_rng(7)
    free = np.argwhere(~cave.occupied)
    cells = free[rng.integers(0, len(free), 1500), ::-1]
    places = np.float32((cells + rng.uniform(0.01, 0.99, (1500, 2))) * 0.05)
    quarter = rng.integers(0, 4, (1500, 1)) * (np.pi / 2)
    angles = np.float32(quarter + rng.uniform(-0.035, 0.035, (1500, 8)))
    cast_all = jax.vmap(lambda at, turn: cast_rays(grid, at, turn, max_range=5.0, iterations=8))
    readings = np.asarray(jax.jit(cast_all)(places, angles))
    x, y = np.float64(places[:, :1]), np.float64(places[:, 1:])
    truth = cast(cave.occupied, 0.05, x, y, np.float64(angles))
    np.testing.assert_allclose(readings, truth, atol=0.05)


def test_a_fan_of_beams_reads_what_single_rays_read(hall: OccupancyMap) -> None:
    grid = make_env(hall).sight
    poses = random_poses(hall.occupied, 0.05, 200).astype(np.float32)
    fan = jax.vmap(lambda pose: cast_fan(grid, pose, BEAMS32, max_range=5.0, iterations=8))(poses)
    rays = jax.vmap(
        lambda pose: cast_rays(grid, pose[:2], pose[2] + BEAMS32, max_range=5.0, iterations=8)
    )(poses)
    # An edge that one of two directions, a ten-millionth of a turn apart, just misses.
    assert np.mean(np.abs(np.asarray(fan) - np.asarray(rays)) < 1e-3) > 0.999


def test_beams_run_from_the_rightmost_to_the_leftmost() -> None:
    # A room of 4 m x 2 m inside; the robot at (1, 0.5) looks along +x, the walls begin at 0.05 m.
    occupied = open_map(rows=42, columns=82)
    occupancy_map = wrap_map(occupied, [(1.0, 0.525), (3.0, 1.0)])
    readings = scan_at(occupancy_map, np.array([[1.0, 0.525, 0.0]])).readings[0]
    # Beam i looks 5 i - 175 degrees to the left: 17 is -90, 35 is 0, 53 is +90 degrees.
    assert readings[17] == pytest.approx(0.525 - 0.05, abs=1e-5)
    assert readings[35] == pytest.approx(81 * 0.05 - 1.0, abs=1e-5)
    assert readings[53] == pytest.approx(41 * 0.05 - 0.525, abs=1e-5)


def test_nothing_within_range_reads_the_maximal_range() -> None:
    occupancy_map = wrap_map(open_map(rows=230, columns=280), [(7.0, 5.75), (7.0, 6.0)])
    readings = scan_at(occupancy_map, np.array([[7.0, 5.75, 0.3]])).readings
    np.testing.assert_allclose(readings, 5.0, rtol=1e-6)


def test_a_ray_that_needs_more_hops_than_allowed_is_cut_short(hall: OccupancyMap) -> None:
    params = make_env(hall)
    poses = random_poses(hall.occupied, 0.05, 100).astype(np.float32)
    angles = poses[:, 2:] + BEAMS.astype(np.float32)
    x, y = poses[:, :1], poses[:, 1:2]
    truth = longest_reading(hall.occupied, 0.05, x, y, angles.astype(np.float64))
    shorter = np.zeros_like(truth)
    for iterations in (1, 2, 4):
        readings = jax.vmap(
            lambda place, angles, iterations=iterations: cast_rays(
                params.sight, place, angles, max_range=5.0, iterations=iterations
            )
        )(poses[:, :2], angles)
        assert np.max(readings - truth) < 0.001
        assert np.all(readings >= shorter)
        shorter = np.asarray(readings)
    assert np.mean(shorter < truth - 0.05) > 0.001
