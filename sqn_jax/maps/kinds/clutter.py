"""Clutter: posts and boxes close to each other in an open field."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sqn_jax.maps.kinds.placing import place_obstacles, uniform
from sqn_jax.maps.kinds.points import draw_size, with_points
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.maps.terrain import RESOLUTION, Window, boxes, disc, value_noise, walled_square

_POST = 3  # cells a side, 0.15 m
_RIM = 12  # cells at the border that stay free
_NARROW = 7  # cells; a gap between clumps of posts that is narrower is filled


def clutter(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Clumps of thin posts, or single posts and boxes.

    For each map are drawn: 12.5 or 25 m a side; and, in one half, clumps of posts 0.15 m wide that
    cover 5 to 18 % of a band across the field, with gaps of 0.35 m or more; in the other half
    posts of 0.05 to 0.25 m radius and boxes of 0.2 to 1.5 m at any angle, at least 0.4 to 1 m
    apart, as many as there is room for or half as many.
    """
    size = draw_size(rng)
    occupied = walled_square(size)
    if rng.random() < 0.5:
        occupied |= _draw_clumps(size, rng)
    else:
        _place_singles(occupied, rng)
    return with_points(name, occupied)


def _draw_clumps(size: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Posts on a lattice, bool [size, size]."""
    noise = value_noise(size, ((uniform(rng, 0.6, 1.5), 1.0), (0.3, 0.8)), rng)
    noise = noise[1::_POST, 1::_POST]
    threshold = np.quantile(noise, 1 - uniform(rng, 0.05, 0.18))
    first, last = uniform(rng, 0.0, 0.4), uniform(rng, 0.6, 1.0)
    across = np.arange(len(noise)) / len(noise)
    band = (across >= first) & (across <= last)
    posts = (noise > threshold) & (band[:, None] if rng.random() < 0.5 else band)
    clumps = posts.repeat(_POST, axis=0).repeat(_POST, axis=1)[:size, :size]
    occupied = np.zeros((size, size), dtype=bool)
    occupied[: len(clumps), : len(clumps)] = clumps
    closed = ndimage.minimum_filter(ndimage.maximum_filter(occupied, _NARROW), _NARROW)
    # The rim stays free, so that one can go around whatever stands in the field.
    inner = (slice(_RIM, -_RIM), slice(_RIM, -_RIM))
    occupied[:] = False
    occupied[inner] = closed[inner]
    return occupied


def _place_singles(occupied: NDArray[np.bool_], rng: np.random.Generator) -> None:
    """Posts and boxes, added to `occupied`."""
    size = len(occupied)
    side = size * RESOLUTION
    gap, posts = uniform(rng, 0.4, 1.0), rng.random()

    def draw() -> Callable[[float], Window]:
        center = (uniform(rng, 0.5, side - 0.5), uniform(rng, 0.5, side - 0.5))
        if rng.random() < posts:
            radius = uniform(rng, 0.05, 0.25)
            return lambda margin: disc(size, center, radius + margin)
        half, wide = uniform(rng, 0.1, 0.75), uniform(rng, 0.1, 0.4)
        turn = uniform(rng, 0.0, math.pi)
        sides = [(-half, half, -wide, wide)]
        return lambda margin: boxes(size, center, turn, sides, margin)

    most = round(uniform(rng, 0.3, 1.0) * side**2 / (gap + 0.4) ** 2 / 2)
    place_obstacles(occupied, np.zeros_like(occupied), draw, most, gap=gap, tries=3 * most)
