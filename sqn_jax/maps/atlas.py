"""Several maps side by side in one, so that one program trains on all of them.

Every map has a closed border: a robot never leaves its own, and never sees another. The area seen
is counted within a tile, the size of the largest map; smaller ones share tiles with their like.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from sqn_jax.maps.occupancy import MAX_CELLS_TOGETHER, OccupancyMap, enclose


def side_by_side(
    maps: Sequence[OccupancyMap], name: str, weights: Sequence[int] | None = None
) -> OccupancyMap:
    """Lay maps out in tiles as large as the largest, nearly square, row by row from below.

    Args:
        maps: at least one. What they leave of a tile is occupied. Cells are as large as the
            smallest; larger ones, a whole number of times as large, are divided.
        name: of the whole.
        weights: how many times as many tasks each map has in training, >= 1; 1 by default.

    Returns:
        One map with `tiles` and `parts`, one a map in their order, and the points of all. Episodes
        take as long as the longest one's.

    Raises:
        ValueError: no map, cells of sizes that do not fit, or too many of them.
    """
    if not maps:
        raise ValueError(f"map {name}: no map to lay out, expected at least one")
    if len(maps) == 1:
        return dataclasses.replace(maps[0], name=name)
    maps = [enclose(occupancy_map) for occupancy_map in maps]
    finest = min(maps, key=lambda occupancy_map: occupancy_map.resolution)
    resolution = finest.resolution
    parts_of_cell = [_parts_of_cell(occupancy_map, finest, name) for occupancy_map in maps]
    shapes = [
        (occupancy_map.shape[0] * number, occupancy_map.shape[1] * number)
        for occupancy_map, number in zip(maps, parts_of_cell, strict=True)
    ]
    height, width = (max(shape[axis] for shape in shapes) for axis in (0, 1))
    places, count = _places(shapes, (height, width))
    columns, rows = _layout(count)
    if rows * height * columns * width > MAX_CELLS_TOGETHER:
        raise ValueError(
            f"map {name}: {columns * width} x {rows * height} cells of {resolution:g} m, expected "
            f"at most {MAX_CELLS_TOGETHER:,}: fewer maps, or none whose cells are much larger than "
            "others'"
        )
    occupied = np.ones((rows * height, columns * width), dtype=bool)
    spawn, evaluation, parts = [], [], []
    for occupancy_map, number, (tile, row, column) in zip(maps, parts_of_cell, places, strict=True):
        top, left = tile // columns * height + row, tile % columns * width + column
        own = occupancy_map.occupied.repeat(number, axis=0).repeat(number, axis=1)
        occupied[top : top + own.shape[0], left : left + own.shape[1]] = own
        corner = np.array([left, top]) * resolution
        spawn.append(occupancy_map.spawn_points + corner)
        evaluation.append(occupancy_map.evaluation_points + corner)
        parts.append((*corner.tolist(), *(corner + occupancy_map.size_m).tolist()))
    return OccupancyMap(
        name=name,
        occupied=occupied,
        resolution=resolution,
        spawn_points=np.concatenate(spawn),
        evaluation_points=np.concatenate(evaluation),
        spawn_radius=max(occupancy_map.spawn_radius for occupancy_map in maps),
        max_steps=max(occupancy_map.max_steps for occupancy_map in maps),
        warnings=tuple(line for occupancy_map in maps for line in occupancy_map.warnings),
        tiles=(columns, rows),
        parts=tuple(parts),
        weights=tuple(weights or [1] * len(maps)),
    )


def _parts_of_cell(coarse: OccupancyMap, fine: OccupancyMap, name: str) -> int:
    """How many cells of a map fit along the side of one of another."""
    ratio = coarse.resolution / fine.resolution
    if abs(ratio - round(ratio)) > 1e-6:
        raise ValueError(
            f"map {name}: {fine.name} has cells of {fine.resolution:g} m and {coarse.name} of "
            f"{coarse.resolution:g} m, expected one size, or a whole multiple of the smaller: "
            "resample the image of one of them"
        )
    return round(ratio)


def _places(
    shapes: Sequence[tuple[int, int]], tile: tuple[int, int]
) -> tuple[list[tuple[int, int, int]], int]:
    """For each map its tile, and its lowest row and first column there; and the number of tiles.

    Maps of one shape fill a tile before they begin another.
    """
    left: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    places, count = [], 0
    for height, width in shapes:
        free = left.setdefault((height, width), [])
        if not free:
            down, across = tile[0] // height, tile[1] // width
            free += [(count, i * height, j * width) for i in range(down) for j in range(across)]
            count += 1
        places.append(free.pop(0))
    return places, count


def _layout(count: int) -> tuple[int, int]:
    """Columns and rows for so many tiles: the fewest in all, at most twice as wide as high."""
    square = math.ceil(math.sqrt(count))
    layouts = [(columns, math.ceil(count / columns)) for columns in range(square, 2 * square)]
    fitting = [(columns, rows) for columns, rows in layouts if columns <= max(square, 2 * rows)]
    return min(fitting, key=lambda layout: layout[0] * layout[1])
