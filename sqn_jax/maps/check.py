"""A short report on a map, for a person who wants to know whether it will do."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.distance import (
    MAX_SEARCHED_CELLS,
    goal_fields,
    grid_path,
    is_searchable,
)
from sqn_jax.maps.occupancy import (
    OccupancyMap,
    connected_components,
    points_to_cells,
    reachable_cells,
    traversable,
)
from sqn_jax.outside.messages import shown

_SHOWN_POINTS = 12
_SEARCHED_CELLS = 2**21


def evaluation_distances(
    occupancy_map: OccupancyMap, robot_radius: float = 0.1
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Geodesic and straight-line distance [E, E] in m between the evaluation points."""
    points = occupancy_map.evaluation_points
    free = reachable_cells(occupancy_map, robot_radius)
    row, col = points_to_cells(points, occupancy_map.resolution).T
    geodesic = np.empty((len(points), len(points)))
    for goals, field in goal_fields(free, occupancy_map.resolution, points):
        geodesic[:, goals] = field[row, col][:, None]
    straight = np.linalg.norm(points[:, None] - points[None, :], axis=-1)
    return geodesic, straight


def describe(
    occupancy_map: OccupancyMap,
    robot_radius: float = 0.1,
    step_length: float = 0.25,
    goal_radius: float = 0.3,
) -> str:
    """A readable report of several lines: size, free space, points, distances, warnings.

    Args:
        occupancy_map: a map that `validate` accepts.
        robot_radius: m; free space and distances are those of a robot of this size.
        step_length: m moved in one step, to judge `max_steps`.
        goal_radius: m; a goal is reached when it is so near.
    """
    rows, cols = occupancy_map.shape
    width, height = occupancy_map.size_m
    free = traversable(occupancy_map.occupied, occupancy_map.resolution, robot_radius)
    _, count = connected_components(free)
    used = reachable_cells(occupancy_map, robot_radius)
    x, y, yaw = occupancy_map.origin
    lines = [
        f"map            {shown(occupancy_map.name)}",
        f"size           {width:.2f} x {height:.2f} m, "
        f"{cols} x {rows} cells of {occupancy_map.resolution:g} m",
        f"origin         ({x:g} m, {y:g} m), yaw {math.degrees(yaw):.1f} degrees",
        f"free           {np.mean(~occupancy_map.occupied):.1%} of the cells, "
        f"{free.mean():.1%} for a robot of radius {robot_radius:g} m",
        f"components     {count}; the points lie in one with {used.sum() / free.sum():.1%} "
        "of the free cells",
        f"spawn points   {len(occupancy_map.spawn_points)}, "
        f"starts within {occupancy_map.spawn_radius:g} m",
        f"max steps      {occupancy_map.max_steps}",
        f"evaluation     {len(occupancy_map.evaluation_points)} points",
    ]
    warnings = occupancy_map.warnings + _near_warnings(occupancy_map, goal_radius)
    if is_searchable(used):
        geodesic, straight = evaluation_distances(occupancy_map, robot_radius)
        lines += _pair_lines(occupancy_map, geodesic, straight)
        warnings += _step_warnings(occupancy_map, geodesic, step_length)
    else:
        lines.append(f"               (more than {MAX_SEARCHED_CELLS:,} free cells: no distances)")
    lines += [f"warning        {line}" for line in warnings] or ["warnings       none"]
    return "\n".join(lines)


def _near_warnings(occupancy_map: OccupancyMap, goal_radius: float) -> tuple[str, ...]:
    """A line for two evaluation points of which one lies within the goal radius of the other."""
    points = occupancy_map.evaluation_points
    for i, point in enumerate(points):
        apart = np.linalg.norm(points[i + 1 :] - point, axis=-1)
        for j in np.flatnonzero(apart < goal_radius)[:1]:
            return (
                f"evaluation points {i + 1} and {i + 2 + j} are {apart[j]:.2f} m apart, less than "
                f"the goal radius of {goal_radius:g} m: such a task is nearly solved at its start",
            )
    return ()


def _step_warnings(
    occupancy_map: OccupancyMap, geodesic: NDArray[np.float64], step_length: float
) -> tuple[str, ...]:
    """A line if an episode is too short for the longest path between two evaluation points."""
    steps = math.ceil(geodesic.max() / step_length)
    if steps <= occupancy_map.max_steps:
        return ()
    return (
        f"max_steps is {occupancy_map.max_steps}, but the longest path between evaluation points "
        f"takes at least {steps} steps of {step_length:g} m",
    )


def step_warning(
    occupancy_map: OccupancyMap, robot_radius: float, step_length: float, goal_radius: float
) -> str | None:
    """A line if an episode is too short for a shortest path between evaluation points, else None.

    Of many points the first ones of each map are taken. Paths along rows and columns, which are
    quickly found, are at most sqrt(2) times as long as any; only if they are too long, shortest
    paths are searched, and on a very large map they are given that much.

    Args:
        occupancy_map: one map or several side by side, which `validate` accepts.
        robot_radius: m.
        step_length: m moved in one step.
        goal_radius: m; a goal is reached when it is so near.
    """
    free = traversable(occupancy_map.occupied, occupancy_map.resolution, robot_radius)
    parts = occupancy_map.part_of(occupancy_map.evaluation_points)
    limit = occupancy_map.max_steps * step_length + goal_radius
    longest = 0.0
    for part in np.unique(parts):
        points = occupancy_map.evaluation_points[parts == part][:_SHOWN_POINTS]
        cells = points_to_cells(points, occupancy_map.resolution)
        along = occupancy_map.resolution * max(grid_path(free, cell, cells).max() for cell in cells)
        if along <= limit:
            continue
        if free.size > _SEARCHED_CELLS:
            longest = max(longest, along / math.sqrt(2))
            continue
        for goals, field in goal_fields(free, occupancy_map.resolution, points):
            del goals
            reached = field[tuple(cells.T)]
            longest = max(longest, float(reached[np.isfinite(reached)].max()))
    if longest <= limit:
        return None
    steps = math.ceil((longest - goal_radius) / step_length)
    return (
        f"map {occupancy_map.name}: max_steps is {occupancy_map.max_steps}, but the longest path "
        f"between evaluation points takes at least {steps} steps of {step_length:g} m: no robot "
        "can arrive in time; the key max_steps of the YAML file or an option sets more"
    )


def _pair_lines(
    occupancy_map: OccupancyMap, geodesic: NDArray[np.float64], straight: NDArray[np.float64]
) -> list[str]:
    """The evaluation points in the map frame, and a table of the paths between them."""
    if len(occupancy_map.evaluation_points) > _SHOWN_POINTS:
        return [f"               (more than {_SHOWN_POINTS}: distances not listed)"]
    points = occupancy_map.to_map_frame(occupancy_map.evaluation_points)
    lines = [f"  {i:<12} ({x:.2f}, {y:.2f}) m" for i, (x, y) in enumerate(points, 1)]
    lines.append("  pair         geodesic  straight  ratio")
    for i, j in combinations(range(len(points)), 2):
        # Two evaluation points in one place have no ratio.
        ratio = f"{geodesic[i, j] / straight[i, j]:5.2f}" if straight[i, j] > 0 else "    -"
        pair = f"{i + 1} - {j + 1}"
        lines.append(f"  {pair:12} {geodesic[i, j]:6.2f} m  {straight[i, j]:6.2f} m  {ratio}")
    return lines
