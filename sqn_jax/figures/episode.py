"""Pictures of what the paper's reward pays for: the area that was seen, and a goal in sight."""

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


# ---------------------------------------------------------------------------------------- coverage


def coverage_example(
    episode: Episode, *, steps: Sequence[int] | None = None, title: str = "Map coverage"
) -> Figure:
    """Draw how the map is uncovered (paper, map coverage): the map at a few steps, the area below.

    Each panel has the way driven so far, the area seen so far tinted, the current scan as a
    polygon, the robot with its heading, and the goal. The curve is the seen area in m2 over time,
    with a dot for each panel.

    Args:
        episode: what is drawn.
        steps: moments in 0..T, at most 8; default: the start, a third, two thirds and the end of
            what was driven until the goal.
        title: stands above all panels.

    Raises:
        ValueError: no step, too many, or one outside the episode.
    """
    if steps is None:
        steps = [round(episode.time_steps * share / 3) for share in range(4)]
    shown = list(dict.fromkeys(steps))
    if not 1 <= len(shown) <= MAX_STEPS_SHOWN:
        raise ValueError(f"steps has {len(shown)} entries, expected 1 to {MAX_STEPS_SHOWN}")
    for step in shown:
        if not 0 <= step <= episode.num_steps:
            raise ValueError(f"steps has {step}, expected 0 to {episode.num_steps}")
    width, height = episode.occupancy_map.size_m
    columns = min(len(shown), 4)
    lines = math.ceil(len(shown) / columns)
    panel_height = (WIDTH_IN - 0.9) / columns * height / width + 0.35
    size = (WIDTH_IN, lines * min(panel_height, 6.0) + 2.9)
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[size[1] - 2.1, 2.1])
    above, below = parts
    areas = seen_areas(episode)
    grid = above.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for number, step in enumerate(shown):
        axes = grid.flat[number]
        _draw_coverage(axes, episode, step)
        axes.set_title(f"{step * episode.time_step:.1f} s: {areas[step]:.0f} m² seen", fontsize=10)
        _label_map(axes, left=number % columns == 0, lowest=number + columns >= len(shown))
    _draw_areas(below.subplots(), episode, areas, shown)
    above.legend(
        handles=[
            *_mark_handles(),
            Line2D([], [], color=COLORS[0], lw=2, label="way so far"),
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
    """[T + 1] m2 seen before each step and after the last, counted from the covered points."""
    counts = np.bitwise_count(episode.trajectory.covered).sum(axis=(1, 2, 3), dtype=np.int64)
    return counts * episode.lattice.cell**2


def _draw_coverage(axes: Axes, episode: Episode, step: int) -> None:
    """The map as the robot knew it before a step, with its way up to there."""
    draw_seen(axes, episode, step)
    draw_scan(axes, episode, step)
    axes.plot(*episode.poses[: step + 1, :2].T, color=COLORS[0], lw=2, zorder=4)
    if step:
        draw_start(axes, episode)
    draw_goal(axes, episode)
    draw_robot(axes, episode, step, size=0.055 * max(episode.occupancy_map.size_m))


def _draw_areas(axes: Axes, episode: Episode, areas: Floats, shown: Sequence[int]) -> None:
    """The seen area [T + 1] over time up to the arrival, or up to the last moment shown."""
    end = max(episode.time_steps, *shown)
    times = np.arange(end + 1) * episode.time_step
    axes.plot(times, areas[: end + 1], color=COLORS[2], lw=2)
    axes.plot(times[list(shown)], areas[list(shown)], "o", ms=6, mfc="white", mec=INK, mew=1.3)
    if episode.success:
        mark_arrival(axes, episode)
    axes.set(xlabel="time, s", ylabel="seen area, m²", ylim=(0, None))
    axes.margins(x=0.02)
    tidy(axes)


def _label_map(axes: Axes, *, left: bool, lowest: bool) -> None:
    axes.locator_params(nbins=6, steps=[1, 2, 5, 10])
    axes.tick_params(labelsize=8, labelbottom=lowest)
    axes.set(xlabel="x, m" if lowest else "", ylabel="y, m" if left else "")


def _mark_handles() -> list[Line2D]:
    """What the marks on a map mean."""
    marks = [(">", 9, INK, "white", "robot"), ("o", 6, "white", INK, "start")]
    marks.append(("*", 11, YELLOW, INK, "goal"))
    return [
        Line2D([], [], ls="", marker=marker, ms=size, mfc=face, mec=edge, label=label)
        for marker, size, face, edge, label in marks
    ]


# ------------------------------------------------------------------------------------ reachability


_AROUND_THE_GOAL = math.radians(12)  # to each side; two beams or three


class Moment(NamedTuple):
    """A moment of an episode at which its goal is near."""

    episode: Episode
    step: int
    """The step it is before; 1..T."""
    distance: float
    """To the goal in a straight line, m."""
    reachable: bool
    clear: bool
    """Whether the beams to both sides of the goal's direction say the same."""


def reachability_example(
    episodes: Episode | Sequence[Episode], *, title: str = "Is the goal reachable? (eq. 8)"
) -> Figure:
    """Draw what the navigation reward pays for: a goal that is near but hidden, and one in sight.

    Left stands the moment at which a hidden goal was nearest in a straight line, right the one with
    the goal in sight at the most similar distance; both from before the arrival. Goals farther than
    the sensor reaches, or outside the field of view, do not count as hidden. Moments at which the
    beams around the goal's direction disagree, as at the corner of a wall, are taken only if there
    are no others.

    Args:
        episodes: one or several, of one map or several; where the moments are looked for.
        title: stands above both panels.

    Raises:
        ValueError: there is no episode, or no moment of one of the two kinds.
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
        word = "reachable" if moment.reachable else "hidden, not reachable"
        axes.set_title(f"goal {moment.distance:.1f} m away, {word}", fontsize=11)
        axes.set(xlabel="x, m", ylabel="y, m" if axes is panels[0] else "")
    marks = [handle for handle in _mark_handles() if handle.get_label() != "start"]
    figure.legend(
        handles=[
            *marks,
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
        ValueError: there is no episode, or no moment of one of the two kinds.
    """
    if not episodes:
        raise ValueError("no episodes, expected at least one")
    moments = [moment for episode in episodes for moment in _moments(episode)]
    hidden = [moment for moment in moments if not moment.reachable]
    reachable = [moment for moment in moments if moment.reachable]
    for word, found in (("near but hidden", hidden), ("reachable", reachable)):
        if not found:
            count = f"{len(episodes)} episode{'s' if len(episodes) > 1 else ''}"
            raise ValueError(f"{count}: the goal is never {word}, expected at least one such step")
    nearest = min(_clear_ones(hidden), key=lambda moment: moment.distance)

    def difference(moment: Moment) -> float:
        return abs(moment.distance - nearest.distance)

    return nearest, min(_clear_ones(reachable), key=difference)


def _clear_ones(moments: list[Moment]) -> list[Moment]:
    """Those that are clear, or all if none is."""
    return [moment for moment in moments if moment.clear] or moments


def _moments(episode: Episode) -> list[Moment]:
    """The moments before the arrival with the goal within the sensor's reach and field of view."""
    end = episode.time_steps
    direction = episode.goal_headings()[1 : end + 1]
    distances = episode.goal_distances[:end]
    in_view = np.abs(direction) <= episode.field_of_view / 2
    moments = []
    for step in np.flatnonzero(in_view & (distances < episode.max_range)):
        distance, reachable = float(distances[step]), bool(episode.reachable[step])
        around = np.abs(episode.beam_angles() - direction[step]) < _AROUND_THE_GOAL
        farther = episode.ranges[step + 1, around] > distance
        clear = bool(farther.all() if reachable else not farther.any())
        moments.append(Moment(episode, int(step) + 1, distance, reachable, clear))
    return moments


def _show_around(axes: Axes, episode: Episode, index: int) -> None:
    """Cut a square out of the map that holds the whole scan; not beyond the map's edges."""
    reach = episode.max_range + 0.5
    sizes = episode.occupancy_map.size_m
    center = [float(value) for value in episode.poses[index, :2]]
    low = [
        min(max(place - reach, 0.0), max(size - 2 * reach, 0.0))
        for place, size in zip(center, sizes, strict=True)
    ]
    axes.set_xlim(low[0], min(low[0] + 2 * reach, sizes[0]))
    axes.set_ylim(low[1], min(low[1] + 2 * reach, sizes[1]))
