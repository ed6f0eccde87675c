"""Slow, plain references for the simulator's tests, in NumPy and float64, and the maps they use.

Nothing here calls the simulator's own geometry: readings come from every grid line a ray crosses,
the seen area from a dense lattice of points, clearance from every occupied square.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sqn_jax.maps import OccupancyMap

FLOATS = NDArray[np.float64]
BOOLS = NDArray[np.bool_]

FIELD_OF_VIEW = np.deg2rad(350.0)
BEAMS = np.deg2rad(np.arange(-175.0, 176.0, 5.0))
MAX_RANGE = 5.0


def cast(
    occupied: BOOLS,
    resolution: float,
    x: ArrayLike,
    y: ArrayLike,
    angles: ArrayLike,
    max_range: ArrayLike = MAX_RANGE,
    shortest_chord: float = 1e-9,
) -> FLOATS:
    """Distance along each ray to the first occupied cell, cell by cell; the shapes broadcast.

    All crossings of a ray with the lines of the grid are sorted; between two of them the ray is in
    the one cell that holds the middle of the piece. Pieces shorter than `shortest_chord` (in cells)
    are skipped: a ray through a corner. Outside the map all is occupied.
    """
    x, y, angles, max_range = np.broadcast_arrays(x, y, angles, max_range)
    shape = angles.shape
    px, py, angle, limit = (
        a.astype(np.float64).ravel()[:, None] for a in (x, y, angles, max_range)
    )
    px, py, limit = px / resolution, py / resolution, limit / resolution
    cosine, sine = np.cos(angle), np.sin(angle)
    lines = np.arange(np.ceil(limit.max()) + 2)
    crossings = [np.zeros_like(limit), limit]
    for position, slope in ((px, cosine), (py, sine)):
        line = np.where(slope > 0, np.floor(position) + lines, np.ceil(position) - lines)
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (line - position) / slope
        crossings.append(np.where(np.isfinite(along), along, 0.0))
    border = np.sort(np.clip(np.concatenate(crossings, axis=1), 0.0, limit), axis=1)
    middle = (border[:, 1:] + border[:, :-1]) / 2
    column = np.floor(px + middle * cosine).astype(int)
    row = np.floor(py + middle * sine).astype(int)
    outside = (row < 0) | (column < 0) | (row >= occupied.shape[0]) | (column >= occupied.shape[1])
    blocked = outside | occupied[np.where(outside, 0, row), np.where(outside, 0, column)]
    blocked &= np.diff(border, axis=1) > shortest_chord
    first = np.argmax(blocked, axis=1)
    reading = border[np.arange(len(first)), first]
    return (np.where(blocked.any(axis=1), reading, limit[:, 0]) * resolution).reshape(shape)


def longest_reading(
    occupied: BOOLS, resolution: float, x: ArrayLike, y: ArrayLike, angles: ArrayLike
) -> FLOATS:
    """The longest reading that float32 may give: a hair to either side, corners cut by 0.1 mm."""
    angles = np.asarray(angles, np.float64)
    return np.max(
        [
            cast(occupied, resolution, x, y, angles + turn, shortest_chord=2e-3)
            for turn in (-2e-6, 0.0, 2e-6)
        ],
        axis=0,
    )


def scan(occupied: BOOLS, resolution: float, poses: ArrayLike) -> FLOATS:
    """Readings [..., 71] of all beams at poses [..., 3]."""
    poses = np.asarray(poses, np.float64)
    x, y, heading = (poses[..., i, None] for i in range(3))
    return cast(occupied, resolution, x, y, heading + BEAMS)


def sees(pose: FLOATS, readings: FLOATS, x: FLOATS, y: FLOATS) -> BOOLS:
    """Points in the field of view and no farther than the reading of the beam nearest in angle."""
    bearing = np.arctan2(y - pose[1], x - pose[0]) - pose[2]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    nearest = np.rint((bearing + FIELD_OF_VIEW / 2) / np.deg2rad(5.0)).astype(int)
    reading = readings[np.clip(nearest, 0, len(BEAMS) - 1)]
    in_view = np.abs(bearing) <= FIELD_OF_VIEW / 2
    return in_view & (np.hypot(x - pose[0], y - pose[1]) <= reading)


def seen_areas(
    occupied: BOOLS, resolution: float, poses: ArrayLike, spacing: float = 0.05
) -> FLOATS:
    """Area seen up to each pose of [T, 3], m2: [T], by a dense lattice of points."""
    poses = np.asarray(poses, np.float64)
    readings = scan(occupied, resolution, poses)
    rows, columns = np.ceil(np.array(occupied.shape) * resolution / spacing).astype(int)
    seen = np.zeros((rows, columns), bool)
    areas: list[float] = []
    for i, (pose, reading) in enumerate(zip(poses, readings, strict=True)):
        if i > 0 and (pose == poses[i - 1]).all():
            areas.append(areas[-1])
            continue
        left, bottom = np.maximum(np.floor((pose[:2] - MAX_RANGE) / spacing), 0).astype(int)
        right, top = np.ceil((pose[:2] + MAX_RANGE) / spacing).astype(int)
        window = seen[bottom:top, left:right]
        row, column = np.divmod(np.flatnonzero(~window), window.shape[1])
        x, y = (column + left + 0.5) * spacing, (row + bottom + 0.5) * spacing
        # Points beyond the longest reading of all need no angle.
        near = (x - pose[0]) ** 2 + (y - pose[1]) ** 2 <= reading.max() ** 2
        row, column, x, y = row[near], column[near], x[near], y[near]
        window[row, column] = sees(pose, reading, x, y)
        areas.append(seen.sum() * spacing**2)
    return np.array(areas)


def clearance(occupied: BOOLS, resolution: float, points: ArrayLike) -> FLOATS:
    """Distance [P] from points [P, 2] to the nearest occupied square, m; 0 inside one."""
    rows, columns = np.nonzero(occupied)
    nearest = []
    for x, y in np.asarray(points, np.float64):
        away_x = np.maximum(np.maximum(columns * resolution - x, x - (columns + 1) * resolution), 0)
        away_y = np.maximum(np.maximum(rows * resolution - y, y - (rows + 1) * resolution), 0)
        nearest.append(np.hypot(away_x, away_y).min())
    return np.array(nearest)


def random_map(seed: int, rows: int, columns: int, blocks: int, pillars: int) -> BOOLS:
    """Occupied cells [rows, columns]: a closed border, random rectangles, single cells."""
    rng = np.random.default_rng(seed)
    occupied = open_map(rows, columns)
    for _ in range(blocks):
        height, width = rng.integers(2, 30, 2)
        row, column = rng.integers(0, rows - 1), rng.integers(0, columns - 1)
        occupied[row : row + height, column : column + width] = True
    occupied[rng.integers(0, rows, pillars), rng.integers(0, columns, pillars)] = True
    return occupied


def wrap_map(
    occupied: BOOLS,
    points: ArrayLike,
    resolution: float = 0.05,
    spawn_radius: float = 0.2,
    max_steps: int = 400,
) -> OccupancyMap:
    """An `OccupancyMap` whose spawn and evaluation points are `points` [S, 2] m."""
    points = np.asarray(points, np.float64)
    return OccupancyMap(
        name="test",
        occupied=occupied,
        resolution=resolution,
        spawn_points=points,
        evaluation_points=points,
        spawn_radius=spawn_radius,
        max_steps=max_steps,
    )


def open_map(rows: int, columns: int) -> BOOLS:
    """Occupied cells [rows, columns]: nothing but a closed border."""
    occupied = np.ones((rows, columns), bool)
    occupied[1:-1, 1:-1] = False
    return occupied
