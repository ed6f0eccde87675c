"""Tracks: one course between rocks, straight legs at any angle, open or closed to a loop."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.kinds.placing import uniform
from sqn_jax.maps.kinds.plan import grow_tree, prune
from sqn_jax.maps.kinds.points import SMALL, draw_size, with_points
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.maps.terrain import RESOLUTION, asterisk, boxes

_LONGEST = 95.0  # m, about, from end to end of an open course


def track(name: str, rng: np.random.Generator) -> OccupancyMap:
    """A course around a random tree, of which pieces may be cut off or out.

    For each map are drawn: 12.5 or 25 m a side; a loop or, in one half, an open course with two
    dead ends; how wide it is, 0.8 to 2.4 m, with legs that differ by up to a third; how far its
    corners lie off a lattice, and how many are cut; nooks beside it, and posts in its middle.
    """
    size = draw_size(rng)
    side = int(rng.integers(2, 4) if size == SMALL else rng.integers(3, 5))
    pitch = size * RESOLUTION / (2 * side)
    nodes, is_loop = _draw_course(side, pitch, rng)
    half_width = uniform(rng, 0.4, min(1.2, 0.4 * pitch - 0.1))
    occupied = np.ones((size, size), dtype=bool)
    legs = list(pairwise([*nodes, nodes[0]] if is_loop else nodes))
    for start, end in legs:
        along = end - start
        leg = half_width * uniform(rng, 0.85, 1.0), math.hypot(*along)
        where, cells = asterisk(size, start, [math.atan2(along[1], along[0])], [leg[1]], leg[0])
        occupied[where] &= ~cells
    _add_nooks(occupied, legs, half_width, rng)
    _add_posts(occupied, legs, half_width, rng)
    return with_points(name, occupied)


def _draw_course(
    side: int, pitch: float, rng: np.random.Generator
) -> tuple[list[NDArray[np.float64]], bool]:
    """Corners (x, y) m in their order, and whether the last is joined to the first.

    Around a tree over side x side places runs a loop through the four corners of each.
    """
    edges = grow_tree(side, rng, last=0.8)
    edges, places = prune(edges, side, int(rng.integers(side * side // 3)), rng)
    cells = _around(edges, places, side)
    off = uniform(rng, 0.0, 0.22) * pitch
    corners = [(np.array(cell) + 0.5) * pitch + off * (2 * rng.random(2) - 1) for cell in cells]
    first = int(rng.integers(len(corners)))
    corners = corners[first:] + corners[:first]
    is_loop = rng.random() < 0.5
    if not is_loop:
        count = int(rng.integers(2 * len(corners) // 3, len(corners)))
        corners = corners[: min(count, int(_LONGEST / pitch))]
    cut = uniform(rng, 0.0, 0.3)
    inner = [corner for corner in corners[1:-1] if rng.random() >= cut]
    return [corners[0], *inner, corners[-1]], is_loop


def _around(edges: set[tuple[int, int]], places: set[int], side: int) -> list[tuple[int, int]]:
    """The loop around a tree: cells (col, row) of a grid twice as fine, in their order."""
    joined: dict[tuple[int, int], list[tuple[int, int]]] = {}

    def join(first: tuple[int, int], second: tuple[int, int]) -> None:
        joined.setdefault(first, []).append(second)
        joined.setdefault(second, []).append(first)

    for place in sorted(places):
        row, col = divmod(place, side)
        x, y = 2 * col, 2 * row
        for step, first, second in (
            (1, (x + 1, y), (x + 1, y + 1)),
            (side, (x, y + 1), (x + 1, y + 1)),
        ):
            beyond = (2, 0) if step == 1 else (0, 2)
            other = place + step
            if (place, other) in edges:
                # Two legs across the border instead of one along each side of it.
                for cell in (first, second):
                    join(cell, (cell[0] + beyond[0] // 2, cell[1] + beyond[1] // 2))
            else:
                join(first, second)
        if (place - 1, place) not in edges:
            join((x, y), (x, y + 1))
        if (place - side, place) not in edges:
            join((x, y), (x + 1, y))
    start = min(joined)
    course = [start, joined[start][0]]
    while True:
        following = [cell for cell in joined[course[-1]] if cell != course[-2]]
        if following[0] == start:
            return course
        course.append(following[0])


def _add_nooks(
    occupied: NDArray[np.bool_],
    legs: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    half_width: float,
    rng: np.random.Generator,
) -> None:
    """Places beside the course or around it that are wider, cut out of `occupied`."""
    often = uniform(rng, 0.0, 0.4)
    for start, end in legs:
        if rng.random() >= often:
            continue
        middle = start + uniform(rng, 0.25, 0.75) * (end - start)
        half = uniform(rng, half_width, 1.6 * half_width)
        off = uniform(rng, -half_width, half_width)
        turn = math.atan2(*(end - start)[::-1]) + (math.pi / 4 if rng.random() < 0.5 else 0.0)
        where, cells = boxes(
            len(occupied), middle, turn, [(-half * 0.7, half * 0.7, off - half, off + half)]
        )
        occupied[where] &= ~cells


def _add_posts(
    occupied: NDArray[np.bool_],
    legs: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    half_width: float,
    rng: np.random.Generator,
) -> None:
    """Posts on the course that leave 0.5 m on both sides, added to `occupied`."""
    widest = 0.85 * half_width - 0.5
    if widest < 0.05 or rng.random() < 0.5:
        return
    for start, end in legs:
        if rng.random() < 0.3:
            half = uniform(rng, 0.05, widest)
            middle = start + uniform(rng, 0.3, 0.7) * (end - start)
            turn = uniform(rng, 0.0, math.pi)
            side = half / math.sqrt(2)
            where, cells = boxes(len(occupied), middle, turn, [(-side, side, -side, side)])
            occupied[where] |= cells
