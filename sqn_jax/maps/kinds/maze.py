"""Mazes like the project's own: 17 x 17 m, corridors about 2 m wide."""

from __future__ import annotations

import numpy as np

from sqn_jax.maps.kinds.plan import add_loops, grow_tree, path_lengths
from sqn_jax.maps.occupancy import OccupancyMap, cells_to_points
from sqn_jax.maps.terrain import RESOLUTION, SMALL_SIZE, WALL, fill_pockets, wall_edges

_SIDE = 8  # cells of the plan
_LOOPS = 5  # walls taken out of a maze that has only one path


def maze(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Corridors; evaluation points far from each other by path, spawn points in every cell."""
    side = _SIDE
    count = side * side
    edges = add_loops(grow_tree(side, rng), set(range(count)), side, _LOOPS, rng)
    walls = wall_edges(side, SMALL_SIZE)
    occupied = np.ones((SMALL_SIZE, SMALL_SIZE), dtype=bool)
    spans = [slice(walls[k] + WALL, walls[k + 1]) for k in range(side)]
    for place in range(count):
        row, col = divmod(place, side)
        occupied[spans[row], spans[col]] = False
    for place, other in edges:
        (row, col), (other_row, other_col) = divmod(place, side), divmod(other, side)
        rows = slice(spans[row].start, spans[other_row].stop)
        occupied[rows, spans[col].start : spans[other_col].stop] = False
    steps = path_lengths(edges, dict.fromkeys(edges, 1.0), count)
    marked = [int(steps[0].argmax())]
    while len(marked) < 4:
        marked.append(int(steps[marked].min(axis=0).argmax()))
    middle = np.array([(span.start + span.stop - 1) / 2 for span in spans])
    points = cells_to_points(
        np.stack([np.repeat(middle, side), np.tile(middle, side)], axis=-1), RESOLUTION
    ).round(3)
    return OccupancyMap(
        name=name,
        occupied=fill_pockets(occupied),
        resolution=RESOLUTION,
        spawn_points=points,
        evaluation_points=points[marked],
        spawn_radius=0.5,
        max_steps=400,
    )
