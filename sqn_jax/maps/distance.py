"""Distance fields over an occupancy grid: to the nearest obstacle, and along the path to a goal.

Arrays are `[row, col]` with row 0 at the bottom; the center of a cell is
`((col + 0.5) * resolution, (row + 0.5) * resolution)` in the grid frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

# Half of the 32-neighbor moves (d_row, d_col); the other half are their reverses.
_HALF_MOVES = (
    *((0, 1), (1, 0), (1, 1), (1, -1)),
    *((1, 2), (2, 1), (1, -2), (2, -1)),
    *((1, 3), (3, 1), (1, -3), (3, -1), (2, 3), (3, 2), (2, -3), (3, -2)),
)
# Cells this near to a goal get their straight distance if nothing stands around: close by, the few
# directions of the grid would be felt most.
_NEAR_CELLS = 12
MAX_SEARCHED_CELLS = 2**22
"""Free cells of a map on which paths are searched: the graph of so many takes about 4 GB."""
FIELD_CELLS = 8_000_000
"""Cells of distance fields that `goal_fields` computes at once."""


def is_searchable(free: NDArray[np.bool_]) -> bool:
    """Whether a map [H, W] has few enough free cells for paths to be searched on it."""
    return int(np.count_nonzero(free)) <= MAX_SEARCHED_CELLS


def require_searchable(free: NDArray[np.bool_], map_name: str, what: str) -> None:
    """Refuse a map [H, W] that is too large for paths to be searched on it.

    Args:
        free: its free cells.
        map_name: for the error.
        what: paths are wanted for, in the error.

    Raises:
        ValueError: one line naming the map.
    """
    if not is_searchable(free):
        raise ValueError(
            f"map {map_name}: {np.count_nonzero(free):,} free cells, expected at most "
            f"{MAX_SEARCHED_CELLS:,} {what}"
        )


def clearance_cells(occupied: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance, in cells, from each cell center to the nearest occupied cell's closed square.

    Exact to float64 rounding. On a lattice of half cells the centers are the odd points and a
    square is three by three points; the point of a square nearest to a center is always one of
    them, so a Euclidean distance transform of that lattice gives the distance to the squares
    themselves (the nearest *center* need not belong to the nearest square).

    Args:
        occupied: bool [H, W].

    Returns:
        float64 [H, W], 0 inside occupied cells, inf everywhere if no cell is occupied.
    """
    rows, cols = occupied.shape
    if not occupied.any():
        return np.full(occupied.shape, np.inf)
    lattice = np.ones((2 * rows + 1, 2 * cols + 1), dtype=bool)
    lattice[1::2, 1::2] = ~occupied
    lattice = ndimage.minimum_filter(lattice, size=3, mode="nearest")
    nearest = ndimage.distance_transform_edt(lattice, return_distances=False, return_indices=True)
    d_row = nearest[0, 1::2, 1::2] - np.arange(1, 2 * rows, 2)[:, None]
    d_col = nearest[1, 1::2, 1::2] - np.arange(1, 2 * cols, 2)[None, :]
    return 0.5 * np.hypot(d_row, d_col)


