"""Raster work behind the drawn and the generated maps: shapes, tunnels, connectivity, points.

Maps are square, bool [size, size], row 0 at the bottom, x to the east and y to the north in m. All
randomness comes from the generator that is passed in, and only from its `random` and `integers`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from sqn_jax.maps.distance import is_clear
from sqn_jax.maps.occupancy import (
    OccupancyMap,
    cells_to_points,
    close_border,
    connected_components,
    largest_component,
    traversable,
)

RESOLUTION = 0.05  # m per cell
ROBOT_RADIUS = 0.1  # m
WALL = 3  # cells, 0.15 m
SMALL_SIZE = 340  # cells, 17 m
CAVE_SIZE = 1020  # cells, 51 m

# A tunnel's wall stands off its drawn place by noise of these wavelengths and amplitudes, in m.
_ROUGHNESS = ((4.0, 0.7), (1.6, 0.7), (0.6, 0.35))
# The same for how a tunnel winds about its drawn course.
_WINDING = ((6.0, 1.2), (2.5, 0.4))
_CORE = 0.55  # m; nearer to a tunnel's middle there is never rock
_SMALLEST_ROCK = 0.12  # m2; a smaller rock that stands alone is left out
_ROCKS = ((2.2, 1.0), (0.7, 0.4))  # wavelengths and amplitudes of the rocks in a cave's wide places
_NARROW = 5  # cells; a gap in a cave that is narrower is filled

# Cells around its own that a robot covers or touches, bool [5, 5]: squares nearer than its radius.
_OFF = np.maximum(np.abs(np.arange(-2, 3)) - 0.5, 0) * RESOLUTION
_BODY = _OFF[:, None] ** 2 + _OFF[None, :] ** 2 < ROBOT_RADIUS**2

Window = tuple[tuple[slice, slice], NDArray[np.bool_]]
"""A part of the map (rows, columns) and which of its cells are meant."""


def walled_square(size: int) -> NDArray[np.bool_]:
    """An empty square, bool [size, size], with a wall all round."""
    occupied = np.ones((size, size), dtype=bool)
    occupied[WALL:-WALL, WALL:-WALL] = False
    return occupied


def wall_edges(count: int, size: int) -> list[int]:
    """First cells of the count + 1 walls that divide a side of `size` cells into `count` spans."""
    return [k * (size - WALL) // count for k in range(count + 1)]


def disc(size: int, center: ArrayLike, radius: float) -> Window:
    """The cells with their centers within `radius` m of `center` (x, y) m."""
    where, x, y = _window(size, center, radius)
    return where, x**2 + y**2 <= radius**2


def asterisk(
    size: int,
    center: ArrayLike,
    angles: Sequence[float],
    lengths: Sequence[float],
    half_width: float,
) -> Window:
    """Straight arms from a center: the cells within `half_width` of one.

    Args:
        size: cells a side.
        center: (x, y), m.
        angles: rad, counter-clockwise from +x, one an arm.
        lengths: m, one an arm.
        half_width: m.
    """
    where, x, y = _window(size, center, max(lengths) + half_width)
    cells = np.zeros(np.broadcast_shapes(x.shape, y.shape), dtype=bool)
    for angle, length in zip(angles, lengths, strict=True):
        cos, sin = math.cos(angle), math.sin(angle)
        along = np.clip(x * cos + y * sin, 0, length)
        cells |= (x - along * cos) ** 2 + (y - along * sin) ** 2 <= half_width**2
    return where, cells


def boxes(
    size: int,
    center: ArrayLike,
    turn: float,
    sides: Sequence[tuple[float, float, float, float]],
    margin: float = 0.0,
) -> Window:
    """Boxes that turn together about a center: the cells whose centers lie in one.

    Args:
        size: cells a side.
        center: (x, y), m.
        turn: rad, counter-clockwise.
        sides: of each (left, right, bottom, top) in m from the center, before it is turned.
        margin: m by which every box is wider on each of its sides.
    """
    # As far as the farthest corner of a box around all, which is wider by the margin.
    reach = math.hypot(*np.abs(np.asarray(sides)).reshape(-1, 2, 2).max(axis=(0, 2)) + margin)
    where, x, y = _window(size, center, reach)
    cos, sin = math.cos(turn), math.sin(turn)
    along, across = x * cos + y * sin, y * cos - x * sin
    cells = np.zeros(along.shape, dtype=bool)
    for left, right, bottom, top in sides:
        inside = (along >= left - margin) & (along <= right + margin)
        cells |= inside & (across >= bottom - margin) & (across <= top + margin)
    return where, cells


def round_crooks(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A copy with everything filled where no disc of radius 0.16 m fits in.

    Else single cells deep between two arms of an asterisk could be stood on but not reached.
    """
    _, x, y = _window(7, (3.5 * RESOLUTION, 3.5 * RESOLUTION), 0.16)
    opened: NDArray[np.bool_] = ndimage.binary_opening(~occupied, x**2 + y**2 <= 0.16**2)
    return ~opened


