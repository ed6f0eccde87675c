"""What stands and what is free on a map of 0.05 m cells, found without the package's own code."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, spatial


def cell_of(point: ArrayLike) -> tuple[int, int]:
    """(row, col) of the cell that holds a point (x, y) in m."""
    x, y = np.asarray(point)
    return int(y / 0.05), int(x / 0.05)


def standing_room(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells from whose centre no occupied square is nearer than 0.1 m.

    Two cells: the squares nearer than that lie at offsets with
    (|row| - 1/2)^2 + (|col| - 1/2)^2 < 4, a negative difference counting as 0.
    """
    reach = np.maximum(np.abs(np.arange(-2, 3)) - 0.5, 0)
    return ~ndimage.binary_dilation(occupied, reach[:, None] ** 2 + reach[None, :] ** 2 < 4)


def is_closed(occupied: NDArray[np.bool_]) -> bool:
    """Whether all of the outermost cells are occupied."""
    edges = occupied[0], occupied[-1], occupied[:, 0], occupied[:, -1]
    return all(edge.all() for edge in edges)


def inner_obstacles(occupied: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """The cells (row, col) [C, 2] of every obstacle that does not touch the outer wall."""
    labels, count = ndimage.label(occupied)
    inner = set(range(1, count + 1)) - {labels[0, 0]}
    return [np.argwhere(labels == label) for label in sorted(inner)]


def fill_of_hull(cells: NDArray[np.int64]) -> float:
    """Area of the cells (row, col) [C, 2] over that of their convex hull: 1 if convex."""
    corners = [cells + np.array(corner) for corner in ((0, 0), (0, 1), (1, 0), (1, 1))]
    return float(len(cells) / spatial.ConvexHull(np.concatenate(corners)).volume)
