"""Pictures of the terms of the reward: the area that was seen, and whether the goal is in sight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures.ground import (
    SEEN,
    YELLOW,
    draw_goal,
    draw_map,
    draw_robot,
    draw_scan,
    draw_seen,
    draw_start,
    mark_arrival,
)
from sqn_jax.figures.style import COLORS, DPI, INK, WIDTH_IN, plain, tidy

Floats = NDArray[np.floating]

MAX_STEPS_SHOWN = 8

REWARD_TERMS = (
    ("navigation", COLORS[2], "-"),
    ("exploration", COLORS[5], "--"),
    ("time", "#777777", "-."),
    ("collision", COLORS[1], ":"),
)
"""Name, color and line style of each column of `Episode.reward_parts`."""


def reward_sums(episode: Episode) -> Floats:
    """Cumulative sums [T + 1, K] of the first K `REWARD_TERMS`, from 0 on.

    All four, or three where a collision costs nothing.
    """
    shown = 4 if episode.env_params.reward_weights[3] != 0 else 3
    parts = episode.reward_parts[:, :shown]
    return np.cumsum(np.concatenate([np.zeros((1, shown)), parts]), axis=0)


# ---------------------------------------------------------------------------------------- coverage


def coverage_example(
    episode: Episode, *, steps: Sequence[int] | None = None, title: str = "Map coverage"
) -> Figure:
    """Draw map coverage (paper, map coverage): the map at a few steps, and the seen area over time.

    Each panel has the path so far, the area seen so far (tinted), the current scan as a polygon,
    the robot with its heading, and the goal. The curve is the seen area, m², over time, with a dot
    for each panel.

    Args:
        episode: the episode.
        steps: steps in 0..T, at most 8; default: the start, a third, two thirds and the end of the
            path to the goal.
        title: above all panels.

    Raises:
        ValueError: no steps, too many, or one outside the episode.
    """
    if steps is None:
        steps = [round(episode.time_steps * thirds / 3) for thirds in range(4)]
    shown = list(dict.fromkeys(steps))
    if not 1 <= len(shown) <= MAX_STEPS_SHOWN:
        raise ValueError(f"steps has {len(shown)} entries, expected 1 to {MAX_STEPS_SHOWN}")
    for step in shown:
        if not 0 <= step <= episode.num_steps:
            raise ValueError(f"steps has {step}, expected 0 to {episode.num_steps}")
    width, height = episode.occupancy_map.size_m
    columns = min(len(shown), 4)
    rows = math.ceil(len(shown) / columns)
    panel_height = (WIDTH_IN - 0.9) / columns * height / width + 0.35
    size = (WIDTH_IN, rows * min(panel_height, 6.0) + 2.9)
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[size[1] - 2.1, 2.1])
    above, below = parts
    areas = seen_areas(episode)
    grid = above.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for number, step in enumerate(shown):
        axes = grid.flat[number]
        _draw_coverage(axes, episode, step)
        axes.set_title(f"{step * episode.time_step:.1f} s: {areas[step]:.0f} m² seen", fontsize=10)
        _label_map(axes, is_left=number % columns == 0, is_lowest=number + columns >= len(shown))
    _draw_areas(below.subplots(), episode, areas, shown)
    above.legend(
        handles=[
            *_marker_handles(),
            Line2D([], [], color=COLORS[0], lw=2, label="path so far"),
            Patch(fc=SEEN, label="seen so far"),
            Patch(fc=COLORS[4], alpha=0.5, label="scan now"),
        ],
        **_LEGEND_BELOW,
    )
    figure.suptitle(plain(title))
    return figure


_LEGEND_BELOW: dict[str, Any] = {
    **{"loc": "outside lower center", "ncols": 7, "frameon": False},
    **{"fontsize": 9, "columnspacing": 1.4},
}


def seen_areas(episode: Episode) -> Floats:
    """[T + 1] m², area seen before each step and after the last, from the covered points."""
    counts = np.bitwise_count(episode.trajectory.covered).sum(axis=(1, 2, 3), dtype=np.int64)
    return counts * episode.lattice.cell**2


def _draw_coverage(axes: Axes, episode: Episode, step: int) -> None:
    """Draw the map as the robot has seen it before a step, with its path so far."""
    draw_seen(axes, episode, step)
    draw_scan(axes, episode, step)
    axes.plot(*episode.poses[: step + 1, :2].T, color=COLORS[0], lw=2, zorder=4)
    if step:
        draw_start(axes, episode)
    draw_goal(axes, episode)
    draw_robot(axes, episode, step, size=0.055 * max(episode.occupancy_map.size_m))


def _draw_areas(axes: Axes, episode: Episode, areas: Floats, shown: Sequence[int]) -> None:
    """Draw the seen area [T + 1], m², over time up to the arrival, or to the last step shown."""
    end = max(episode.time_steps, *shown)
    times = np.arange(end + 1) * episode.time_step
    axes.plot(times, areas[: end + 1], color=COLORS[2], lw=2)
    axes.plot(times[list(shown)], areas[list(shown)], "o", ms=6, mfc="white", mec=INK, mew=1.3)
    if episode.success:
        mark_arrival(axes, episode)
    axes.set(xlabel="time, s", ylabel="seen area, m²", ylim=(0, None))
    axes.margins(x=0.02)
    tidy(axes)


def _label_map(axes: Axes, *, is_left: bool, is_lowest: bool) -> None:
    axes.locator_params(nbins=6, steps=[1, 2, 5, 10])
    axes.tick_params(labelsize=8, labelbottom=is_lowest)
    axes.set(xlabel="x, m" if is_lowest else "", ylabel="y, m" if is_left else "")


def _marker_handles() -> list[Line2D]:
    """Legend entries for the markers on a map."""
    markers = [(">", 9, INK, "white", "robot"), ("o", 6, "white", INK, "start")]
    markers.append(("*", 11, YELLOW, INK, "goal"))
    return [
        Line2D([], [], ls="", marker=marker, ms=size, mfc=face, mec=edge, label=label)
        for marker, size, face, edge, label in markers
    ]


# ------------------------------------------------------------------------------------ reachability


_AROUND_THE_GOAL = math.radians(12)  # to each side: two or three beams


class Moment(NamedTuple):
    """A moment of an episode with the goal in range."""

    episode: Episode
    step: int
    """The moment before this step; 1..T."""
    distance: float
    """Straight-line distance to the goal, m."""
    reachable: bool
    is_clear: bool
    """Whether all beams around the direction of the goal agree with `reachable`."""


def reachability_example(
    episodes: Episode | Sequence[Episode], *, title: str = "Is the goal in sight? (eq. 8)"
) -> Figure:
    """Draw when the navigation reward is given: a goal that is near but hidden, and one in sight.

    On the left is the moment at which a hidden goal was nearest in a straight line; on the right,
    the moment with the goal in sight at the most similar distance. Both are before the arrival.
    Goals out of the range or the field of view of the sensor do not count as hidden. Moments at
    which the beams around the direction of the goal disagree, as at the corner of a wall, are used
    only if there are no others.

    Args:
        episodes: one or several, on one map or several, to choose the moments from.
        title: above both panels.

    Raises:
        ValueError: no episodes, or no moment of one of the two kinds.
    """
    hidden, reachable = choose_moments([episodes] if isinstance(episodes, Episode) else episodes)
    figure = Figure(figsize=(WIDTH_IN, 5.3), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, moment in zip(panels, (hidden, reachable), strict=True):
        episode, index = moment.episode, moment.step
        draw_map(axes, episode.occupancy_map)
        draw_scan(axes, episode, index)
        ends = np.stack([episode.poses[index, :2], episode.goal])
        style = "-" if moment.reachable else (0, (4, 3))
        axes.plot(*ends.T, color=COLORS[1], lw=2.2, ls=style, zorder=6)
        draw_goal(axes, episode)
        draw_robot(axes, episode, index, size=0.6)
        _show_around(axes, episode, index)
        status = "in sight" if moment.reachable else "hidden"
        axes.set_title(f"Goal {moment.distance:.1f} m away, {status}", fontsize=11)
        axes.set(xlabel="x, m", ylabel="y, m" if axes is panels[0] else "")
    markers = [handle for handle in _marker_handles() if handle.get_label() != "start"]
    figure.legend(
        handles=[
            *markers,
            Patch(fc=COLORS[4], alpha=0.5, label="scan"),
            Line2D([], [], color=COLORS[1], lw=2.2, label="straight line to the goal, in sight"),
            Line2D([], [], color=COLORS[1], lw=2.2, ls=(0, (4, 3)), label="hidden"),
        ],
        **_LEGEND_BELOW,
    )
    figure.suptitle(plain(title))
    return figure


def choose_moments(episodes: Sequence[Episode]) -> tuple[Moment, Moment]:
    """The hidden and the reachable moment that `reachability_example` draws.

    Raises:
        ValueError: no episodes, or no moment of one of the two kinds.
    """
    if not episodes:
        raise ValueError("no episodes, expected at least one")
    moments = [moment for episode in episodes for moment in _moments(episode)]
    hidden = [moment for moment in moments if not moment.reachable]
    reachable = [moment for moment in moments if moment.reachable]
    for kind, of_kind in (("near but hidden", hidden), ("reachable", reachable)):
        if not of_kind:
            count = f"{len(episodes)} episode{'s' if len(episodes) > 1 else ''}"
            raise ValueError(f"{count}: the goal is never {kind}, expected at least one such step")
    nearest = min(_clear_moments(hidden), key=lambda moment: moment.distance)

    def difference(moment: Moment) -> float:
        return abs(moment.distance - nearest.distance)

    return nearest, min(_clear_moments(reachable), key=difference)


def _clear_moments(moments: list[Moment]) -> list[Moment]:
    """The clear moments, or all if none is clear."""
    return [moment for moment in moments if moment.is_clear] or moments


def _moments(episode: Episode) -> list[Moment]:
    """The moments before the arrival with the goal in the sensor's range and field of view."""
    end = episode.time_steps
    direction = episode.goal_headings()[1 : end + 1]
    distances = episode.goal_distances[:end]
    in_view = np.abs(direction) <= episode.field_of_view / 2
    moments = []
    for step in np.flatnonzero(in_view & (distances < episode.max_range)):
        distance, reachable = float(distances[step]), bool(episode.reachable[step])
        around = np.abs(episode.beam_angles() - direction[step]) < _AROUND_THE_GOAL
        farther = episode.ranges[step + 1, around] > distance
        is_clear = bool(farther.all() if reachable else not farther.any())
        moments.append(Moment(episode, int(step) + 1, distance, reachable, is_clear))
    return moments


def _show_around(axes: Axes, episode: Episode, index: int) -> None:
    """Show the square of the map that contains the whole scan, within the edges of the map."""
    reach = episode.max_range + 0.5
    sizes = episode.occupancy_map.size_m
    center = [float(value) for value in episode.poses[index, :2]]
    low = [
        min(max(middle - reach, 0.0), max(size - 2 * reach, 0.0))
        for middle, size in zip(center, sizes, strict=True)
    ]
    axes.set_xlim(low[0], min(low[0] + 2 * reach, sizes[0]))
    axes.set_ylim(low[1], min(low[1] + 2 * reach, sizes[1]))