def _window(
    size: int, center: ArrayLike, reach: float
) -> tuple[tuple[slice, slice], NDArray[np.float64], NDArray[np.float64]]:
    """The part of the map within `reach` m of a point; its cells' x [1, C] and y [R, 1] from it."""
    middle = np.asarray(center, dtype=np.float64) / RESOLUTION
    first = np.maximum(np.floor(middle - reach / RESOLUTION).astype(int), 0)
    last = np.minimum(np.ceil(middle + reach / RESOLUTION).astype(int), size)
    x = (np.arange(first[0], last[0]) + 0.5 - middle[0]) * RESOLUTION
    y = (np.arange(first[1], last[1]) + 0.5 - middle[1]) * RESOLUTION
    return (slice(first[1], last[1]), slice(first[0], last[0])), x[None, :], y[:, None]


def value_noise(
    size: int, octaves: Sequence[tuple[float, float]], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Smooth noise [size, size]: random lattices, interpolated, one for each of the `octaves`.

    Args:
        size: cells a side.
        octaves: (wavelength m, amplitude); one of amplitude a lies in -a..a.
        rng: where the lattices' values come from.
    """
    total = np.zeros((size, size))
    for wavelength, amplitude in octaves:
        place = np.arange(size) * RESOLUTION / wavelength
        before = place.astype(int)
        weight = place - before
        weight = weight**2 * (3 - 2 * weight)
        lattice = rng.random((before[-1] + 2, before[-1] + 2)) * 2 - 1
        rows = lattice[before] + weight[:, None] * (lattice[before + 1] - lattice[before])
        total += amplitude * (rows[:, before] + weight * (rows[:, before + 1] - rows[:, before]))
    return total


def smooth_path(points: ArrayLike) -> NDArray[np.float64]:
    """A polyline [P, C] with its corners cut (Chaikin), sampled at least once a cell; ends stay.

    Args:
        points: [P, C], P >= 2; the first two columns are (x, y) in m, the rest are carried along.
    """
    path = np.asarray(points, dtype=np.float64)
    for _ in range(3):
        quarter = 0.75 * path[:-1] + 0.25 * path[1:]
        three = 0.25 * path[:-1] + 0.75 * path[1:]
        inner = np.stack([quarter, three], axis=1).reshape(-1, path.shape[1])
        path = np.concatenate([path[:1], inner, path[-1:]])
    pieces = []
    for start, end in pairwise(path):
        count = 1 + int(max(abs(end - start)[:2]) / RESOLUTION)
        pieces.append(start + (end - start) * (np.arange(count) / count)[:, None])
    return np.concatenate([*pieces, path[-1:]])


def carve_tunnels(
    size: int, paths: Sequence[ArrayLike], rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Rock with winding tunnels of rough walls in it.

    Where two paths share a point, their tunnels meet. The middle of a tunnel is free for at least
    0.55 m to either side, whatever the roughness.

    Args:
        size: cells a side.
        paths: each [P, 3], the course of a tunnel: x m, y m, half its width m.
        rng: for the winding and the roughness.

    Returns:
        occupied: bool [size, size], closed at the border.
    """
    shift = [value_noise(size, _WINDING, rng) for _ in range(2)]
    half_width = np.zeros((size, size))
    for points in paths:
        x, y, half = smooth_path(points).T
        cell = np.clip(np.stack([y, x]) / RESOLUTION, 0, size - 1).astype(int)
        moved = np.stack([y + shift[0][tuple(cell)], x + shift[1][tuple(cell)]]) / RESOLUTION
        # Winding stretches the path: fill the gaps between its cells.
        steps = np.abs(np.diff(moved, axis=1)).max(initial=0)
        for part in np.arange(math.ceil(steps) + 1) / (math.ceil(steps) + 1):
            between = moved + part * np.diff(moved, axis=1, append=moved[:, -1:])
            row, col = np.clip(between, 0, size - 1).astype(int)
            half_width[row, col] = np.maximum(half_width[row, col], half)
    away, nearest = ndimage.distance_transform_edt(half_width == 0, return_indices=True)
    away *= RESOLUTION
    open_by = half_width[tuple(nearest)] - away + value_noise(size, _ROUGHNESS, rng)
    standing = (value_noise(size, _ROCKS, rng) > 0.55) & (away > 0.75)
    occupied = ((open_by <= 0) | standing) & (away > _CORE)
    occupied = ndimage.minimum_filter(ndimage.maximum_filter(occupied, _NARROW), _NARROW)
    occupied[:WALL] = occupied[-WALL:] = occupied[:, :WALL] = occupied[:, -WALL:] = True
    rocks, count = connected_components(occupied)
    sizes = np.bincount(rocks.ravel(), minlength=count + 1)
    return occupied & (sizes[rocks] >= _SMALLEST_ROCK / RESOLUTION**2)


def fill_pockets(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A copy, closed at the border, whose traversable cells are one connected component.

    What a robot of `ROBOT_RADIUS` could stand on but not reach from the largest component is filled
    and so are cells shut off altogether; each round fills at least one cell, so this ends.
    """
    occupied = close_border(occupied)
    while True:
        free = traversable(occupied, RESOLUTION, ROBOT_RADIUS)
        main = largest_component(free)
        around, _ = connected_components(~occupied)
        pockets = (free & ~main) | (~occupied & (around != around[main].max(initial=0)))
        if not pockets.any():
            return occupied
        # The rim of a pocket goes with it, but for what the robot's body covers from outside.
        rim = ndimage.maximum_filter(pockets, 2 * len(_BODY) - 1)
        occupied = occupied | pockets | (rim & ~ndimage.binary_dilation(main, _BODY))


def clear_cells(occupied: NDArray[np.bool_], clearance: float) -> NDArray[np.int64]:
    """Cells (row, col) [C, 2] with at least `clearance` m to the nearest obstacle, row by row."""
    return np.argwhere(is_clear(occupied, clearance / RESOLUTION))


def spread(cells: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Up to `count` of the cells [C, 2], far from each other; starts from the first of them.

    Farthest-point sampling, in whole numbers and so the same everywhere.
    """
    rows, cols = cells.T.copy()
    chosen = [0]
    nearest = (rows - rows[0]) ** 2 + (cols - cols[0]) ** 2
    while len(chosen) < count and nearest.max() > 0:
        last = int(nearest.argmax())
        chosen.append(last)
        np.minimum(nearest, (rows - rows[last]) ** 2 + (cols - cols[last]) ** 2, out=nearest)
    return cells[chosen]


def nearest_cell(cells: NDArray[np.int64], point: ArrayLike) -> NDArray[np.int64]:
    """The one of the cells [C, 2] that is nearest to the cell of a point (x, y) m."""
    target = np.floor(np.asarray(point, dtype=np.float64)[::-1] / RESOLUTION).astype(int)
    nearest: NDArray[np.int64] = cells[((cells - target) ** 2).sum(axis=1).argmin()]
    return nearest


def finish_map(
    name: str,
    occupied: NDArray[np.bool_],
    evaluation_points: Sequence[ArrayLike],
    *,
    spawn_count: int,
    clearance: float,
    max_steps: int = 400,
) -> OccupancyMap:
    """The map with its pockets filled, and with spawn points spread over it.

    Args:
        name: the map's name.
        occupied: bool [size, size].
        evaluation_points: (x, y) m each; each is moved to the nearest cell with this clearance.
        spawn_count: at most so many spawn points.
        clearance: m from every spawn and evaluation point to the nearest obstacle, at least.
        max_steps: length of an episode.
    """
    occupied = fill_pockets(occupied)
    cells = clear_cells(occupied, clearance)
    marked = np.array([nearest_cell(cells, point) for point in evaluation_points])
    return OccupancyMap(
        name=name,
        occupied=occupied,
        resolution=RESOLUTION,
        spawn_points=cells_to_points(spread(cells, spawn_count), RESOLUTION).round(3),
        evaluation_points=cells_to_points(marked, RESOLUTION).round(3),
        spawn_radius=0.5,
        max_steps=max_steps,
    )
