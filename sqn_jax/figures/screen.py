"""The frames of an animation: their layout, and fast repeated drawing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle
from matplotlib.path import Path
from numpy.typing import NDArray

from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures.episode import REWARD_TERMS, reward_sums
from sqn_jax.figures.ground import (
    FREE,
    ONE_SKILL,
    RED,
    SEEN,
    SKILL_MAP,
    YELLOW,
    arrowhead,
    skill_color,
)
from sqn_jax.figures.style import COLORS, INK, OBSTACLE, tidy

WIDTH, HEIGHT = 800, 580
"""Size of the frame for which the boxes below are given, pixels; other frames are scaled."""

MAP_BOX = (12, 44, 496, 496)
VIEW_BOX = (534, 62, 254, 254)
SKILL_BOX = (534, 346, 254, 16)
REWARD_BOX = (574, 418, 214, 116)
"""Left, top, width, height; pixels from the upper left corner."""

AFTER_ARRIVAL = 2.0
"""Time shown after the arrival, s of the episode."""

ROBOT = COLORS[5]
ROBOT_PX = 19
SCAN = COLORS[4]
REACHED = "#00704f"

KEY_COLORS = (
    *("#ffffff", FREE, SEEN, OBSTACLE, INK, ROBOT, SCAN, YELLOW, RED, REACHED, ONE_SKILL),
    *COLORS,
)
"""Colors that must be part of a palette."""


def rgb(color: str) -> NDArray[np.uint8]:
    """A color as [3] uint8."""
    return np.rint(255 * np.array(to_rgb(color))).astype(np.uint8)


def last_step(episode: Episode) -> int:
    """The last state 0..T of an animation: shortly after the arrival, if there is one."""
    if not episode.success:
        return episode.num_steps
    after = round(AFTER_ARRIVAL / episode.time_step)
    return min(episode.num_steps, episode.time_steps + after)


def _path_colors(weights: NDArray[np.floating]) -> NDArray[np.floating]:
    """RGBA [T, 4] of the steps of a path from their skill weights [T, K]."""
    skills = weights.shape[1]
    if skills == 1:
        return np.tile(to_rgba_array(ONE_SKILL), (len(weights), 1))
    if skills == 2:
        return np.asarray(SKILL_MAP(weights[:, 0].astype(np.float64)))
    return to_rgba_array([skill_color(int(skill)) for skill in weights.argmax(axis=1)])


class Screen:
    """A canvas on which the states of an episode are drawn one after another."""

    def __init__(self, episode: Episode, width_px: int, height_px: int) -> None:
        self.episode = episode
        self._scale = width_px / WIDTH
        dpi = width_px / 8
        # Slightly more than the height, or rounding removes a row of pixels.
        size = (8.0, (height_px + 0.01) / dpi)
        self.figure = Figure(figsize=size, dpi=dpi)
        self._canvas = FigureCanvasAgg(self.figure)
        self._size = (height_px, width_px)
        self._moving: list[tuple[Axes | None, Artist]] = []
        self._make_map()
        self._make_view()
        self._make_skills()
        self._make_rewards()
        self._make_status()
        for _, artist in self._moving:
            artist.set_animated(True)
        self._canvas.draw()
        self._pixels = np.asarray(self._canvas.buffer_rgba())
        self._background = self._pixels.copy()

    def draw(self, index: int) -> NDArray[np.uint8]:
        """The frame [h, w, 4] RGBA for the state before step `index` (0..T)."""
        self._update_map(index)
        self._update_view(index)
        self._update_skills(index)
        self._update_rewards(index)
        self._update_status(index)
        self._pixels[:] = self._background
        top, left = self.map_corner
        mask = self._seen(index)
        rows, columns = mask.shape
        panel = self._pixels.view(np.uint32)[top : top + rows, left : left + columns, 0]
        panel[:] = np.where(mask, self._tinted, self._unseen)
        renderer = self._canvas.get_renderer()
        for axes, artist in self._moving:
            if axes is None:
                artist.draw(renderer)
            else:
                axes.draw_artist(artist)
        return self._pixels.copy()

    # ---------------------------------------------------------------------------------------- map

    def _make_map(self) -> None:
        episode = self.episode
        width, height = episode.occupancy_map.size_m
        left, top, box, _ = (round(value * self._scale) for value in MAP_BOX)
        self.pixels_per_meter = box / max(width, height)
        columns = max(round(width * self.pixels_per_meter), 1)
        rows = max(round(height * self.pixels_per_meter), 1)
        self.map_corner = (top + (box - rows) // 2, left + (box - columns) // 2)
        box_px = (self.map_corner[1], self.map_corner[0], columns, rows)
        axes = self._axes(box_px, scaled=False)
        axes.set(xlim=(0, width), ylim=(0, height), xticks=[], yticks=[])
        axes.patch.set_visible(False)
        self._unseen, self._tinted = self._map_pixels(rows, columns)
        x, y = np.meshgrid(
            (np.arange(columns) + 0.5) * width / columns,
            (np.arange(rows)[::-1] + 0.5) * height / rows,
        )
        points = (*episode.lattice.shape, 32)
        self._nearest = np.ravel_multi_index(episode.lattice.nearest_point(x, y), points)
        self._points = episode.poses[:, :2].astype(np.float64)
        self._scan = self._add(axes, axes.fill([], [], fc=(*to_rgb(SCAN), 0.35), ec=SCAN, lw=1)[0])
        style: dict[str, Any] = {"solid_capstyle": "round", "solid_joinstyle": "round"}
        self._edge = self._add(axes, axes.plot([], [], color=INK, lw=3.6, **style)[0])
        pairs = np.stack([self._points[:-1], self._points[1:]], axis=1)
        self._segments = [Path(pair) for pair in pairs]
        self._colors: Any = _path_colors(episode.skill_weights)
        self._path = PathCollection([], linewidths=2.4, capstyle="round", facecolors="none")
        axes.add_collection(self._path, autolim=False)
        self._add(axes, self._path)
        start = axes.plot(*self._points[0], "o", ms=6, mfc="white", mec=INK, mew=1.3)[0]
        goal = (float(episode.goal[0]), float(episode.goal[1]))
        self._add(axes, start)
        circle = Circle(goal, episode.goal_radius, fill=False, ec=INK, lw=1.2)
        self._add(axes, axes.add_patch(circle))
        self._add(axes, axes.plot(*goal, "*", ms=12, mfc=YELLOW, mec=INK, mew=1.0)[0])
        self._arrow_m = max(
            ROBOT_PX * self._scale / self.pixels_per_meter, 3 * episode.robot_radius
        )
        robot = arrowhead(episode.poses[0], self._arrow_m)
        robot.set(fc=ROBOT, ec=INK, lw=1.0)
        axes.add_patch(robot)
        self._robot = self._add(axes, robot)
        self._draw_legend(box_px)

    def _map_pixels(self, rows: int, columns: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """The map [rows, columns] RGBA in 32 bits with nothing seen, and with everything seen.

        A pixel is as dark as its fraction of obstacles, so that thin walls do not vanish.
        """
        occupied = self.episode.occupancy_map.occupied
        fine = 4  # samples per pixel and axis
        y, x = (
            ((np.arange(count * fine) + 0.5) * cells / (count * fine)).astype(int)
            for count, cells in zip((rows, columns), occupied.shape, strict=True)
        )
        samples = occupied[y[::-1]][:, x].reshape(rows, fine, columns, fine)
        fraction = samples.mean(axis=(1, 3))[..., None]
        opaque = np.full((rows, columns, 4), 255, np.uint8)
        pictures = []
        for ground in (FREE, SEEN):
            opaque[..., :3] = np.rint(fraction * rgb(OBSTACLE) + (1 - fraction) * rgb(ground))
            pictures.append(opaque.view(np.uint32)[..., 0].copy())
        unseen, tinted = pictures
        return unseen, tinted

    def _seen(self, index: int) -> NDArray[np.bool_]:
        """`Episode.covered_mask` at the pixels of the panel, top row first."""
        mask: NDArray[np.bool_] = self.episode.covered_bits(index).ravel()[self._nearest]
        return mask

    def _draw_legend(self, box: tuple[int, int, int, int]) -> None:
        """Draw the scale and the legend below the map."""
        longest = 80 * self._scale / self.pixels_per_meter
        length = max((m for m in (0.5, 1, 2, 5, 10, 20, 50, 100) if m <= longest), default=0.2)
        left, bottom = box[0], box[1] + box[3]
        x = np.array([left, left + length * self.pixels_per_meter]) / self._size[1]
        y = 1 - (bottom + 12 * self._scale) / self._size[0]
        self.figure.add_artist(Line2D(x, [y, y], color=INK, lw=2, solid_capstyle="butt"))
        self.figure.text(x.mean(), y - 0.012, f"{length:g} m", ha="center", va="top", fontsize=8)
        markers = [("start", "o", 6, "white"), ("goal", "*", 11, YELLOW), ("robot", "^", 8, ROBOT)]
        handles: list[Line2D | Patch] = [
            Line2D([], [], ls="", marker=marker, ms=size, mfc=face, mec=INK, label=label)
            for label, marker, size, face in markers
        ]
        handles.append(Patch(fc=SEEN, ec="0.6", lw=0.5, label="seen"))
        handles.append(Patch(fc=(*to_rgb(SCAN), 0.35), ec=SCAN, label="scan"))
        # More than two skills have their numbers in color above their bar.
        path_labels = {
            1: [("path", ONE_SKILL)],
            2: [(f"skill {k + 1}", skill_color(k)) for k in (0, 1)],
        }
        handles += [
            Line2D([], [], color=color, lw=3, label=name)
            for name, color in path_labels.get(self.episode.skill_weights.shape[1], [])
        ]
        right = (MAP_BOX[0] + MAP_BOX[2]) / WIDTH
        options: dict[str, Any] = {"frameon": False, "columnspacing": 1.1, "handletextpad": 0.4}
        options |= {"handlelength": 1.3, "borderaxespad": 0, "borderpad": 0, "fontsize": 8}
        anchor = (right, 1 - (bottom + 9 * self._scale) / self._size[0])
        self.figure.legend(
            handles=handles, ncols=len(handles), loc="upper right", bbox_to_anchor=anchor, **options
        )

    def _update_map(self, index: int) -> None:
        episode = self.episode
        corners = np.concatenate([episode.beam_ends(index), episode.poses[index, None, :2]])
        self._scan.set_xy(corners)
        self._edge.set_data(*self._points[: index + 1].T)
        self._path.set_paths(self._segments[:index])
        self._path.set_edgecolor(self._colors[:index])
        self._robot.set_xy(arrowhead(episode.poses[index], self._arrow_m).get_xy())

    # ----------------------------------------------------------------------------- the robot's view

    def _make_view(self) -> None:
        episode = self.episode
        reach = episode.max_range
        axes = self._axes(VIEW_BOX)
        axes.set(xlim=(-1.04 * reach, 1.04 * reach), ylim=(-1.04 * reach, 1.04 * reach))
        axes.set_axis_off()
        axes.add_patch(Circle((0, 0), reach, fc=FREE, ec="0.6", lw=1.0))
        self._heading(VIEW_BOX, f"the robot's view, {reach:g} m, forward is up")
        fill = axes.fill([], [], fc=(*to_rgb(SCAN), 0.35), ec="none")[0]
        self._own_scan = self._add(axes, fill)
        hits = axes.plot([], [], "o", ms=3, mfc=OBSTACLE, mec="none")[0]
        self._hits = self._add(axes, hits)
        star = axes.plot([], [], "*", ms=13, mfc=YELLOW, mec=INK, mew=1.0)[0]
        robot = arrowhead((0.0, 0.0, math.pi / 2), 0.15 * reach)
        robot.set(fc=ROBOT, ec=INK, lw=1.0)
        axes.add_patch(robot)
        self._add(axes, robot)
        self._own_goal = self._add(axes, star)
        self._goal_headings = self.episode.goal_headings()

    def _update_view(self, index: int) -> None:
        episode = self.episode
        angles, ranges = episode.beam_angles(), episode.ranges[index]
        ends = np.stack([-ranges * np.sin(angles), ranges * np.cos(angles)], axis=-1)
        self._own_scan.set_xy(np.concatenate([ends, np.zeros((1, 2))]))
        self._hits.set_data(*ends[ranges < 0.999 * episode.max_range].T)
        distance = math.dist(episode.poses[index, :2], episode.goal)
        shown, heading = min(distance, episode.max_range), float(self._goal_headings[index])
        self._own_goal.set_data([-shown * math.sin(heading)], [shown * math.cos(heading)])

    # ----------------------------------------------------------------------------- skills, rewards

    def _make_skills(self) -> None:
        skills = self.episode.skill_weights.shape[1]
        self._bars: list[Rectangle] = []
        self._weights: list[Any] = []
        if skills == 1:
            return
        axes = self._axes(SKILL_BOX)
        axes.set(xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[])
        for skill in range(skills):
            bar = Rectangle((0, 0), 0, 1, fc=skill_color(skill), ec="white", lw=0.5)
            axes.add_patch(bar)
            self._bars.append(self._add(axes, bar))
            position = ((skill + 0.5) / skills, 1.25)
            text = axes.text(*position, "", ha="center", va="bottom", fontsize=9, weight="bold")
            text.set_color(skill_color(skill))
            self._weights.append(self._add(axes, text))

    def _update_skills(self, index: int) -> None:
        if not self._bars:
            return
        weights = self.episode.skill_weights[min(index, self.episode.num_steps - 1)]
        ends = np.cumsum(weights)
        name = "skill " if len(weights) <= 3 else ""
        for skill, (bar, text) in enumerate(zip(self._bars, self._weights, strict=True)):
            bar.set(x=float(ends[skill] - weights[skill]), width=float(weights[skill]))
            value = f": {weights[skill]:.2f}" if len(weights) <= 5 else ""
            text.set_text(f"{name}{skill + 1}{value}")

    def _make_rewards(self) -> None:
        episode = self.episode
        last = last_step(episode)
        self._sums = reward_sums(episode)[: last + 1]
        self._times = np.arange(last + 1) * episode.time_step
        axes = self._axes(REWARD_BOX)
        tidy(axes)
        low, high = float(self._sums.min()), float(self._sums.max())
        margin = 0.05 * max(high - low, 1e-6)
        axes.set(xlim=(0, self._times[-1]), ylim=(low - margin, high + margin))
        axes.set_xlabel("time, s", fontsize=8.5, labelpad=1)
        axes.tick_params(labelsize=8, length=2, pad=2)
        axes.locator_params(nbins=5)
        lines = []
        for name, color, style in REWARD_TERMS[: self._sums.shape[1]]:
            line = axes.plot([], [], color=color, ls=style, lw=1.8, label=name)[0]
            lines.append(self._add(axes, line))
        self._reward_lines = lines
        self._heading(SKILL_BOX, "reward so far, weighted", above=-48)
        options: dict[str, Any] = {"frameon": False, "fontsize": 8, "handlelength": 1.8, "ncols": 3}
        options |= {"columnspacing": 1.0, "handletextpad": 0.4, "borderaxespad": 0, "borderpad": 0}
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.03), **options)

    def _update_rewards(self, index: int) -> None:
        for part, line in enumerate(self._reward_lines):
            line.set_data(self._times[: index + 1], self._sums[: index + 1, part])

    # -------------------------------------------------------------------------------------- status

    def _make_status(self) -> None:
        episode = self.episode
        y = 1 - 22 / HEIGHT
        options: dict[str, Any] = {"va": "center", "parse_math": False}
        status = self.figure.text(1 - 12 / WIDTH, y, "", ha="right", fontsize=10, **options)
        self._status = self._add(None, status)
        name = self.figure.text(12 / WIDTH, y, "", weight="bold", fontsize=11, **options)
        self._update_status(last_step(episode))  # The longest status.
        renderer = self._canvas.get_renderer()
        width_left = (WIDTH - 40) * self._scale - status.get_window_extent(renderer).width
        for omitted in range(len(episode.agent)):
            agent = episode.agent[: len(episode.agent) - omitted]
            ellipsis = "\N{HORIZONTAL ELLIPSIS}" if omitted else ""
            name.set_text(f"{agent}{ellipsis}, {episode.occupancy_map.name}")
            if name.get_window_extent(renderer).width <= width_left:
                break

    def _update_status(self, index: int) -> None:
        episode = self.episode
        distance = math.dist(episode.poses[index, :2], episode.goal)
        parts = [f"step {index} of {episode.num_steps}", f"{index * episode.time_step:.1f} s"]
        parts.append(f"{distance:.1f} m to the goal")
        color = INK
        if episode.success and index >= episode.time_steps:
            parts.append(f"reached at step {episode.time_steps}")
            color = REACHED
        elif index == episode.num_steps:
            parts.append("not reached")
            color = RED
        self._status.set(text="   ".join(parts), color=color)

    # ------------------------------------------------------------------------------------- helpers

    def _axes(self, box: tuple[int, int, int, int], *, scaled: bool = True) -> Axes:
        """Axes in a box of pixels of this frame or, if `scaled`, of the frame WIDTH x HEIGHT."""
        height, width = self._size
        if scaled:
            height, width = HEIGHT, WIDTH
        left, top, columns, rows = box
        position = (left / width, 1 - (top + rows) / height, columns / width, rows / height)
        return self.figure.add_axes(position)

    def _heading(self, box: tuple[int, int, int, int], text: str, *, above: int = 6) -> None:
        position = (box[0] / WIDTH, 1 - (box[1] - above) / HEIGHT)
        self.figure.text(*position, text, fontsize=9, va="bottom")

    def _add(self, axes: Axes | None, artist: Any) -> Any:
        """Register an artist to be redrawn in every frame, above those registered before."""
        self._moving.append((axes, artist))
        return artist
