"""Maps and drives that several of the simulator's tests look at; each is made once."""

from __future__ import annotations

import numpy as np
import pytest
from driving import Drive, drive
from grid_oracle import BOOLS, random_map, wrap_map

from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env
from sqn_jax.maps import OccupancyMap, load_map, sample_spawn_points


@pytest.fixture(scope="session")
def maze() -> OccupancyMap:
    """The project's maze, 340 x 340 cells."""
    return load_map("maze")


@pytest.fixture(scope="session")
def cluttered() -> OccupancyMap:
    """A map of 120 rows and 210 columns with blocks and pillars of one cell."""
    occupied = random_map(seed=0, rows=120, columns=210, blocks=25, pillars=60)
    return wrap_map(occupied, sample_spawn_points(occupied, 0.05, 0.1, count=6))


@pytest.fixture(scope="session")
def thin_walls() -> OccupancyMap:
    """A map of 90 rows and 150 columns with walls one cell thick, along the axes and diagonal."""
    occupied = np.zeros((90, 150), bool)
    occupied[[0, -1]] = True
    occupied[:, [0, -1]] = True
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
def cluttered_params(cluttered: OccupancyMap) -> EnvParams:
    """The default robot on the cluttered map."""
    return make_env(cluttered)


@pytest.fixture(scope="session")
def maze_drive(maze_params: EnvParams) -> Drive:
    """Whole episodes in the maze."""
    return drive(maze_params, seed=0, robots=16)


@pytest.fixture(scope="session")
def cluttered_drive(cluttered_params: EnvParams) -> Drive:
    """Whole episodes on the cluttered map."""
    return drive(cluttered_params, seed=1, robots=16)


@pytest.fixture(
    scope="session",
    params=["maze", "clutter", "thin walls, point", "thin walls, noise", "clutter, wide, noise"],
)
def any_drive(request: pytest.FixtureRequest) -> tuple[BOOLS, float, Drive]:
    """Occupied cells, robot radius m, and whole episodes, with and without noise."""
    if request.param == "maze":
        occupied = request.getfixturevalue("maze").occupied
        return occupied, 0.1, request.getfixturevalue("maze_drive")
    if request.param == "clutter":
        occupied = request.getfixturevalue("cluttered").occupied
        return occupied, 0.1, request.getfixturevalue("cluttered_drive")
    noise = 0.3 if "noise" in request.param else 0.0
    if request.param.startswith("thin walls"):
        occupancy_map, radius = request.getfixturevalue("thin_walls"), 0.0
    else:
        occupied = random_map(seed=2, rows=160, columns=110, blocks=12, pillars=20)
        points = sample_spawn_points(occupied, 0.05, 0.25, count=6)
        occupancy_map, radius = wrap_map(occupied, points), 0.25
    params = make_env(occupancy_map, EnvConfig(robot_radius=radius, velocity_noise=noise))
    return occupancy_map.occupied, radius, drive(params, seed=3, robots=32)
