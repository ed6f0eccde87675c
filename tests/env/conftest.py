"""Maps and rollouts that several of the simulator's tests look at; each is made once."""

from __future__ import annotations

import numpy as np
import pytest
from grid_oracle import BOOLS, open_map, random_map, wrap_map
from rollouts import Rollout, run_robots

from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env
from sqn_jax.maps import OccupancyMap, load_map, sample_spawn_points


@pytest.fixture(scope="session")
def maze() -> OccupancyMap:
    """The project's maze, 340 x 340 cells."""
    return load_map("maze")


@pytest.fixture(scope="session")
def hall() -> OccupancyMap:
    """A hall of 10 m x 15 m, 200 rows and 300 columns: a wall, columns, pillars of one cell."""
    rng = np.random.default_rng(3)
    occupied = open_map(rows=200, columns=300)
    occupied[100:104, 60:200] = True
    for row, column in rng.integers(10, (185, 285), (18, 2)):
        occupied[row : row + 8, column : column + 8] = True
    occupied[rng.integers(0, 200, 25), rng.integers(0, 300, 25)] = True
    return wrap_map(occupied, sample_spawn_points(occupied, 0.05, 0.1, count=6))


@pytest.fixture(scope="session")
def thin_walls() -> OccupancyMap:
    """A map of 90 rows and 150 columns with walls one cell thick, along the axes and diagonal."""
    occupied = open_map(rows=90, columns=150)
    occupied[20:70, 40] = True
    occupied[45, 60:120] = True
    occupied[:60, 130] = True
    diagonal = np.arange(30)
    occupied[10 + diagonal, 80 + diagonal] = True
    # Beside the diagonal, so that no point slips through between two corners.
    occupied[10 + diagonal, 81 + diagonal] = True
    return wrap_map(occupied, [(1.0, 1.0), (5.0, 3.5), (7.0, 1.0), (3.0, 3.0)])


@pytest.fixture(scope="session")
def maze_params(maze: OccupancyMap) -> EnvParams:
    """The default robot in the maze."""
    return make_env(maze)


@pytest.fixture(scope="session")
def hall_params(hall: OccupancyMap) -> EnvParams:
    """The default robot in the hall."""
    return make_env(hall)


@pytest.fixture(scope="session")
def maze_rollout(maze_params: EnvParams) -> Rollout:
    """Whole episodes in the maze."""
    return run_robots(maze_params, seed=0, robots=16)


@pytest.fixture(scope="session")
def hall_rollout(hall_params: EnvParams) -> Rollout:
    """Whole episodes in the hall."""
    return run_robots(hall_params, seed=1, robots=16)


@pytest.fixture(
    scope="session",
    params=["maze", "hall", "thin walls, point robot, noise", "clutter, wide robot, noise"],
)
def any_rollout(request: pytest.FixtureRequest) -> tuple[BOOLS, float, Rollout]:
    """Occupied cells, robot radius m, and whole episodes, with and without noise."""
    if request.param == "maze":
        occupied = request.getfixturevalue("maze").occupied
        return occupied, 0.1, request.getfixturevalue("maze_rollout")
    if request.param == "hall":
        occupied = request.getfixturevalue("hall").occupied
        return occupied, 0.1, request.getfixturevalue("hall_rollout")
    if request.param.startswith("thin walls"):
        occupancy_map, radius = request.getfixturevalue("thin_walls"), 0.0
    else:
        occupied = random_map(seed=2, rows=160, columns=110, blocks=12, pillars=20)
        points = sample_spawn_points(occupied, 0.05, 0.25, count=6)
        occupancy_map, radius = wrap_map(occupied, points), 0.25
    params = make_env(occupancy_map, EnvConfig(robot_radius=radius, velocity_noise=0.3))
    return occupancy_map.occupied, radius, run_robots(params, seed=3, robots=32)
