"""Several maps side by side in one, so that one program trains on all of them.

Every map has a closed border: a robot never leaves its own, and never sees another.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from sqn_jax.maps.occupancy import OccupancyMap, close_border


def side_by_side(maps: Sequence[OccupancyMap], name: str) -> OccupancyMap:
    """Lay maps out as tiles of equal size, as nearly square as may be, row by row from below.

    Args:
      maps: at least one; cells of one size. What a smaller one leaves of its tile is occupied.
      name: of the whole.

    Returns:
      One map with `tiles`, and the points of all. Episodes take as long as the longest one's.

    Raises:
      ValueError: no map, or cells of different sizes.
    """
    if not maps:
        raise ValueError(f"map {name}: no map to lay out, expected at least one")
    for each in maps:
        if each.resolution != maps[0].resolution:
            raise ValueError(
                f"map {name}: {maps[0].name} has cells of {maps[0].resolution:g} m and {each.name} "
                f"of {each.resolution:g} m, expected one size"
            )
    if len(maps) == 1:
        return dataclasses.replace(maps[0], name=name)
    height, width = (max(each.shape[axis] for each in maps) for axis in (0, 1))
    columns = math.ceil(math.sqrt(len(maps)))
    rows = math.ceil(len(maps) / columns)
    occupied = np.ones((rows * height, columns * width), dtype=bool)
    spawn, evaluation = [], []
    for index, each in enumerate(maps):
        row, column = divmod(index, columns)
        top, left = row * height, column * width
        own = close_border(each.occupied)
        occupied[top : top + own.shape[0], left : left + own.shape[1]] = own
        corner = np.array([left, top]) * each.resolution
        spawn.append(each.spawn_points + corner)
        evaluation.append(each.evaluation_points + corner)
    return OccupancyMap(
        name=name,
        occupied=occupied,
        resolution=maps[0].resolution,
        spawn_points=np.concatenate(spawn),
        evaluation_points=np.concatenate(evaluation),
        spawn_radius=max(each.spawn_radius for each in maps),
        max_steps=max(each.max_steps for each in maps),
        warnings=tuple(line for each in maps for line in each.warnings),
        tiles=(columns, rows),
    )
