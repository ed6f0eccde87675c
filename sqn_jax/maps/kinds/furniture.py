"""Furniture: boxes along the walls of rooms, tables in their middle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.kinds.placing import in_cells

_GAP = 14  # cells between two pieces, 0.7 m
_PASSAGE = 16  # cells that a piece leaves of a room's width, 0.8 m
_LEG = 2  # cells a side of a table's leg, 0.1 m


def furnish(
    occupied: NDArray[np.bool_],
    keep_free: NDArray[np.bool_],
    rooms: Sequence[tuple[slice, slice]],
    rng: np.random.Generator,
) -> None:
    """Put furniture into rooms: up to 5 pieces each, none in one map of four.

    Args:
        occupied: bool [size, size], changed in place.
        keep_free: bool [size, size], where none may stand.
        rooms: rows and columns of each.
        rng: what decides.
    """
    most = 0 if rng.random() < 0.25 else int(rng.integers(1, 6))
    tables = rng.random()
    for cells in rooms:
        room, doorways = occupied[cells], keep_free[cells]  # Views.
        for _ in range(int(rng.integers(most + 1))):
            quarters = int(rng.integers(4))
            _put(np.rot90(room, quarters), np.rot90(doorways, quarters), tables, rng)


def _put(
    room: NDArray[np.bool_], doorways: NDArray[np.bool_], tables: float, rng: np.random.Generator
) -> None:
    """A piece in the middle of a room or along its first row, if there is room for it."""
    height, width = room.shape
    depth, length = in_cells(rng, 0.3, 0.9), in_cells(rng, 0.3, 2.0)
    is_table = rng.random() < tables
    first = _GAP if is_table else 0
    if depth + first + _PASSAGE > height or length + 2 * first > width:
        return
    row = first + (int(rng.integers(height - depth - 2 * first + 1)) if is_table else 0)
    col = first + int(rng.integers(width - length - 2 * first + 1))
    around = room[max(row - _GAP, 0) : row + depth + _GAP, max(col - _GAP, 0) : col + length + _GAP]
    piece = room[row : row + depth, col : col + length]
    if around.any() or doorways[row : row + depth, col : col + length].any():
        return
    if is_table and rng.random() < 0.5:
        for rows in (slice(_LEG), slice(-_LEG, None)):
            piece[rows, :_LEG] = piece[rows, -_LEG:] = True
    else:
        piece[:] = True
