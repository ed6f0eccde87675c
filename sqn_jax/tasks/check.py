"""Whether the tasks of a suite can be solved at all, on maps as they are loaded."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sqn_jax.config.groups import EnvConfig
from sqn_jax.maps.occupancy import (
    OccupancyMap,
    connected_components,
    points_to_cells,
    traversable,
)
from sqn_jax.tasks.suite import TaskSuite


def check_tasks(
    suite: TaskSuite,
    load: Callable[[str], OccupancyMap],
    *,
    robot_radius: float | None = None,
    source: str | None = None,
) -> None:
    """Check that each start and goal is free for the robot, and that a way joins the two.

    Args:
        suite: the tasks.
        load: makes a map of `Task.map_file`; called once for each map.
        robot_radius: m; None: the suite's own, or that of `EnvConfig`.
        source: what errors call the suite; its name if None.

    Raises:
        ValueError: one line that names the first such task of a map, the place and why; or what
            `load` says, after the name of the task.
    """
    if robot_radius is None:
        robot_radius = suite.robot_of(EnvConfig()).robot_radius
    source = source or f"suite {suite.name!r}"
    tasks_of: dict[str, list[int]] = {}
    for index, task in enumerate(suite.tasks):
        tasks_of.setdefault(task.map_file, []).append(index)
    for map_file, indices in tasks_of.items():
        try:
            occupancy_map = load(map_file)
        except ValueError as error:
            raise ValueError(f"{source}: tasks[{indices[0]}].map: {error}") from None
        tasks = [suite.tasks[index] for index in indices]
        starts = np.array([task.start for task in tasks])
        goals = np.array([task.goal for task in tasks])
        wrong = first_unsolvable(occupancy_map, starts, goals, robot_radius)
        if wrong is not None:
            raise ValueError(f"{source}: tasks[{indices[wrong[0]]}].{wrong[1]}")


def first_unsolvable(
    occupancy_map: OccupancyMap,
    starts: NDArray[np.float64],
    goals: NDArray[np.float64],
    robot_radius: float,
) -> tuple[int, str] | None:
    """The first task of a map that cannot be solved: its number, and a line on what is wrong.

    Args:
        occupancy_map: the map.
        starts, goals: [E, 2] in m in the map's frame.
        robot_radius: m.
    """
    resolution = occupancy_map.resolution
    free = traversable(occupancy_map.occupied, resolution, robot_radius)
    labels, _ = connected_components(free)
    where: dict[str, NDArray[np.int32]] = {}
    for name, points in (("start", starts), ("goal", goals)):
        cells = points_to_cells(occupancy_map.to_grid_frame(points), resolution)
        inside: NDArray[np.bool_] = np.all((cells >= 0) & (cells < occupancy_map.shape), axis=-1)
        row, col = np.where(inside[:, None], cells, 0).T
        where[name] = np.where(inside, labels[row, col], -1)
        for index in np.flatnonzero(where[name] <= 0)[:1]:
            if not inside[index]:
                what = "lies outside"
            elif occupancy_map.occupied[row[index], col[index]]:
                what = "lies in an obstacle"
            else:
                what = "is too near an obstacle"
            x, y = points[index]
            need = f"expected free space for a robot of radius {robot_radius:g} m"
            return int(index), f"{name} ({x:g}, {y:g}) {what} on map {occupancy_map.name}, {need}"
    for index in np.flatnonzero(where["start"] != where["goal"])[:1]:
        (x, y), (goal_x, goal_y) = starts[index], goals[index]
        return int(index), (
            f"goal ({goal_x:g}, {goal_y:g}) cannot be reached from ({x:g}, {y:g}) on map "
            f"{occupancy_map.name} by a robot of radius {robot_radius:g} m"
        )
    return None
