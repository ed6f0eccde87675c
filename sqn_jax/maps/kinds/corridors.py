"""Corridors: narrow or wide, between thin or thick walls, with turns back and dead ends."""

from __future__ import annotations

import math

import numpy as np

from sqn_jax.maps.kinds.placing import in_cells, uniform
from sqn_jax.maps.kinds.plan import Edge, add_loops, grow_tree, path_lengths, prune
from sqn_jax.maps.kinds.points import SMALL, draw_size, with_points
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.maps.terrain import RESOLUTION

_NARROWEST, _WIDEST = 0.6, 2.0  # m, a corridor
_LONGEST_PATH = 100.0  # m, along the middle of the corridors


def corridors(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Corridors on a plan of rows and columns.

    For each map are drawn: 12.5 or 25 m a side; corridors of 0.6 to 2 m, all alike or differing up
    to twofold; walls of 0.1 to 1 m, half of them below 0.25 m; how often corridors run on straight
    and how often they branch, from one long path to many short dead ends; in one half, how much is
    left out, up to a third; how many loops there are, none in two of five.

    Walls are thicker and corridors wider where the plan would have more than 14 (or, at 25 m, 20)
    rows.
    """
    size = draw_size(rng)
    side, wall = _draw_pitch(size, rng)
    pitch = size * RESOLUTION / side
    widths = _draw_widths(size - (side + 1) * wall, side, rng)
    starts = wall + np.append(0, np.cumsum(widths + wall)[:-1])
    edges = _draw_plan(side, pitch, rng)
    occupied = np.ones((size, size), dtype=bool)
    for place, other in sorted(edges):
        (row, col), (other_row, other_col) = divmod(place, side), divmod(other, side)
        rows = slice(starts[row], starts[other_row] + widths[other_row])
        occupied[rows, starts[col] : starts[other_col] + widths[other_col]] = False
    return with_points(name, occupied)


def _draw_pitch(size: int, rng: np.random.Generator) -> tuple[int, int]:
    """How many rows there are, and as many columns; and how thick walls are, in cells."""
    width = uniform(rng, _NARROWEST + 0.1, _WIDEST)
    wall = in_cells(rng, 0.1, 0.25) if rng.random() < 0.5 else in_cells(rng, 0.25, 1.0)
    side = round((size - wall) / (width / RESOLUTION + wall))
    side = min(max(side, 4), 14 if size == SMALL else 20)
    # What is too wide for a corridor goes to the walls.
    widest = round(_WIDEST / RESOLUTION)
    return side, max(wall, math.ceil((size - side * widest) / (side + 1)))


def _draw_plan(side: int, pitch: float, rng: np.random.Generator) -> set[Edge]:
    """What joins the places of the plan; loops are added until no path is too long."""
    edges = grow_tree(side, rng, last=uniform(rng, 0.2, 1.0), straight=uniform(rng, 0.0, 0.8))
    left_out = 0 if rng.random() < 0.5 else int(rng.integers(side * side // 3))
    edges, places = prune(edges, side, left_out, rng)
    loops = 0 if rng.random() < 0.4 else int(rng.integers(1, side * side // 8 + 1))
    edges = add_loops(edges, places, side, loops, rng)
    while True:
        lengths = path_lengths(edges, dict.fromkeys(edges, pitch), side * side)
        if lengths[np.isfinite(lengths)].max() <= _LONGEST_PATH:
            return edges
        edges = add_loops(edges, places, side, side // 4, rng)


def _draw_widths(total: int, side: int, rng: np.random.Generator) -> np.ndarray:
    """Widths [side] of rows and columns alike, in cells, which add up to `total`."""
    narrowest = _NARROWEST / RESOLUTION
    ratio = total / side / (narrowest + 1)  # What is lost by rounding is less than a cell.
    spread = uniform(rng, 0.0, min(1 / 3, max(ratio - 1, 0.0) / (ratio + 1)))
    parts = 1 + spread * (2 * rng.random(side) - 1)
    return np.diff(np.round(np.append(0, np.cumsum(parts)) / parts.sum() * total).astype(int))
