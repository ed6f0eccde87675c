"""The maps side by side, and the scans of the robot in them."""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures.ground import FREE, SEEN, UNREACHABLE, arrowhead, draw_map, extent
from sqn_jax.figures.style import COLORS, DPI, INK, OBSTACLE, WIDTH_IN, plain
from sqn_jax.maps import OccupancyMap, reachable_cells

MAX_SCANS = 6  # below each map in `observation_patterns`
# What a cell is to the center of a robot, and its color.
_KINDS = {"within reach": SEEN, "free": FREE, "unknown": UNREACHABLE, "occupied": OBSTACLE}
_NUMBERED: dict[str, Any] = {"ls": "", "marker": "o", "ms": 11, "mec": "white"}


def map_gallery(maps: Sequence[OccupancyMap]) -> Figure:
    """Draw maps side by side, axes in m, with numbered evaluation points.

    Raises:
        ValueError: no maps.
    """
    if not maps:
        raise ValueError("no maps, expected at least one")
    height = WIDTH_IN / len(maps) + 0.45
    figure = Figure(figsize=(WIDTH_IN, height), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, occupancy_map in zip(panels, maps, strict=True):
        _draw_panel(axes, occupancy_map)
        for number, point in enumerate(occupancy_map.evaluation_points, start=1):
            _draw_point(axes, point, str(number), COLORS[1])
    panels[0].set_ylabel("y [m]", fontsize=8)
    return figure


def map_picture(occupancy_map: OccupancyMap, robot_radius: float) -> Figure:
    """Draw one map as a robot meets it, axes in m of the map frame, in which files name points.

    The ground that it can reach is tinted. Spawn points are dots, evaluation points numbered ones.

    Args:
        occupancy_map: one map, or several side by side, which `validate` accepts.
        robot_radius: m.
    """
    kinds = _kinds(occupancy_map, robot_radius)
    width_m, height_m = occupancy_map.size_m
    corners = occupancy_map.to_map_frame([(0, 0), (width_m, 0), (0, height_m), (width_m, height_m)])
    (left, bottom), (right, top) = corners.min(axis=0), corners.max(axis=0)
    height = (WIDTH_IN - 0.6) * (top - bottom) / (right - left)
    figure = Figure(
        figsize=(WIDTH_IN, min(max(height, 1.5), 1.5 * WIDTH_IN) + 1.4),
        dpi=DPI,
        layout="constrained",
    )
    axes = figure.subplots()
    x, y, yaw = occupancy_map.origin
    axes.imshow(
        kinds,
        cmap=ListedColormap(list(_KINDS.values())),
        vmin=0,
        vmax=len(_KINDS) - 1,
        interpolation="antialiased",
        interpolation_stage="rgba",
        transform=Affine2D().rotate(yaw).translate(x, y) + axes.transData,
        **extent(occupancy_map),
    )
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    _label_panel(axes, occupancy_map)
    axes.set_ylabel("y [m]", fontsize=8)
    spawn = occupancy_map.to_map_frame(occupancy_map.spawn_points)
    axes.plot(*spawn.T, "o", ls="", ms=5, color=COLORS[0], mec="white", label="spawn point")
    for number, point in enumerate(occupancy_map.evaluation_points, start=1):
        _draw_point(axes, occupancy_map.to_map_frame(point), str(number), COLORS[1])
    shown: list[Artist] = [
        Patch(fc=color, ec=INK, lw=0.5, label=kind)
        for kind, color in _KINDS.items()
        if (kinds == list(_KINDS).index(kind)).any()
    ]
    shown += [axes.lines[0], Line2D([], [], label="evaluation point", **_NUMBERED, color=COLORS[1])]
    figure.legend(handles=shown, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def _kinds(occupancy_map: OccupancyMap, robot_radius: float) -> NDArray[np.uint8]:
    """Of every cell [H, W] which of `_KINDS` it is."""
    kinds = list(_KINDS)
    cells = np.where(occupancy_map.occupied, kinds.index("occupied"), kinds.index("free"))
    cells[reachable_cells(occupancy_map, robot_radius)] = kinds.index("within reach")
    if occupancy_map.unknown is not None:
        cells[occupancy_map.unknown & occupancy_map.occupied] = kinds.index("unknown")
    return cells.astype(np.uint8)


def _draw_panel(axes: Axes, occupancy_map: OccupancyMap) -> None:
    """Draw a map with its name and size."""
    draw_map(axes, occupancy_map)
    _label_panel(axes, occupancy_map)


def _label_panel(axes: Axes, occupancy_map: OccupancyMap) -> None:
    width_m, height_m = occupancy_map.size_m
    axes.set_title(plain(f"{occupancy_map.name}, {width_m:.4g} x {height_m:.4g} m"), fontsize=10)
    axes.tick_params(labelsize=7)
    axes.set_xlabel("x [m]", fontsize=8)


def _draw_point(axes: Axes, point: NDArray[np.floating], name: str, color: str) -> None:
    """Draw a dot at a point x m, y m with a short name in it."""
    x, y = (float(value) for value in point)
    axes.plot(x, y, color=color, **_NUMBERED)
    style: dict[str, Any] = {"color": "white", "fontsize": 7, "fontweight": "bold"}
    axes.annotate(name, (x, y), ha="center", va="center", **style)


def observation_patterns(
    episodes: Sequence[Episode], *, scans: int = 4, title: str = "What the robot sees"
) -> Figure:
    """Draw maps, and below each map scans from a few places (paper, maps).

    A pattern is the outline of a scan in the robot's frame, forward to the right, within a circle
    of the sensor's range. Its letter marks the place on the map. The places are those of the path
    to the goal that are farthest from each other, starting with the start.

    Args:
        episodes: one for each map.
        scans: patterns per map, 1..6.
        title: above all panels.

    Raises:
        ValueError: no episode, or the number of scans is out of its range.
    """
    if not episodes:
        raise ValueError("no episodes, expected at least one a map")
    if not 1 <= scans <= MAX_SCANS:
        raise ValueError(f"scans is {scans}, expected 1 to {MAX_SCANS}")
    columns = 1 if scans == 1 else 2
    rows = -(-scans // columns)
    width = WIDTH_IN / len(episodes)
    tallest = max(e.occupancy_map.size_m[1] / e.occupancy_map.size_m[0] for e in episodes)
    heights = [min(width * tallest, 6.0) + 0.2, rows * min(width / columns, 2.2)]
    size = (WIDTH_IN, sum(heights) + 0.8)
    figure = Figure(figsize=size, dpi=DPI)
    figure.set_layout_engine("constrained", w_pad=0.01, wspace=0.0)
    grid = figure.add_gridspec(2, len(episodes), height_ratios=heights)
    for column, episode in enumerate(episodes):
        above = figure.add_subplot(grid[0, column])
        _draw_panel(above, episode.occupancy_map)
        above.locator_params(nbins=6, steps=[1, 2, 5, 10])
        if column == 0:
            above.set_ylabel("y [m]", fontsize=8)
        # A narrow empty column separates the patterns of neighboring maps.
        below = grid[1, column].subgridspec(rows, columns + 1, width_ratios=[1] * columns + [0.1])
        for number, index in enumerate(spread_steps(episode, scans)):
            letter = string.ascii_uppercase[number]
            _draw_point(above, episode.poses[index, :2], letter, COLORS[0])
            _draw_pattern(
                figure.add_subplot(below[divmod(number, columns)]), episode, index, letter
            )
    reach = f"{episodes[0].max_range:g} m"
    figure.suptitle(plain(title))
    figure.supxlabel(
        f"circle: {reach}, the range of the sensor; the robot looks to the right", fontsize=9
    )
    return figure


def spread_steps(episode: Episode, count: int) -> list[int]:
    """Steps in 0..T up to the goal at points far apart: each is the farthest from those before."""
    points = episode.poses[: episode.time_steps + 1, :2]
    chosen = [0]
    distances = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return sorted(chosen)


def _draw_pattern(axes: Axes, episode: Episode, index: int, letter: str) -> None:
    """Draw a scan in the robot's frame: x m forward points right, y m to its left points up."""
    angles, reach = episode.beam_angles(), episode.ranges[index]
    ends = np.stack([reach * np.cos(angles), reach * np.sin(angles)], axis=-1)
    outline = np.concatenate([ends, np.zeros((1, 2))])
    axes.add_patch(Polygon(outline, fc=COLORS[4], alpha=0.45, ec="none"))
    axes.plot(*ends.T, ".", ms=2.2, color=COLORS[0])
    axes.add_patch(Circle((0.0, 0.0), episode.max_range, fill=False, ec="0.6", lw=0.8))
    axes.add_patch(arrowhead((0.0, 0.0, 0.0), 0.2 * episode.max_range))
    edge = 1.04 * episode.max_range
    axes.set(aspect="equal", xlim=(-edge, edge), ylim=(-edge, edge))
    axes.axis("off")
    axes.text(-edge, edge, letter, ha="left", va="top", fontsize=9, fontweight="bold", color=INK)
