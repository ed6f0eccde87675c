"""The occupancy map the whole program shares, and the checks that make one usable.

Grid frame: `occupied[row, col]` with row 0 at the bottom (south), x = col * resolution to the east,
y = row * resolution to the north, (0, 0) at the lower-left corner. The map frame of ROS is the grid
frame turned by the origin's yaw and shifted by its x and y.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from sqn_jax.maps.distance import clearance_cells, is_clear

SPAWN_COUNT = 16
EVALUATION_COUNT = 4

MAX_CELLS = 2**24
"""Cells of a map: the table of free space then takes a minute and a gigabyte."""

MAX_CELLS_TOGETHER = 3 * MAX_CELLS
"""Cells of several maps side by side."""


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """A map with the places where episodes start and end. Points are in the grid frame, in m.

    Attributes:
        name: short name for tables and file names.
        occupied: bool [H, W], row 0 at the bottom; unknown is occupied, the border is closed.
        resolution: m per cell.
        spawn_points: float64 [S, 2], where training starts and goals lie.
        evaluation_points: float64 [E, 2], the starts and goals of the fixed evaluation.
        origin: pose (x m, y m, yaw rad) of the grid's lower-left corner in the map frame.
        spawn_radius: m; starts are drawn from free cells this near to a spawn point.
        max_steps: length of an episode.
        warnings: oddities that the loader noticed, one line each.
        tiles: (columns, rows) of tiles of equal size, if several maps lie side by side in this one
            (`maps.atlas`); none of them crosses the border of a tile.
        parts: of these maps, each (left, bottom, right, top) in m; empty for one map alone. Only
            points in the same part reach each other.
        weights: for each part how many times as many training tasks as its points alone would give.
        unknown: bool [H, W], which occupied cells a file says nothing about; None if it is none.
            Only pictures show the difference.
    """

    name: str
    occupied: NDArray[np.bool_]
    resolution: float
    spawn_points: NDArray[np.float64]
    evaluation_points: NDArray[np.float64]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spawn_radius: float = 0.5
    max_steps: int = 400
    warnings: tuple[str, ...] = ()
    tiles: tuple[int, int] = (1, 1)
    parts: tuple[tuple[float, float, float, float], ...] = ()
    weights: tuple[int, ...] = ()
    unknown: NDArray[np.bool_] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, cols = self.occupied.shape
        return rows, cols

    @property
    def size_m(self) -> tuple[float, float]:
        """(width along x, height along y) in m."""
        rows, cols = self.shape
        return cols * self.resolution, rows * self.resolution

    @property
    def tile_m(self) -> tuple[float, float]:
        """(width, height) of a tile in m: of the whole map, unless it holds several."""
        width, height = self.size_m
        return width / self.tiles[0], height / self.tiles[1]

    def part_of(self, points: ArrayLike) -> NDArray[np.int64]:
        """Which part [...] points [..., 2] in the grid frame lie in: 0 in one map alone."""
        xy = np.asarray(points, dtype=np.float64)[..., None, :]
        boxes = np.array(self.parts or [(0.0, 0.0, *self.size_m)])
        inside = (xy >= boxes[:, :2]) & (xy < boxes[:, 2:])
        part: NDArray[np.int64] = inside.all(axis=-1).argmax(axis=-1)
        return part

    def identity(self) -> dict[str, Any]:
        """What identifies this map: its size, and a SHA-256 of all that decides a task."""
        contents = hashlib.sha256(np.packbits(self.occupied).tobytes())
        for numbers in (self.spawn_points, self.evaluation_points, [self.spawn_radius]):
            contents.update(np.asarray(numbers, dtype="<f8").tobytes())
        if set(self.weights) - {1}:
            contents.update(np.asarray(self.weights, dtype="<f8").tobytes())
        return {
            "cells": list(self.shape),
            "resolution": self.resolution,
            "max_steps": self.max_steps,
            "contents": contents.hexdigest()[:16],
        }

    def to_map_frame(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points [..., 2] from the grid frame to the ROS map frame, in m."""
        x, y = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        return np.stack(
            [cos * x - sin * y + self.origin[0], sin * x + cos * y + self.origin[1]], axis=-1
        )

    def to_grid_frame(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points [..., 2] from the ROS map frame to the grid frame, in m."""
        x, y = np.moveaxis(np.asarray(points, dtype=np.float64) - self.origin[:2], -1, 0)
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def points_to_cells(points: ArrayLike, resolution: float) -> NDArray[np.int64]:
    """(row, col) [..., 2] of the cells that hold grid-frame points (x, y) [..., 2]."""
    xy = np.asarray(points, dtype=np.float64)
    return np.floor(xy[..., ::-1] / resolution).astype(np.int64)


def cells_to_points(cells: ArrayLike, resolution: float) -> NDArray[np.float64]:
    """Centers (x, y) [..., 2] in m of cells (row, col) [..., 2]."""
    return (np.asarray(cells)[..., ::-1] + 0.5) * resolution


def close_border(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A copy with the outermost cells occupied, so that nothing moves or sees off the map."""
    closed = np.ones_like(occupied)
    closed[1:-1, 1:-1] = occupied[1:-1, 1:-1]
    return closed


def enclose(occupancy_map: OccupancyMap) -> OccupancyMap:
    """The same map within a wall: a ring of occupied cells around it if its border is not closed.

    No cell of the map changes, and in the map frame all points stay where they are; the origin is
    that of the wall's corner.
    """
    occupied = occupancy_map.occupied
    if occupied[[0, -1]].all() and occupied[:, [0, -1]].all():
        return occupancy_map
    return moved(occupancy_map, np.pad(occupied, 1, constant_values=True), -1, -1)


def moved(
    occupancy_map: OccupancyMap, occupied: NDArray[np.bool_], row: int, col: int
) -> OccupancyMap:
    """The same map with other cells, the first of which lies at (row, col) of those it had.

    Points keep their places in the map frame. The cells reach at most one beyond those it had.
    """
    unknown = occupancy_map.unknown
    if unknown is not None:
        rows, cols = occupied.shape
        unknown = np.pad(unknown, 1)[row + 1 :, col + 1 :][:rows, :cols].copy()
    corner = np.array([col, row]) * occupancy_map.resolution
    x, y = occupancy_map.to_map_frame(corner).tolist()
    return dataclasses.replace(
        occupancy_map,
        occupied=occupied,
        spawn_points=occupancy_map.spawn_points - corner,
        evaluation_points=occupancy_map.evaluation_points - corner,
        origin=(x, y, occupancy_map.origin[2]),
        unknown=unknown,
    )


def no_room(robot_radius: float) -> str:
    """What is wrong with a map on which a robot fits nowhere."""
    return f"no free space: no cell is free for a robot of radius {robot_radius:g} m"


def traversable(
    occupied: NDArray[np.bool_], resolution: float, robot_radius: float
) -> NDArray[np.bool_]:
    """Cells on whose center a round robot fits: no occupied square nearer than its radius.

    Args:
        occupied: bool [H, W].
        resolution: m per cell.
        robot_radius: m, >= 0; 0 leaves every cell that is not occupied.

    Returns:
        bool [H, W].
    """
    # A millionth of a cell of slack: 0.15 / 0.05 is not exactly 3.
    return is_clear(occupied, robot_radius / resolution - 1e-6)


def connected_components(free: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Labels [H, W] (0 where not free, else 1..count) of the 4-connected components, and count."""
    labels, count = ndimage.label(free)
    return labels.astype(np.int32), int(count)


def largest_component(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest 4-connected component as bool [H, W] (all False if nothing is free)."""
    labels, count = connected_components(free)
    if count == 0:
        return np.zeros_like(free)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == sizes.argmax()


def sample_spawn_points(
    occupied: NDArray[np.bool_],
    resolution: float,
    robot_radius: float,
    count: int = SPAWN_COUNT,
    component: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Well-spread points for a map that names none; the first ones are the farthest apart.

    Farthest-point sampling (straight-line distance, deterministic) over the middle of the corridors
    and rooms, i.e. local maxima of the obstacle distance, of a connected component.

    Args:
        occupied: bool [H, W].
        resolution: m per cell.
        robot_radius: m.
        count: how many points, at most.
        component: bool [H, W], the cells to choose from; the largest component by default.

    Returns:
        float64 [<= count, 2] grid-frame (x, y) in m; fewer points only if there are fewer cells.

    Raises:
        ValueError: no free space for the robot.
    """
    clearance = clearance_cells(occupied)
    if component is None:
        component = largest_component(traversable(occupied, resolution, robot_radius))
    if not component.any():
        raise ValueError(no_room(robot_radius))
    clearance = np.where(component, clearance, 0.0)
    window = 2 * min(50, math.ceil(0.5 / resolution)) + 1
    middle = component & (clearance == ndimage.maximum_filter(clearance, size=window))
    if middle.sum() < count:
        middle = component
    cells = np.argwhere(middle)
    start = cells[clearance[middle].argmax()]
    # The widest place only starts the spread: the first sample is the cell farthest from it.
    nearest = np.hypot(*(cells - start).T)
    chosen: list[NDArray[np.int64]] = []
    for _ in range(min(count, len(cells))):
        best = int(nearest.argmax())
        away = np.hypot(*(cells - cells[best]).T)
        nearest = away if not chosen else np.minimum(nearest, away)
        chosen.append(cells[best])
    return cells_to_points(np.array(chosen), resolution)


def _named_points(occupancy_map: OccupancyMap) -> list[tuple[str, NDArray[np.float64]]]:
    """(name, point) of every spawn and evaluation point, names as a user wrote them."""
    groups = {
        "spawn_points": occupancy_map.spawn_points,
        "evaluation_points": occupancy_map.evaluation_points,
    }
    return [(f"{name}[{i}]", p) for name, points in groups.items() for i, p in enumerate(points)]


def validate(occupancy_map: OccupancyMap, robot_radius: float, source: str | None = None) -> None:
    """Check that episodes can run on a map: room, points on free ground, all mutually reachable.

    Args:
        occupancy_map: the map.
        robot_radius: m, >= 0.
        source: what errors call the map; its name if None.

    Raises:
        ValueError: one line naming the map, the point (in the map frame, as in its file) and why.
    """
    source = source or f"map {occupancy_map.name!r}"
    for field in ("spawn_points", "evaluation_points"):
        if len(getattr(occupancy_map, field)) < 2:
            count = len(getattr(occupancy_map, field))
            raise ValueError(f"{source}: {field}: {count} given, expected at least 2 points")
    free = traversable(occupancy_map.occupied, occupancy_map.resolution, robot_radius)
    if not free.any():
        raise ValueError(f"{source}: {no_room(robot_radius)}")
    labels, _ = connected_components(free)
    rows, cols = occupancy_map.shape
    labeled_points: list[tuple[str, int, int]] = []
    for name, point in _named_points(occupancy_map):
        # What overflows lies outside.
        with np.errstate(over="ignore", invalid="ignore"):
            x, y = occupancy_map.to_map_frame(point)
            in_cells = np.floor(point[::-1] / occupancy_map.resolution)
        where = f"{source}: {name} ({x:g}, {y:g})"
        if not np.isfinite(point).all():
            raise ValueError(f"{where} is not finite, expected x, y in m")
        if not ((in_cells >= 0) & (in_cells < (rows, cols))).all():
            raise ValueError(f"{where} lies outside the map, expected a point in free space")
        row, col = in_cells.astype(int)
        if occupancy_map.occupied[row, col]:
            raise ValueError(f"{where} lies in an obstacle, expected a point in free space")
        if not free[row, col]:
            raise ValueError(
                f"{where} is too near an obstacle, expected {robot_radius:g} m (the robot's radius)"
            )
        labeled_points.append((name, int(labels[row, col]), int(occupancy_map.part_of(point))))
    for part in sorted({part for _, _, part in labeled_points}):
        _require_connected(
            [labeled[:2] for labeled in labeled_points if labeled[2] == part], source
        )


def _require_connected(labeled_points: list[tuple[str, int]], source: str) -> None:
    """Check that points, given by name and component, are all in one component."""
    # The component that holds most points is the one meant; the odd one out is reported.
    main = int(np.bincount([label for _, label in labeled_points]).argmax())
    reference = next(name for name, label in labeled_points if label == main)
    for name, label in labeled_points:
        if label != main:
            raise ValueError(
                f"{source}: {name} cannot be reached from {reference}, "
                "expected all points in one connected free region"
            )


def reachable_cells(occupancy_map: OccupancyMap, robot_radius: float) -> NDArray[np.bool_]:
    """The connected component, bool [H, W], of traversable cells that holds the spawn points.

    Of several maps side by side, that of each.
    """
    free = traversable(occupancy_map.occupied, occupancy_map.resolution, robot_radius)
    labels, _ = connected_components(free)
    _, firsts = np.unique(occupancy_map.part_of(occupancy_map.spawn_points), return_index=True)
    rows, cols = points_to_cells(occupancy_map.spawn_points[firsts], occupancy_map.resolution).T
    return np.isin(labels, labels[rows, cols]) & free
