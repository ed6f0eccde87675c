"""Elements of the pictures: map, distance field, scan, robot, start, goal, paths, legends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from numpy.typing import ArrayLike, NDArray

from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures.style import COLORS, INK, OBSTACLE
from sqn_jax.maps import OccupancyMap

Floats = NDArray[np.floating]

UNREACHABLE, RED, YELLOW, FREE, SEEN = "#b9b9b9", "#b00020", "#ffd92f", "#f7f7f4", "#cfe3c8"

# Few and light shades, so that their edges look like contour lines and paths stand out.
FIELD_MAP = ListedColormap(np.linspace([0.985, 0.99, 0.975], [0.70, 0.80, 0.82], 12))
# From the color of skill 2 over gray to that of skill 1; paths have a dark edge around the gray.
SKILL_MAP = LinearSegmentedColormap.from_list("skills", [COLORS[1], "#dcdcdc", COLORS[0]], 255)
ONE_SKILL = COLORS[3]
SKILL_LABEL = "weight of skill 1"


def extent(occupancy_map: OccupancyMap) -> dict[str, Any]:
    """Options of `imshow` that place [H, W] cells in coordinates in m, row 0 at the bottom."""
    width, height = occupancy_map.size_m
    return {"origin": "lower", "extent": (0.0, width, 0.0, height)}


def draw_map(axes: Axes, occupancy_map: OccupancyMap) -> AxesImage:
    """Draw the map: obstacles dark, free cells light."""
    cells = ListedColormap([FREE, OBSTACLE])
    options = {**extent(occupancy_map), "interpolation": "nearest"}
    return axes.imshow(occupancy_map.occupied, cmap=cells, vmin=0, vmax=1, **options)


def draw_field(
    axes: Axes, occupancy_map: OccupancyMap, field: NDArray[np.float32], norm: Normalize
) -> AxesImage:
    """Draw a distance field [H, W], m: obstacles dark, cells without a path to the goal gray."""
    options = extent(occupancy_map)
    cells = ListedColormap([UNREACHABLE, OBSTACLE])
    axes.imshow(occupancy_map.occupied, cmap=cells, vmin=0, vmax=1, **options)
    return axes.imshow(np.ma.masked_invalid(field), cmap=FIELD_MAP, norm=norm, **options)


def draw_seen(axes: Axes, episode: Episode, index: int) -> None:
    """Draw the map and tint the area seen before step `index`; obstacles are on top."""
    occupied = episode.occupancy_map.occupied
    seen = episode.covered_mask(index, (occupied.shape[0], occupied.shape[1]))
    options = extent(episode.occupancy_map)
    axes.imshow(seen, cmap=ListedColormap([FREE, SEEN]), vmin=0, vmax=1, **options)
    obstacles = np.ma.masked_where(~occupied, occupied)
    axes.imshow(obstacles, cmap=ListedColormap([OBSTACLE]), **options)


def draw_scan(axes: Axes, episode: Episode, index: int) -> None:
    """Draw the area between the robot and the ends of its beams before step `index`.

    The polygon is closed at the robot, since there are no beams behind it.
    """
    corners = np.concatenate([episode.beam_ends(index), episode.poses[index, None, :2]])
    color = COLORS[4]
    axes.add_patch(Polygon(corners, fc=to_rgba(color, 0.3), ec=color, lw=1.0, zorder=2))


def draw_robot(axes: Axes, episode: Episode, index: int, *, size: float) -> None:
    """Draw an arrowhead of `size` m along the heading, centered on the robot."""
    axes.add_patch(arrowhead(episode.poses[index], size))


def arrowhead(pose: ArrayLike, size: float) -> Polygon:
    """An arrowhead at a pose (x m, y m, heading rad) along the heading, of length `size` m."""
    x, y, heading = np.asarray(pose, dtype=np.float64)
    corners = size * np.array([[0.6, 0.0], [-0.4, 0.4], [-0.2, 0.0], [-0.4, -0.4]])
    cosine, sine = math.cos(heading), math.sin(heading)
    rotated = corners @ np.array([[cosine, sine], [-sine, cosine]])
    return Polygon(rotated + np.array([x, y]), fc=INK, ec="white", lw=0.7, zorder=8)


def draw_start(axes: Axes, episode: Episode) -> None:
    """Draw a white dot at the start; above a star, since it may be the goal of other episodes."""
    axes.plot(*episode.poses[0, :2], "o", ms=5, mfc="white", mec=INK, mew=1.2, zorder=7.5)


def draw_goal(axes: Axes, episode: Episode) -> None:
    """Draw a star at the goal, and a circle of the goal radius."""
    x, y = (float(value) for value in episode.goal)
    axes.add_patch(Circle((x, y), episode.goal_radius, fill=False, ec=INK, lw=1.2, zorder=4))
    axes.plot(x, y, "*", ms=14, mfc=YELLOW, mec=INK, mew=1.0, zorder=7)


def draw_cross(axes: Axes, x: float, y: float) -> None:
    """Draw a red cross at the end of a failure."""
    cross = axes.plot(x, y, "x", ms=9, mec=RED, mew=2.5, zorder=6)[0]
    cross.set_path_effects([patheffects.withStroke(linewidth=4.5, foreground="white")])


def mark_arrival(axes: Axes, episode: Episode) -> None:
    """Draw a vertical line over a time axis, s, at the entry into the goal radius."""
    axes.axvline(episode.time_steps * episode.time_step, color=INK, ls=":", lw=1.4)


def draw_skill_path(axes: Axes, episode: Episode) -> LineCollection:
    """Draw the path up to the goal; the color of a step is that of its skill decision.

    With two skills the color is the weight of the first one. With more it is that of the skill with
    the largest weight. An agent without skills has one color. Start and goal are marked, and also
    the end of a failure.
    """
    end = episode.time_steps
    points = episode.poses[: end + 1, :2].astype(np.float64)
    segments = list(np.stack([points[:-1], points[1:]], axis=1))
    lines = LineCollection(segments, linewidths=2.6, capstyle="round", zorder=3)
    weights = episode.skill_weights[:end]
    if weights.shape[1] == 2:
        lines.set(array=weights[:, 0], cmap=SKILL_MAP, norm=Normalize(0.0, 1.0))
    elif weights.shape[1] == 1:
        lines.set_color(ONE_SKILL)
    else:
        lines.set_color([skill_color(skill) for skill in weights.argmax(axis=1)])
    axes.plot(*points.T, color=INK, lw=3.8, solid_capstyle="round", zorder=2.9)
    axes.add_collection(lines, autolim=False)
    draw_start(axes, episode)
    draw_goal(axes, episode)
    if not episode.success:
        draw_cross(axes, *points[-1])
    return lines


def skill_color(skill: int) -> str:
    """The color of a skill, counted from 0; it is the same in all pictures."""
    return COLORS[skill % len(COLORS)]


def path_legend(episodes: Sequence[Episode]) -> list[Line2D | Patch]:
    """Legend entries for the paths of these episodes; two skills have a color bar instead."""
    markers = [("start", "o", 5, "white", INK), ("goal", "*", 13, YELLOW, INK)]
    if not all(episode.success for episode in episodes):
        markers.append(("not reached", "x", 9, "none", RED))
    handles: list[Line2D | Patch] = [
        Line2D([], [], ls="", marker=marker, ms=size, mfc=face, mec=edge, mew=1.3, label=label)
        for label, marker, size, face, edge in markers
    ]
    counts = {episode.skill_weights.shape[1] for episode in episodes}
    if 1 in counts:
        handles.append(Line2D([], [], color=ONE_SKILL, lw=3, label="agent without skills"))
    if max(counts) > 2:
        handles += [
            Line2D([], [], color=skill_color(skill), lw=3, label=f"mostly skill {skill + 1}")
            for skill in range(max(counts))
        ]
    return handles


def skill_bar(figure: Figure, axes: Sequence[Axes]) -> None:
    """Add the color scale of the paths of two skills below panels."""
    scale = ScalarMappable(Normalize(0.0, 1.0), SKILL_MAP)
    bar = scale_below(figure, scale, axes, SKILL_LABEL)
    bar.set_ticks(
        [0, 0.25, 0.5, 0.75, 1], labels=["0: skill 2", "0.25", "0.5", "0.75", "1: skill 1"]
    )


def scale_below(
    figure: Figure, scale: ScalarMappable, axes: Sequence[Axes], label: str
) -> Colorbar:
    """Add a color bar below panels; beside them it would reduce their width."""
    options: dict[str, Any] = {"location": "bottom", "shrink": 0.6, "aspect": 45, "pad": 0.02}
    bar = figure.colorbar(scale, ax=list(axes), **options)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return bar
