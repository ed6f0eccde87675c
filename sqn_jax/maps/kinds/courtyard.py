"""Courtyards: open ground around and between buildings, with yards that are traps."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.kinds.placing import in_cells, place_obstacles, uniform
from sqn_jax.maps.kinds.points import LARGE, SMALL, with_points
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.maps.terrain import RESOLUTION, Window, boxes, disc, walled_square

Sides = tuple[float, float, float, float]
"""Of a box: left, right, bottom, top, m."""


def courtyard(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Buildings shaped as blocks, L, U, E and rings with a gate, and trees between them.

    For each map are drawn: 25 m a side, 12.5 m in one of four; blocks at its rim in one half; 4 to
    14 buildings of 1 to 9 m a side, along the axes or at any angle, at least 0.8 to 2 m apart, with
    wings of 0.15 m (a mere wall) to 2 m; gates of 0.7 to 2 m; up to 25 trees.
    """
    size = SMALL if rng.random() < 0.25 else LARGE
    occupied = walled_square(size)
    if rng.random() < 0.5:
        _add_blocks(occupied, rng)
    side = size * RESOLUTION
    gap = uniform(rng, 0.8, 2.0)
    turned = rng.random() < 0.5

    def draw_building() -> Callable[[float], Window]:
        center = (uniform(rng, 1.0, side - 1.0), uniform(rng, 1.0, side - 1.0))
        walls = _draw_building(rng)
        quarters = int(rng.integers(4))
        turn = uniform(rng, 0.0, 2 * math.pi) if turned else quarters * math.pi / 2
        outline = _outline(walls)
        return lambda margin: boxes(size, center, turn, outline if margin else walls, margin)

    def draw_tree() -> Callable[[float], Window]:
        center = (uniform(rng, 0.5, side - 0.5), uniform(rng, 0.5, side - 0.5))
        radius = uniform(rng, 0.1, 0.35)
        return lambda margin: disc(size, center, radius + margin)

    keep_free = np.zeros_like(occupied)
    place_obstacles(occupied, keep_free, draw_building, int(rng.integers(4, 15)), gap=gap)
    place_obstacles(occupied, keep_free, draw_tree, int(rng.integers(26)), tries=80)
    return with_points(name, occupied)


def _add_blocks(occupied: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """One to four blocks at the rim, added to `occupied`."""
    size = len(occupied)
    for _ in range(int(rng.integers(1, 5))):
        length = in_cells(rng, 0.15 * size * RESOLUTION, 0.4 * size * RESOLUTION)
        depth = in_cells(rng, 1.0, 0.25 * size * RESOLUTION)
        first = int(rng.integers(size - length))
        turned = np.rot90(occupied, int(rng.integers(4)))  # A view.
        turned[:depth, first : first + length] = True


def _outline(walls: list[Sides]) -> list[Sides]:
    """The box around all."""
    left, right, bottom, top = np.array(walls).T
    return [(float(left.min()), float(right.max()), float(bottom.min()), float(top.max()))]


def _draw_building(rng: np.random.Generator) -> list[Sides]:
    """The boxes of a building around (0, 0); its yard opens upwards."""
    x, y = uniform(rng, 1.0, 4.5), uniform(rng, 1.0, 4.5)  # Half its sides.
    wing = uniform(rng, 0.15, min(2.0, 2 * min(x, y) - 1.0) if rng.random() < 0.5 else 0.35)
    wing = min(wing, (2 * x - 1.0) / 2)
    back, left, right = (-x, x, -y, -y + wing), (-x, -x + wing, -y, y), (x - wing, x, -y, y)
    shape = int(rng.integers(5))
    if shape == 0:
        return [(-x / 2, x / 2, -y / 2, y / 2)]
    if shape == 1:
        return [back, left]
    if shape == 2:
        return [back, left, (x - wing, x, -y, uniform(rng, -y + wing, y))]
    if shape == 3 and 2 * x > 3 * wing + 2.0:
        return [back, left, right, (-wing / 2, wing / 2, -y, uniform(rng, 0.0, y))]
    gate = uniform(rng, 0.7, min(2.0, 2 * (x - wing)))
    place = uniform(rng, -x + wing, x - wing - gate)
    front = [(-x, place, y - wing, y), (place + gate, x, y - wing, y)]
    return [back, left, right, *front]
