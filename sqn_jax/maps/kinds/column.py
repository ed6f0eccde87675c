"""Columns: 17 x 17 m, round pillars around an open middle."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sqn_jax.maps.kinds.placing import place_obstacles, uniform
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.maps.terrain import SMALL_SIZE, Window, disc, finish_map, walled_square


def column(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Round pillars of all sizes around an open middle; from the upper left to the lower right."""
    occupied = walled_square(SMALL_SIZE)
    keep_free = np.zeros_like(occupied)
    where, cells = disc(SMALL_SIZE, (8.5, 8.5), 3.2)
    keep_free[where] = cells

    def draw() -> Callable[[float], Window]:
        center = (uniform(rng, 1, 16), uniform(rng, 1, 16))
        radius = uniform(rng, 0.25, 1.0)
        return lambda margin: disc(SMALL_SIZE, center, radius + margin)

    place_obstacles(occupied, keep_free, draw, 26)
    return finish_map(name, occupied, [(1.5, 15.5), (15.5, 1.5)], spawn_count=40, clearance=0.6)
