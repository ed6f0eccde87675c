"""Forests: 17 x 17 m of asterisks."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sqn_jax.maps.kinds.placing import place_obstacles, uniform
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.maps.terrain import (
    SMALL_SIZE,
    Window,
    asterisk,
    finish_map,
    round_crooks,
    walled_square,
)


def forest(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Asterisks, close to each other; from the lower left to the upper right."""
    occupied = walled_square(SMALL_SIZE)
    keep_free = np.zeros_like(occupied)

    def draw() -> Callable[[float], Window]:
        center = (uniform(rng, 1.2, 15.8), uniform(rng, 1.2, 15.8))
        arms = 5 + int(rng.integers(3))
        turn = uniform(rng, 0, 2 * math.pi)
        angles = [turn + 2 * math.pi * (k + uniform(rng, -0.2, 0.2)) / arms for k in range(arms)]
        lengths = [uniform(rng, 0.8, 1.9) for _ in range(arms)]
        half_width = uniform(rng, 0.08, 0.14)
        return lambda margin: asterisk(SMALL_SIZE, center, angles, lengths, half_width + margin)

    place_obstacles(occupied, keep_free, draw, 20)
    occupied = round_crooks(occupied)
    return finish_map(name, occupied, [(1.5, 1.5), (15.5, 15.5)], spawn_count=40, clearance=0.5)
