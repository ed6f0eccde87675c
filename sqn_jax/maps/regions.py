"""Where on a map a robot is to live: the region of its points, and what it can see from there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from sqn_jax.maps.occupancy import (
    EVALUATION_COUNT,
    MAX_CELLS,
    OccupancyMap,
    close_border,
    connected_components,
    enclose,
    moved,
    no_room,
    points_to_cells,
    sample_spawn_points,
    traversable,
)

MARGIN = 5.0
"""m that stay around what a robot can see where a map is cut; the range of the usual sensors."""
_CUT_BELOW = 0.5  # of the cells: a map is cut where it then has fewer.
SMALLEST_REGION = 4.0
"""m2 of a region that is more than a nook between obstacles."""
_SMALLEST_FRACTION = 0.01  # How large it is at least beside the largest.
_WORTH_A_LINE = 0.1  # of the free ground that cannot be reached.


@dataclass(frozen=True)
class Points:
    """Places that a map file names, (x, y) m in the map frame; None where it does not.

    Attributes:
        spawn: [S, 2].
        evaluation: [E, 2].
        region: [2], a point in the region where points are to be sampled.
    """

    spawn: NDArray[np.float64] | None = None
    evaluation: NDArray[np.float64] | None = None
    region: NDArray[np.float64] | None = None


def complete(
    drawn: OccupancyMap, points: Points, robot_radius: float, advice: str = ""
) -> OccupancyMap:
    """A map as a file draws it, made ready: closed, cut to what can be seen, with its points.

    A ring of walls is laid around a map whose border is open. The points that the file does not
    name are sampled in the region of those it names, else in that of `points.region`, else in the
    one that holds the origin of the map frame, where a map usually begins, if that is large enough
    and the origin lies within the map, else in the largest. If less than half of the cells lie
    within `MARGIN` of the free ground of that region, the rest is cut off.

    Args:
        drawn: a map without points.
        points: what the file says.
        robot_radius: m.
        advice: how to choose another region, with {point} in it; for the warning.

    Returns:
        The map, with lines in `warnings`; whether the points will do, `validate` says.

    Raises:
        ValueError: no room for the robot, an unusable `points.region`, or too many cells.
    """
    enclosed = enclose(drawn)
    if enclosed.occupied.size > MAX_CELLS:
        height, width = enclosed.shape
        raise ValueError(f"{width} x {height} cells with a wall, expected at most {MAX_CELLS}")
    body_free = traversable(enclosed.occupied, enclosed.resolution, robot_radius)
    labels, count = connected_components(body_free)
    if count == 0:
        raise ValueError(no_room(robot_radius))
    label = _label_of_points(enclosed, labels, points)
    warning = None
    if label is None:
        label, warning = _best_region(drawn, enclosed, labels, advice)
    component = labels == label
    seen = _cut(enclosed, component, points)
    ready = enclosed
    if seen is not None:
        rows, cols = seen
        part = close_border(enclosed.occupied[seen])
        ready = moved(enclosed, part, rows.start, cols.start)
        component = component[seen] & ~part
    lines = [] if warning is None else [warning]
    if seen is not None:
        before, after = drawn.shape, ready.shape
        lines.append(
            f"{before[1]} x {before[0]} cells cut to the {after[1]} x {after[0]} within "
            f"{MARGIN:g} m of what a robot can see; coordinates stay those of the file"
        )
    return _with_points(replace(ready, warnings=tuple(lines)), component, points, robot_radius)


def _with_points(
    ready: OccupancyMap, component: NDArray[np.bool_], points: Points, robot_radius: float
) -> OccupancyMap:
    """The map with the points of its file, and sampled ones in place of those it does not name."""
    sampled = np.empty((0, 2))
    if points.spawn is None or points.evaluation is None:
        sampled = sample_spawn_points(
            ready.occupied, ready.resolution, robot_radius, component=component
        )
    return replace(
        ready,
        spawn_points=sampled if points.spawn is None else ready.to_grid_frame(points.spawn),
        evaluation_points=sampled[:EVALUATION_COUNT]
        if points.evaluation is None
        else ready.to_grid_frame(points.evaluation),
    )


def _label_at(grid: OccupancyMap, labels: NDArray[np.int32], point: ArrayLike) -> int:
    """The label of the region that holds a point in the map frame; 0 if none does."""
    with np.errstate(over="ignore", invalid="ignore"):
        in_cells = grid.to_grid_frame(point)[::-1] / grid.resolution
        if not ((in_cells >= 0) & (in_cells < grid.shape)).all():
            return 0
    row, col = np.floor(in_cells).astype(int)
    return int(labels[row, col])


def _label_of_points(grid: OccupancyMap, labels: NDArray[np.int32], points: Points) -> int | None:
    """The region of the points of the file; None if it names none that lie in one."""
    named = {
        f"{field}[0]": given[0]
        for field, given in (
            ("spawn_points", points.spawn),
            ("evaluation_points", points.evaluation),
        )
        if given is not None
    }
    found = {name: _label_at(grid, labels, point) for name, point in named.items()}
    label = next((label for label in found.values() if label), None)
    if points.region is None:
        return label
    x, y = points.region
    chosen = _label_at(grid, labels, points.region)
    if chosen == 0:
        raise ValueError(
            f"region: ({x:g}, {y:g}) is no place for the robot, expected a point [x m, y m] "
            "in free space within the map"
        )
    if label not in (None, chosen):
        name = next(name for name in found if found[name] == label)
        raise ValueError(
            f"region: ({x:g}, {y:g}) cannot be reached from {name}, expected a point in one region "
            "with the points of the file"
        )
    return chosen


def _best_region(
    drawn: OccupancyMap, enclosed: OccupancyMap, labels: NDArray[np.int32], advice: str
) -> tuple[int, str | None]:
    """The region of a map that names no points, and a warning if much ground lies elsewhere."""
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    largest = int(sizes.argmax())
    smallest = max(SMALLEST_REGION / drawn.resolution**2, _SMALLEST_FRACTION * sizes[largest])
    # At the border, the usual place of an origin that says nothing, it says nothing.
    where = drawn.to_grid_frame([0.0, 0.0]) / drawn.resolution
    if (where > 1).all() and (where < np.array(drawn.shape[::-1]) - 1).all():
        label = _label_at(enclosed, labels, [0.0, 0.0])
        if label and sizes[label] >= smallest:
            return label, None
    sizes[sizes < smallest] = 0
    elsewhere = 1 - sizes[largest] / max(sizes.sum(), 1)
    if sizes[largest] == 0 or elsewhere < _WORTH_A_LINE:
        return largest, None
    sizes[largest] = 0
    cells = np.argwhere(labels == sizes.argmax())
    x, y = enclosed.to_map_frame((cells[len(cells) // 2][::-1] + 0.5) * enclosed.resolution)
    line = f"{elsewhere:.0%} of the free ground lies outside the region of the points, the largest"
    return largest, line + advice.format(point=f"[{x:.6g}, {y:.6g}]")


def _cut(
    grid: OccupancyMap, component: NDArray[np.bool_], points: Points
) -> tuple[slice, slice] | None:
    """The rows and columns to cut a map to; None if that would not make it much smaller."""
    # All free ground that hangs together with where the robot's center can be, corners included,
    # since a ray may pass between two.
    ground, _ = ndimage.label(~grid.occupied, structure=np.ones((3, 3)))
    seen = ground == ground[tuple(np.argwhere(component)[0])]
    named = [given for given in (points.spawn, points.evaluation) if given is not None]
    with np.errstate(over="ignore", invalid="ignore"):
        cells = [np.clip(grid.to_grid_frame(given), -1e9, 1e9) for given in named]
    no_cells = np.empty((0, 2), np.int64)
    marked = np.concatenate(
        [points_to_cells(given, grid.resolution) for given in cells] or [no_cells]
    )
    margin = max(1, math.ceil(min(MARGIN / grid.resolution, MAX_CELLS)))
    sides = []
    for axis, length in enumerate(grid.shape):
        lines = np.flatnonzero(seen.any(axis=1 - axis))
        lines = np.append(lines, marked[:, axis].clip(0, length - 1) if len(marked) else [])
        sides.append(
            slice(max(int(lines.min()) - margin, 0), min(int(lines.max()) + margin + 1, length))
        )
    rows, cols = sides
    num_cells = (rows.stop - rows.start) * (cols.stop - cols.start)
    return (rows, cols) if num_cells < _CUT_BELOW * grid.occupied.size else None