def is_clear(occupied: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Cells that are free and whose center is at least so far from every occupied square.

    What `clearance_cells(occupied) >= radius` says, without the distances themselves: much faster
    for the few cells of a robot's radius. A square of an occupied cell (i, j) cells away is
    hypot(max(i - 1/2, 0), max(j - 1/2, 0)) from the center.

    Args:
        occupied: bool [H, W].
        radius: cells; what is negative counts as 0.

    Returns:
        bool [H, W].
    """
    rows = len(occupied)
    clear = ~occupied
    for i in range(min(math.ceil(radius + 0.5), rows)):
        reach = 0  # Cells sideways, in a row i away, whose squares are too near.
        while math.hypot(max(i - 0.5, 0.0), max(reach - 0.5, 0.0)) < radius:
            reach += 1
        if reach == 0:
            continue
        near = _widened(occupied, reach - 1)
        clear[: rows - i] &= ~near[i:]
        clear[i:] &= ~near[: rows - i]
    return clear


def _widened(occupied: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Cells with an occupied one at most so many columns away in their row."""
    return ndimage.maximum_filter1d(occupied, 2 * reach + 1, axis=1, mode="constant")


def obstacle_distance(occupied: NDArray[np.bool_], resolution: float) -> NDArray[np.float32]:
    """Distance from each cell center to the nearest occupied cell's square.

    Exact (point to square, not center to center) to float32 rounding; see `clearance_cells`.

    Args:
        occupied: bool [H, W].
        resolution: m per cell, > 0.

    Returns:
        float32 [H, W] in m, 0 inside occupied cells, inf everywhere if no cell is occupied.
    """
    return (clearance_cells(occupied) * resolution).astype(np.float32)


def segment_cells(d_row: int, d_col: int) -> list[tuple[int, int]]:
    """Offsets of all cells whose closed square meets the segment from (0, 0) to (d_row, d_col).

    The segment joins two cell centers. A cell touched at a corner only is included, so a segment
    that is free by this list never slips between two diagonal neighbors.
    """
    row_sign, col_sign = (1 if d_row >= 0 else -1), (1 if d_col >= 0 else -1)
    rows, cols = abs(d_row), abs(d_col)
    # Separating axis test against the segment's normal, doubled to stay in integers.
    return [
        (row_sign * i, col_sign * j)
        for i in range(rows + 1)
        for j in range(cols + 1)
        if 2 * abs(rows * j - cols * i) <= rows + cols
    ]


def clear_moves(free: NDArray[np.bool_], d_row: int, d_col: int) -> NDArray[np.bool_]:
    """Cells from which the straight move by (d_row, d_col) passes over free cells only.

    Args:
        free: bool [H, W]; cells outside the array count as not free.
        d_row, d_col: the move, in cells.

    Returns:
        bool [H, W], indexed by the cell where the move starts.
    """
    rows, cols = free.shape
    margin = max(abs(d_row), abs(d_col))
    padded = np.pad(free, margin)
    clear = free.copy()
    for i, j in segment_cells(d_row, d_col):
        clear &= padded[margin + i : margin + i + rows, margin + j : margin + j + cols]
    return clear


def _cell_graph(
    free: NDArray[np.bool_], index: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Undirected edges (from, to, length in cells) between free cells, over `_HALF_MOVES`."""
    starts, ends, lengths = [], [], []
    for d_row, d_col in _HALF_MOVES:
        row, col = np.nonzero(clear_moves(free, d_row, d_col))
        starts.append(index[row, col])
        ends.append(index[row + d_row, col + d_col])
        lengths.append(np.full(row.size, np.hypot(d_row, d_col)))
    return np.concatenate(starts), np.concatenate(ends), np.concatenate(lengths)


def _seen_around(free: NDArray[np.bool_], row: int, col: int) -> NDArray[np.bool_]:
    """Cells [2R+1, 2R+1] around a cell that are seen from it: the rectangle between is all free."""
    padded = np.pad(free, _NEAR_CELLS)
    seen = padded[row : row + 2 * _NEAR_CELLS + 1, col : col + 2 * _NEAR_CELLS + 1]
    for rows in (slice(_NEAR_CELLS, None), slice(_NEAR_CELLS, None, -1)):
        for cols in (slice(_NEAR_CELLS, None), slice(_NEAR_CELLS, None, -1)):
            quadrant = np.logical_and.accumulate(seen[rows, cols], axis=0)
            seen[rows, cols] = np.logical_and.accumulate(quadrant, axis=1)
    return seen


def _goal_edges(
    free: NDArray[np.bool_], resolution: float, goal: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Cells (row, col) near the goal and seen from it, with their straight distance in cells."""
    in_cells = goal / resolution
    if not (np.all(in_cells >= 0) and np.all(in_cells[::-1] < free.shape)):
        raise ValueError(f"goal {goal.tolist()}: expected a point (x, y) on the map, in m")
    row, col = in_cells[::-1].astype(int)
    if not free[row, col]:
        raise ValueError(f"goal {goal.tolist()}: expected a point (x, y) in a free cell, in m")
    rows, cols = np.nonzero(_seen_around(free, row, col))
    rows, cols = rows + row - _NEAR_CELLS, cols + col - _NEAR_CELLS
    away = np.hypot(cols + 0.5 - in_cells[0], rows + 0.5 - in_cells[1])
    # A sparse matrix may drop an explicit zero; a goal on a cell center still needs its edge.
    return rows, cols, np.maximum(away, 1e-12)


def goal_distance(
    free: NDArray[np.bool_], resolution: float, goal_xy: ArrayLike
) -> NDArray[np.float32]:
    """Length of the shortest path over free cells from each cell center to a goal.

    Dijkstra on the 32-neighbor grid (steps such as 3 across and 2 up; no step touches a cell that
    is not free, not even at a corner). Never shorter than the straight line; in empty space at most
    1.3 % longer, since the steps know 32 directions only. In tight clutter, where a slanting path
    has no room to be imitated, a single path came out up to 9 % longer than the shortest chain of
    sight lines between cell centers, all paths together less than 3 %.

    Args:
        free: bool [H, W], the cells that may be crossed (see `occupancy.traversable`).
        resolution: m per cell, > 0.
        goal_xy: [..., 2] goal (x, y) in the grid frame, m; several goals share one graph.

    Returns:
        float32 [..., H, W] in m, inf where there is no path and in cells that are not free.

    Raises:
        ValueError: a goal lies outside the map or in a cell that is not free.
    """
    goals = np.asarray(goal_xy, dtype=np.float64)
    flat_goals = goals.reshape(-1, 2)
    index = np.full(free.shape, -1, dtype=np.int32)
    count = int(free.sum())
    index[free] = np.arange(count, dtype=np.int32)
    starts, ends, lengths = _cell_graph(free, index)
    rows, cols, data = [starts, ends], [ends, starts], [lengths, lengths]
    for number, goal in enumerate(flat_goals):
        row, col, away = _goal_edges(free, resolution, goal)
        rows.append(np.full(row.size, count + number, dtype=np.int32))
        cols.append(index[row, col])
        data.append(away)
    nodes = count + len(flat_goals)
    graph = sparse.csr_matrix(
        (np.concatenate(data), (np.concatenate(rows), np.concatenate(cols))), shape=(nodes, nodes)
    )
    # The goals' own edges lead outward only, so no path can use a goal as a shortcut.
    lengths = csgraph.dijkstra(graph, directed=True, indices=np.arange(count, nodes))
    distance = np.full((len(flat_goals), *free.shape), np.inf, dtype=np.float32)
    distance[:, free] = lengths[:, :count] * resolution
    return distance.reshape(*goals.shape[:-1], *free.shape)


def goal_fields(
    free: NDArray[np.bool_], resolution: float, goals: NDArray[np.floating]
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.float32]]]:
    """The distance field of each different goal, a few computed at a time to bound the memory.

    Args:
        free, resolution: as for `goal_distance`.
        goals: [E, 2] in the grid frame, m; the same one may come many times.

    Yields:
        Which of the goals [n] are this one, and its `goal_distance` [H, W].
    """
    places, which = np.unique(goals, axis=0, return_inverse=True)
    which = which.reshape(-1)
    at_once = max(1, FIELD_CELLS // free.size)
    for first in range(0, len(places), at_once):
        fields = goal_distance(free, resolution, places[first : first + at_once])
        for number, field in enumerate(fields, first):
            yield np.flatnonzero(which == number), field


def grid_path(
    free: NDArray[np.bool_], start: NDArray[np.int64], cells: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Steps [P] from a free cell to others [P, 2] along rows and columns; 0 where none leads.

    A wave of cells goes out from the start until it has met the others.
    """
    width = free.shape[1] + 2
    open_cells = np.pad(free, 1).ravel()
    targets = (cells[:, 0] + 1) * width + cells[:, 1] + 1
    wave = np.array([(start[0] + 1) * width + start[1] + 1])
    open_cells[wave] = False
    steps = np.zeros(len(open_cells), np.int64)
    mark = np.zeros(len(open_cells), np.int32)
    count = 0
    while len(wave) and open_cells[targets].any():
        count += 1
        around = np.concatenate([wave + 1, wave - 1, wave + width, wave - width])
        around = around[open_cells[around]]
        # Each cell once: the last to write its number there stays.
        order = np.arange(len(around), dtype=np.int32)
        mark[around] = order
        wave = around[mark[around] == order]
        open_cells[wave] = False
        steps[wave] = count
    return steps[targets]
