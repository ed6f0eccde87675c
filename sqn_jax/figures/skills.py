"""Paths in the colors of the skill decision, on maps and for several agents side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures.ground import (
    draw_field,
    draw_map,
    draw_skill_path,
    path_legend,
    scale_below,
    skill_bar,
)
from sqn_jax.figures.style import DPI, WIDTH_IN, plain
from sqn_jax.maps import OccupancyMap, goal_distance, traversable

MAX_AGENTS = 5  # columns of `agents_side_by_side`; more would be too narrow for their titles
MAX_TASKS = 4  # rows of `agents_side_by_side`; more would not fit on a page


def skill_trajectories(episodes: Sequence[Episode], *, title: str) -> Figure:
    """Draw paths in the colors of the skill decision, a panel for each map.

    With two skills the color ranges from vermillion (skill 2 alone) over gray to blue (skill 1
    alone). With more, a step has the color of the skill with the largest weight. Agents without
    skills have one color. A path ends where it first enters the goal radius; without success it is
    drawn to its end, which is marked by a cross.

    Args:
        episodes: on one map or several; all are drawn.
        title: above all panels.

    Raises:
        ValueError: no episodes.
    """
    if not episodes:
        raise ValueError("no episodes, expected at least one")
    groups: list[list[Episode]] = []
    for episode in episodes:
        same_map = [g for g in groups if _is_same_map(g[0].occupancy_map, episode.occupancy_map)]
        same_map[0].append(episode) if same_map else groups.append([episode])
    columns = math.ceil(len(groups) / math.ceil(len(groups) / 3))
    figure, grid = _map_grid([group[0].occupancy_map for group in groups], columns, tallest=6.0)
    for axes, group in zip(grid, groups, strict=True):
        draw_map(axes, group[0].occupancy_map)
        for episode in group:
            draw_skill_path(axes, episode)
        reached = sum(episode.success for episode in group)
        name = group[0].occupancy_map.name
        axes.set_title(plain(f"{name}: {reached} of {len(group)} reached"), fontsize=10)
    _finish(figure, grid, episodes, title)
    return figure


def agents_side_by_side(
    episodes_by_agent: Mapping[str, Sequence[Episode]], *, title: str
) -> Figure:
    """Draw the paths of several agents: a row for each task, a column for each agent.

    The background is the length of the shortest path to the goal. Paths have the colors of
    `skill_trajectories`.

    Args:
        episodes_by_agent: at most 4 episodes for each agent, all on one map; the tasks and their
            order are the same for all agents.
        title: above all panels.

    Raises:
        ValueError: no agents or more than 5, no episodes or too many, or tasks that differ between
            agents.
    """
    _check_tasks(episodes_by_agent)
    columns = list(episodes_by_agent.values())
    tasks = list(zip(*columns, strict=True))
    maps = [task[0].occupancy_map for task in tasks for _ in task]
    figure, grid = _map_grid(maps, len(columns), tallest=3.0)
    fields = _distance_fields(columns[0])
    norm = Normalize(0.0, float(fields[np.isfinite(fields)].max()))
    for row, (task, field) in enumerate(zip(tasks, fields, strict=True)):
        for column, (agent, episode) in enumerate(zip(episodes_by_agent, task, strict=True)):
            axes = grid[row * len(columns) + column]
            image = draw_field(axes, episode.occupancy_map, field, norm)
            draw_skill_path(axes, episode)
            outcome = f"{episode.time_steps} steps" if episode.success else "not reached"
            axes.set_title(plain(f"{agent}: {outcome}"), fontsize=10)
    scale_below(figure, image, grid, "path to the goal, m")
    _finish(figure, grid, [episode for task in tasks for episode in task], title)
    return figure


def agents_on_maps(episodes_by_map: Mapping[str, Mapping[str, Episode]], *, title: str) -> Figure:
    """Draw one path of each agent on each map: a row for each map, a column for each agent.

    This is the paper's figure of trajectories. The background is the length of the shortest path
    to the goal, from 0 to the longest of the map. Paths have the colors of `skill_trajectories`.

    Args:
        episodes_by_map: for each map an episode of each agent, at most 5; the task of a map is the
            same for all agents, and all maps have the same agents in the same order.
        title: above all panels.

    Raises:
        ValueError: no maps, agents that differ between maps, or what `agents_side_by_side` refuses.
    """
    rows = list(episodes_by_map.values())
    if not rows or any(list(row) != list(rows[0]) for row in rows):
        raise ValueError(f"{len(rows)} maps, expected at least one, all with the same agents")
    for row in rows:
        _check_tasks({agent: [episode] for agent, episode in row.items()})
    episodes = [episode for row in rows for episode in row.values()]
    maps = [episode.occupancy_map for episode in episodes]
    figure, grid = _map_grid(maps, len(rows[0]), tallest=3.6)
    panels = iter(grid)
    for map_name, row in episodes_by_map.items():
        (field,) = _distance_fields([next(iter(row.values()))])
        norm = Normalize(0.0, float(field[np.isfinite(field)].max()))
        for agent, episode in row.items():
            axes = next(panels)
            draw_field(axes, episode.occupancy_map, field, norm)
            draw_skill_path(axes, episode)
            outcome = f"{episode.time_steps} steps" if episode.success else "not reached"
            axes.set_title(plain(f"{agent}, {map_name}: {outcome}"), fontsize=9)
    _finish(figure, grid, episodes, title)
    return figure


def _check_tasks(episodes_by_agent: Mapping[str, Sequence[Episode]]) -> None:
    """Raise ValueError if the agents do not have the same tasks."""
    if not episodes_by_agent:
        raise ValueError("no agents, expected at least one")
    if len(episodes_by_agent) > MAX_AGENTS:
        raise ValueError(f"{len(episodes_by_agent)} agents, expected at most {MAX_AGENTS}")
    first, reference = next(iter(episodes_by_agent.items()))
    for agent, episodes in episodes_by_agent.items():
        if not 1 <= len(episodes) <= MAX_TASKS:
            raise ValueError(
                f"agent {agent} has {len(episodes)} episodes, expected 1 to {MAX_TASKS}"
            )
        if len(episodes) != len(reference):
            raise ValueError(
                f"agent {agent} has {len(episodes)} episodes, expected {len(reference)} as {first}"
            )
        for number, (ours, theirs) in enumerate(zip(episodes, reference, strict=True)):
            is_same_start = np.allclose(ours.poses[0], theirs.poses[0], atol=1e-4)
            is_same_goal = np.allclose(ours.goal, theirs.goal, atol=1e-4)
            is_same_map = _is_same_map(ours.occupancy_map, reference[0].occupancy_map)
            if not (is_same_map and is_same_start and is_same_goal):
                raise ValueError(
                    f"agent {agent}, episode {number}: another map, start or goal than {first}'s, "
                    "expected the same tasks on one map"
                )


def _is_same_map(first: OccupancyMap, second: OccupancyMap) -> bool:
    if first is second:
        return True
    has_same_resolution = first.resolution == second.resolution
    return has_same_resolution and np.array_equal(first.occupied, second.occupied)


def _distance_fields(tasks: Sequence[Episode]) -> NDArray[np.float32]:
    """[tasks, H, W] m, length of the shortest path to each goal, inf where there is none."""
    occupancy_map = tasks[0].occupancy_map
    free = traversable(occupancy_map.occupied, occupancy_map.resolution, tasks[0].robot_radius)
    return goal_distance(free, occupancy_map.resolution, [task.goal for task in tasks])


def _map_grid(
    maps: Sequence[OccupancyMap], columns: int, *, tallest: float
) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each map, of their shape but at most `tallest` inches high."""
    rows = math.ceil(len(maps) / columns)
    shape = max(item.size_m[1] / item.size_m[0] for item in maps)
    panel_height = min(((WIDTH_IN - 0.3) / columns - 0.35) * shape, tallest)
    size = (WIDTH_IN, rows * (panel_height + 0.35) + 2.1)
    figure = Figure(figsize=size, dpi=DPI, layout="compressed")
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in grid[len(maps) :]:
        axes.remove()
    for number, (axes, occupancy_map) in enumerate(zip(grid, maps, strict=False)):
        width, height = occupancy_map.size_m
        axes.set(aspect="equal", xlim=(0, width), ylim=(0, height))
        axes.set_xlabel("x, m" if number + columns >= len(maps) else "")
        axes.set_ylabel("y, m" if number % columns == 0 else "")
        axes.locator_params(nbins=6, steps=[1, 2, 5, 10])
        axes.tick_params(labelsize=8)
    return figure, grid[: len(maps)]


def _finish(figure: Figure, grid: Sequence[Axes], episodes: Sequence[Episode], title: str) -> None:
    """Add the scale of two skills, the legend and the title, and compute the layout."""
    if any(episode.skill_weights.shape[1] == 2 for episode in episodes):
        skill_bar(figure, grid)
    handles = path_legend(episodes)
    options: dict[str, Any] = {"loc": "outside lower center", "ncols": min(len(handles), 5)}
    figure.legend(handles=handles, frameon=False, fontsize=9, **options)
    figure.suptitle(plain(title))
    # With a fixed aspect the layout needs two passes; drawing makes the first.
    figure.draw_without_rendering()
