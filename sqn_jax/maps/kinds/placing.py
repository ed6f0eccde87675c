"""Obstacles at random places in the open."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.terrain import Window

_GAP = 0.7  # m, at least, between two obstacles in the open
_TRIES = 400  # places tried for obstacles in the open


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(rng.random())


def place_obstacles(
    occupied: NDArray[np.bool_],
    keep_free: NDArray[np.bool_],
    draw: Callable[[], Callable[[float], Window]],
    most: int,
) -> None:
    """Add up to `most` obstacles to `occupied`, `_GAP` apart and none on `keep_free`.

    `draw` gives an obstacle at random: from a margin in m, its cells with so much around them.
    """
    placed = 0
    for _ in range(_TRIES):
        obstacle = draw()
        where, wide = obstacle(_GAP)
        if (occupied[where] & wide).any():
            continue
        where, cells = obstacle(0.0)
        if (keep_free[where] & cells).any():
            continue
        occupied[where] |= cells
        placed += 1
        if placed == most:
            return
