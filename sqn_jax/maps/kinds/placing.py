"""Obstacles at random places in the open."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.terrain import RESOLUTION, Window


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two, each as likely."""
    return low + (high - low) * float(rng.random())


def in_cells(rng: np.random.Generator, low: float, high: float) -> int:
    """A length between two in m, in whole cells."""
    return round(uniform(rng, low, high) / RESOLUTION)


def place_obstacles(
    occupied: NDArray[np.bool_],
    keep_free: NDArray[np.bool_],
    draw: Callable[[], Callable[[float], Window]],
    most: int,
    *,
    gap: float = 0.7,
    tries: int = 400,
) -> None:
    """Add up to `most` obstacles to `occupied`, some way apart and none on `keep_free`.

    Args:
        occupied: bool [size, size], changed in place.
        keep_free: bool [size, size].
        draw: gives an obstacle at random: from a margin in m, its cells with so much around them.
        most: how many are added at most.
        gap: m, at least, from an obstacle to what stands already.
        tries: how many are drawn at most.
    """
    placed = 0
    for _ in range(tries):
        obstacle = draw()
        where, wide = obstacle(gap)
        if (occupied[where] & wide).any():
            continue
        where, cells = obstacle(0.0)
        if (keep_free[where] & cells).any():
            continue
        occupied[where] |= cells
        placed += 1
        if placed == most:
            return
