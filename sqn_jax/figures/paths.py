"""The paths of robots, over the distance fields of their goals."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from numpy.typing import ArrayLike, NDArray

from sqn_jax.figures.ground import (
    RED,
    SKILL_LABEL,
    UNREACHABLE,
    YELLOW,
    draw_cross,
    draw_field,
)
from sqn_jax.figures.style import COLORS, DPI, INK, OBSTACLE, WIDTH_IN, plain
from sqn_jax.maps import OccupancyMap, goal_distance, traversable

Floats = NDArray[np.float64]

MAX_PATHS = 8  # in a panel; more would hide each other


# From skill 2, orange, over violet to skill 1, dark blue; steadily darker, so that it can be read
# in grayscale. `ground.SKILL_MAP` is not: it ends in the colors of the skills.
_WEIGHT_MAP = ListedColormap(colormaps["plasma"](np.linspace(0.8, 0.0, 256)))


_LEFT_IN, _BELOW_IN, _HEAD_IN = 0.6, 0.95, 0.55
"""Room for the labels at the left, for those and the legend below, and for the head, inches."""
_TITLE_IN, _GAP_IN, _BAR_IN, _TALLEST_IN = 0.32, 0.18, 0.8, 9.0
"""Height of a panel's title, gap beside a panel, width of a color bar with its labels, and height
of the tallest panel, inches."""


class _Panel(NamedTuple):
    """A goal (x, y) m and the indices of its episodes; `reached` begins with the fastest."""

    goal: tuple[float, float]
    failed: NDArray[np.intp]
    reached: NDArray[np.intp]
    total: int


def trajectories(
    occupancy_map: OccupancyMap,
    goals: ArrayLike,
    poses: ArrayLike,
    skill_weights: ArrayLike,
    success: ArrayLike,
    time_steps: ArrayLike,
    *,
    goal_radius: float,
    title: str,
    max_panels: int = 4,
    robot_radius: float = 0.1,
) -> Figure:
    """Draw the paths of E episodes over the distance field of their goals, a panel for each goal.

    A path ends where it first enters the goal radius; without success it is drawn to its end, which
    is marked by a cross. Its color is the weight of the first skill in each step. A panel has at
    most `MAX_PATHS` paths. Half of them are failures (more if there are not enough successes); the
    successes are evenly spaced from the fastest to the slowest. The title counts all episodes; its
    steps are the mean over those that reached the goal.

    If there are more goals than panels, half of the panels are for the goals with the most failures
    and the others for those with the most episodes; of equal goals, the one farthest from those
    chosen before is next.

    Args:
        occupancy_map: the map of the episodes.
        goals: [E, 2] x m, y m in the grid frame; equal within 1e-6 m means the same goal.
        poses: [T + 1, E, 3] x m, y m, heading rad; the first is the start.
        skill_weights: [T, E, K] in 0..1 for each step; K = 1 gives one color.
        success: [E] bool, whether the goal was reached.
        time_steps: [E] int, the step that entered the goal radius, counted from 1; ignored for
            failures.
        goal_radius: m.
        title: above all panels.
        max_panels: largest number of goals shown, >= 1.
        robot_radius: m; where the robot does not fit, there is no distance to the goal.

    Raises:
        ValueError: inconsistent shapes, no episode, or a goal outside the free cells.
    """
    goals, poses = np.asarray(goals, dtype=np.float64), np.asarray(poses, dtype=np.float64)
    weights = np.asarray(skill_weights, dtype=np.float64)
    success, steps = np.asarray(success, dtype=bool), np.asarray(time_steps)
    _check_shapes(weights, poses=poses, goals=goals, success=success, time_steps=steps)
    length, count, skills = weights.shape
    all_panels = _panels_of(goals, success, steps)
    panels = _chosen_panels(all_panels, max_panels)
    free = traversable(occupancy_map.occupied, occupancy_map.resolution, robot_radius)
    fields = goal_distance(free, occupancy_map.resolution, [panel.goal for panel in panels])
    figure, grid, bars = _panel_grid(occupancy_map, len(panels), num_bars=2 if skills > 1 else 1)
    norm = Normalize(0.0, float(fields[np.isfinite(fields)].max()))
    for axes, panel, field in zip(grid, panels, fields, strict=True):
        image = draw_field(axes, occupancy_map, field, norm)
        for episode in _chosen_episodes(panel):
            end = int(steps[episode]) if success[episode] else length
            colors = weights[:end, episode, 0] if skills > 1 else None
            _draw_path(axes, poses[: end + 1, episode], colors, reached=bool(success[episode]))
        _draw_goal(axes, panel, steps, goal_radius)
    figure.colorbar(image, cax=bars[0], label="path to the goal, m")
    if skills > 1:
        lines = next(child for child in grid[0].collections if isinstance(child, LineCollection))
        figure.colorbar(lines, cax=bars[1], label=SKILL_LABEL)
    _add_legend(figure, goal_radius, any_failure=any(panel.failed.size for panel in panels))
    shown = f"{success.sum()} of {count} reached"
    if len(panels) < len(all_panels):
        shown += f", {len(panels)} of {len(all_panels)} goals shown"
    if max(panel.total for panel in panels) > MAX_PATHS:
        shown += f", at most {MAX_PATHS} paths a goal drawn"
    height_in = figure.get_figheight()
    figure.suptitle(plain(f"{title}\n{shown}"), y=1 - 0.08 / height_in, va="top", fontsize=12)
    return figure


def _check_shapes(weights: Floats, **arrays: NDArray[Any]) -> None:
    """Raise ValueError if an array does not fit `weights` [T, E, K]."""
    if weights.ndim != 3 or weights.size == 0:
        raise ValueError(f"skill_weights has the shape {weights.shape}, expected [T, E, K], none 0")
    length, count, _ = weights.shape
    expected = {"poses": (length + 1, count, 3), "goals": (count, 2)}
    for name, array in arrays.items():
        shape = expected.get(name, (count,))
        if array.shape != shape:
            raise ValueError(f"{name} has the shape {array.shape}, expected {shape}")


def _panels_of(goals: Floats, success: NDArray[np.bool_], steps: NDArray[Any]) -> list[_Panel]:
    """Group episodes by goal, in the order of their first appearance."""
    panels = []
    remaining = np.arange(len(goals))
    while remaining.size:
        first = goals[remaining[0]]
        same_goal = np.abs(goals[remaining] - first).max(axis=1) <= 1e-6
        members, (x, y) = remaining[same_goal], first
        reached = members[success[members]]
        by_steps = np.argsort(steps[reached], kind="stable")
        panels.append(_Panel((x, y), members[~success[members]], reached[by_steps], members.size))
        remaining = remaining[~same_goal]
    return panels


def _chosen_panels(panels: list[_Panel], limit: int) -> list[_Panel]:
    """At most `limit` panels, by the rule in `trajectories`."""
    chosen: list[_Panel] = []

    def rank(panel: _Panel) -> tuple[int, int, float]:
        distance = min((math.dist(panel.goal, other.goal) for other in chosen), default=0.0)
        failures = panel.failed.size if 2 * len(chosen) < limit else 0
        return failures, panel.total, distance

    remaining = list(panels)
    while remaining and len(chosen) < limit < len(panels):
        best = max(range(len(remaining)), key=lambda i: rank(remaining[i]))
        chosen.append(remaining.pop(best))
    return chosen or panels


def _chosen_episodes(panel: _Panel) -> NDArray[np.intp]:
    """The episodes to draw, failures first, by the rule in `trajectories`."""
    failed = _evenly(panel.failed, max(MAX_PATHS // 2, MAX_PATHS - panel.reached.size))
    return np.concatenate([failed, _evenly(panel.reached, MAX_PATHS - failed.size)])


def _evenly(items: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """At most `count` items, evenly spaced from the first to the last."""
    return items[np.linspace(0, items.size - 1, min(count, items.size)).round().astype(int)]


def _panel_grid(
    occupancy_map: OccupancyMap, count: int, *, num_bars: int
) -> tuple[Figure, list[Axes], list[Axes]]:
    """A figure with a panel for each goal, and places for color bars at the right.

    All places are computed here: what Matplotlib lays out by itself takes a second, since panels of
    a fixed aspect need two passes.
    """
    columns = min(count, 2)  # with three the titles would overlap
    rows = math.ceil(count / columns)
    map_width, map_height = occupancy_map.size_m
    bars_left = WIDTH_IN - _BAR_IN * num_bars
    width = (bars_left - _LEFT_IN - _GAP_IN * columns) / columns
    height = width * map_height / map_width
    if height > _TALLEST_IN:
        width, height = _TALLEST_IN * map_width / map_height, _TALLEST_IN
    rows_in = rows * height + (rows - 1) * _TITLE_IN
    height_in = _BELOW_IN + rows_in + _TITLE_IN + _HEAD_IN
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI)
    # Narrow panels stand in the middle of what is left for them.
    spare = (bars_left - _LEFT_IN - columns * (width + _GAP_IN)) / 2

    def axes_at(left: float, bottom: float, width: float, height: float, **shared: Any) -> Axes:
        place = (left / WIDTH_IN, bottom / height_in, width / WIDTH_IN, height / height_in)
        return figure.add_axes(place, **shared)

    grid: list[Axes] = []
    for number in range(count):
        row, column = divmod(number, columns)
        is_lowest, is_leftmost = number + columns >= count, column == 0
        axes = axes_at(
            _LEFT_IN + spare + column * (width + _GAP_IN),
            _BELOW_IN + (rows - 1 - row) * (height + _TITLE_IN),
            width,
            height,
            **({"sharex": grid[0], "sharey": grid[0]} if grid else {}),
        )
        axes.set(aspect="equal", xlim=(0, map_width), ylim=(0, map_height))
        axes.set(xlabel="x, m" if is_lowest else "", ylabel="y, m" if is_leftmost else "")
        axes.locator_params(nbins=9, steps=[1, 2, 5, 10])
        axes.tick_params(labelsize=9, labelbottom=is_lowest, labelleft=is_leftmost)
        grid.append(axes)
    right = WIDTH_IN - _BAR_IN * num_bars - spare
    bars = [axes_at(right + _BAR_IN * i, _BELOW_IN, 0.14, rows_in) for i in range(num_bars)]
    return figure, grid, bars


def _draw_path(axes: Axes, poses: Floats, weights: Floats | None, *, reached: bool) -> None:
    """Draw a path [S + 1, 3], colored by the weights [S] of its steps, with its start and end."""
    points = poses[:, :2]
    segments = list(np.stack([points[:-1], points[1:]], axis=1))
    width, order = (2.0, 3) if reached else (1.4, 2)
    lines = LineCollection(segments, linewidths=width, capstyle="round", zorder=order)
    if weights is None:
        lines.set_color(COLORS[0])
    else:
        lines.set(array=weights, cmap=_WEIGHT_MAP, norm=Normalize(0.0, 1.0))
    axes.add_collection(lines, autolim=False)
    axes.plot(*points[0], "o", ms=6, mfc="white", mec=INK, mew=1.3, zorder=5)
    if not reached:
        draw_cross(axes, *points[-1])


def _draw_goal(axes: Axes, panel: _Panel, steps: NDArray[Any], goal_radius: float) -> None:
    """Draw the goal; the title has the number of successes and their mean number of steps."""
    axes.add_patch(Circle(panel.goal, goal_radius, fill=False, ec=INK, lw=1.2, zorder=4))
    axes.plot(*panel.goal, "*", ms=11, mfc=YELLOW, mec=INK, mew=1.0, zorder=7)
    mean = f", {steps[panel.reached].mean():.0f} steps" if panel.reached.size else ""
    goal = f"goal ({panel.goal[0]:.1f}, {panel.goal[1]:.1f}) m"
    axes.set_title(f"{goal}: {panel.reached.size} of {panel.total} reached{mean}", fontsize=10)


def _add_legend(figure: Figure, goal_radius: float, *, any_failure: bool) -> None:
    """Add the legend of the markers below the panels."""
    markers = [("start", "o", 6, "white", INK), ("goal", "*", 11, YELLOW, INK)]
    markers.append((f"goal radius {goal_radius:g} m", "o", 10, "none", INK))
    if any_failure:
        markers.append(("not reached", "x", 9, "none", RED))
    handles: list[Line2D | Patch] = [
        Line2D([], [], ls="", marker=marker, ms=size, mfc=face, mec=edge, mew=1.3, label=label)
        for label, marker, size, face, edge in markers
    ]
    handles += [
        Patch(fc=OBSTACLE, label="obstacle"),
        Patch(fc=UNREACHABLE, label="no path to the goal"),
    ]
    options: dict[str, Any] = {"ncols": len(handles), "frameon": False, "columnspacing": 1.4}
    figure.legend(handles=handles, loc="lower center", fontsize=9, **options)
