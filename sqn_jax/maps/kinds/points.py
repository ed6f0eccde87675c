"""Sizes of maps that differ from seed to seed, and the points that lie all over them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.distance import grid_path
from sqn_jax.maps.occupancy import OccupancyMap, cells_to_points, traversable
from sqn_jax.maps.terrain import RESOLUTION, ROBOT_RADIUS, clear_cells, fill_pockets, spread

SMALL, LARGE = 250, 500
"""Cells a side, 12.5 m and 25 m: four small maps fill a tile of a large one, and four large ones
that of a cave."""

_CLEARANCE = 0.2  # m from a point to the nearest obstacle, at least
_GROUND = 3.0  # m2 of it for each spawn point,
_FEWEST, _MOST = 16, 100  # within these limits
_STEPS_PER_M = 10  # of the longest path: at 0.25 m a step, 2.5 times as many as it takes
_FEWEST_STEPS = 400


def draw_size(rng: np.random.Generator) -> int:
    """Cells a side: `SMALL` more often than `LARGE`."""
    return SMALL if rng.random() < 0.6 else LARGE


def with_points(name: str, occupied: NDArray[np.bool_]) -> OccupancyMap:
    """The map with its pockets filled and spawn points spread over it.

    The two evaluation points (start, goal) are spawn points far from each other by path, and an
    episode is as long as that path asks for.

    Args:
        name: the map's name.
        occupied: bool [size, size].
    """
    occupied = fill_pockets(occupied)
    cells = clear_cells(occupied, _CLEARANCE)
    # Every other row and column: less to search, and 0.1 m are nothing to a spread of 1 m.
    cells = cells[(cells % 2 == 0).all(axis=1)]
    ground = np.count_nonzero(~occupied) * RESOLUTION**2
    points = spread(cells, min(max(round(ground / _GROUND), _FEWEST), _MOST))
    free = traversable(occupied, RESOLUTION, ROBOT_RADIUS)
    goal = points[grid_path(free, points[0], points).argmax()]
    steps = grid_path(free, goal, points)
    start = points[steps.argmax()]
    longest = float(steps.max()) * RESOLUTION
    return OccupancyMap(
        name=name,
        occupied=occupied,
        resolution=RESOLUTION,
        spawn_points=cells_to_points(points, RESOLUTION).round(3),
        evaluation_points=cells_to_points(np.array([start, goal]), RESOLUTION).round(3),
        spawn_radius=0.5,
        max_steps=max(_FEWEST_STEPS, 100 * math.ceil(longest * _STEPS_PER_M / 100)),
    )
