"""Tasks between random places of a map: how a policy does on a map of one's own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sqn_jax.config.groups import EnvConfig
from sqn_jax.maps.distance import goal_fields, require_searchable
from sqn_jax.maps.occupancy import (
    OccupancyMap,
    cells_to_points,
    connected_components,
    points_to_cells,
    traversable,
)
from sqn_jax.tasks.convert import ConvertedMap
from sqn_jax.tasks.suite import DEFAULT_GOAL_RADIUS, MAX_STEPS, MAX_TASKS, Task, steps_along

DEFAULT_COUNT = 50
DEFAULT_LIMIT = 4.0
MIN_LENGTH = 1.0
"""m along the shortest path between start and goal; nearer pairs are drawn again."""
_MOST_DRAWS = 100


def random_tasks(
    occupancy_map: OccupancyMap,
    count: int = DEFAULT_COUNT,
    seed: int = 0,
    *,
    robot_radius: float = EnvConfig.robot_radius,
    limit: float = DEFAULT_LIMIT,
) -> ConvertedMap:
    """Tasks between places drawn evenly from where a robot at the first spawn point can get.

    Headings are drawn for each episode.

    Args:
        occupancy_map: the map.
        count: tasks.
        seed: the same seed gives the same tasks.
        robot_radius: m.
        limit: length of an episode, in steps that the shortest path takes at full speed.

    Raises:
        ValueError: one line: a number out of range, the map is too large for paths to be searched
            on it, or the robot has no room for start and goal to be `MIN_LENGTH` apart.
    """
    if not 1 <= count <= MAX_TASKS:
        raise ValueError(f"count: {count}, expected 1 to {MAX_TASKS:,}")
    if seed < 0:
        raise ValueError(f"seed: {seed}, expected at least 0")
    if not 1.0 <= limit <= MAX_STEPS:
        raise ValueError(f"limit: {limit:g}, expected 1 to {MAX_STEPS:,}")
    pairs, lengths = _draw_pairs(occupancy_map, count, seed, robot_radius)
    longest = steps_along(limit * float(lengths.max()))
    if longest > MAX_STEPS:
        raise ValueError(
            f"limit: {limit:g} times a path of {lengths.max():.0f} m is {longest:,} steps, "
            f"expected at most {MAX_STEPS:,}"
        )
    tasks = [
        Task(
            map_file="",
            start=(start[0], start[1]),
            heading=None,
            goal=(goal[0], goal[1]),
            max_steps=steps_along(limit * length),
            goal_radius=DEFAULT_GOAL_RADIUS,
            shortest_path=round(length, 4),
        )
        for (start, goal), length in zip(
            occupancy_map.to_map_frame(pairs).round(6).tolist(), lengths.tolist(), strict=True
        )
    ]
    sources = [f"map {occupancy_map.name}, task {number}" for number in range(count)]
    return ConvertedMap(occupancy_map, tasks, sources)


def _draw_pairs(
    occupancy_map: OccupancyMap, count: int, seed: int, robot_radius: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Starts and goals [count, 2, 2] in the grid frame, m, and lengths of their paths [count]."""
    resolution = occupancy_map.resolution
    free = traversable(occupancy_map.occupied, resolution, robot_radius)
    require_searchable(free, occupancy_map.name, "to search paths on")
    labels, _ = connected_components(free)
    row, column = points_to_cells(occupancy_map.spawn_points[0], resolution)
    cells = np.argwhere(free & (labels == labels[row, column]))
    rng = np.random.default_rng(seed)
    pairs, lengths = np.empty((0, 2, 2)), np.empty(0)
    for _ in range(_MOST_DRAWS if len(cells) else 0):
        drawn = cells[rng.integers(len(cells), size=(count - len(pairs), 2))]
        ends = cells_to_points(drawn, resolution)
        found = np.empty(len(drawn))
        for same, field in goal_fields(free, resolution, ends[:, 1]):
            found[same] = field[tuple(drawn[same, 0].T)]
        far = found >= MIN_LENGTH
        pairs, lengths = np.concatenate([pairs, ends[far]]), np.append(lengths, found[far])
        if len(pairs) == count:
            return pairs, lengths
    raise ValueError(
        f"map {occupancy_map.name}: from its first spawn point a robot of radius "
        f"{robot_radius:g} m gets to {len(cells)} cells, expected room for start and goal to be "
        f"{MIN_LENGTH:g} m apart"
    )
