"""How one run went: its learning curve, and the paths its robot took."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from sqn_jax.maps import OccupancyMap, goal_distance, traversable

Floats = NDArray[np.float64]
Rows = Sequence[Mapping[str, Any]]

DPI = 160
WIDTH_IN = 9.0
MAX_PATHS = 8  # in one panel; more would hide each other

# Okabe and Ito's colours, told apart under every common colour blindness; no yellow on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_OBSTACLE, _UNREACHABLE, _INK, _RED, _YELLOW = "#333a42", "#b9b9b9", "#222222", "#b00020", "#ffd92f"
_GROUND_MAP = ListedColormap([_UNREACHABLE, _OBSTACLE])
# Few and light shades, so that their steps read as height lines and paths stand out.
_FIELD_MAP = ListedColormap(np.linspace([0.985, 0.99, 0.975], [0.70, 0.80, 0.82], 12))
# Dark blue over violet to orange: brightness rises all along, so that it survives greyscale.
_WEIGHT_MAP = ListedColormap(colormaps["plasma"](np.linspace(0.0, 0.8, 256)))


def _metric(rows: Rows, name: str) -> Floats:
    """A metric as [R, S] (rows, seeds); NaN for None and where a row lacks it."""
    values = [np.asarray(row.get(name, np.nan), dtype=np.float64) for row in rows]
    shapes = sorted({value.shape for value in values})
    if len(shapes) > 1:
        raise ValueError(f"{name} has the shapes {shapes} in some rows, expected one in all")
    return np.stack(values).reshape(len(rows), -1)


def _draw_curve(
    axes: Axes, episodes: Floats, values: Floats, colour: str, label: str = "", style: str = "-"
) -> None:
    """Draw [R, S]: the mean bold and, if there are several, each seed thin behind it."""
    # One point makes no line.
    marker = "o" if len(episodes) == 1 else ""
    look: dict[str, Any] = {"color": colour, "linestyle": style, "marker": marker}
    if values.shape[1] > 1:
        axes.plot(episodes, values, ms=3, lw=0.8, alpha=0.4, **look)
    # Masked, since nanmean warns of rows without any number.
    mean = np.ma.masked_invalid(values).mean(axis=1).filled(np.nan)
    axes.plot(episodes, mean, ms=5, lw=2.0, label=label, **look)


def learning_curve(rows: Rows, *, title: str) -> Figure:
    """Draw how a run learned: reward, success, loss and use of the skills over its episodes.

    Args:
        rows: the objects of a run's `metrics.jsonl`, one a chunk. `episodes` (cumulative) is
            needed; `mean_reward`, `success`, `loss`, `epsilon`, `gate_entropy` (nat) and
            `wall_seconds` are drawn where present. Each is a number or a list with one a training
            seed: then every seed is a thin line and their mean a bold one. `skill_usage` is [K],
            or [seeds, K]. NaN and None leave a gap.
        title: stands above all panels.

    Returns:
        Three panels, or four if there is more than one skill.

    Raises:
        ValueError: no rows, rows without `episodes`, or a metric whose shape changes.
    """
    if not rows or any("episodes" not in row for row in rows):
        raise ValueError(f"{len(rows)} rows of metrics, expected at least one, all with episodes")
    episodes = _metric(rows, "episodes").max(axis=1)
    skills = np.shape(rows[0].get("skill_usage", [1.0]))[-1]
    figure = Figure(figsize=(WIDTH_IN, 6.4 if skills > 1 else 3.7), dpi=DPI, layout="constrained")
    lines, columns = (2, 2) if skills > 1 else (1, 3)
    panels = list(figure.subplots(lines, columns, sharex=True).flat)
    panels[0].set_title("mean reward a step", fontsize=11)
    _draw_curve(panels[0], episodes, _metric(rows, "mean_reward"), COLOURS[0])
    _draw_success(panels[1], episodes, _metric(rows, "success"), _metric(rows, "epsilon"))
    _draw_loss(panels[2], episodes, _metric(rows, "loss"))
    if skills > 1:
        usage = _metric(rows, "skill_usage").reshape(len(rows), -1, skills)
        _draw_skills(panels[3], episodes, usage, _metric(rows, "gate_entropy"))
    wall_seconds = _metric(rows, "wall_seconds").max(axis=1)
    for number, axes in enumerate(panels):
        axes.grid(color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(0, 1.02 * max(1.0, episodes.max()))
        axes.locator_params(axis="x", nbins=5, steps=[1, 2, 5, 10])
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if number < columns:
            _add_minutes(axes, episodes, wall_seconds)
        if number >= len(panels) - columns:
            axes.set_xlabel("training episodes")
    seeds = _metric(rows, "mean_reward").shape[1]
    suffix = f" (thin: {seeds} seeds, bold: their mean)" if seeds > 1 else ""
    figure.suptitle(title + suffix, fontsize=13)
    return figure


def _draw_success(axes: Axes, episodes: Floats, success: Floats, epsilon: Floats) -> None:
    """Success, with the share of random actions that it suffers from."""
    axes.set_title("success under exploration noise", fontsize=11)
    _draw_curve(axes, episodes, success, COLOURS[2], "success")
    if np.isfinite(epsilon).any():
        _draw_curve(axes, episodes, epsilon[:, :1], "0.45", "random actions", "--")
    _finish_shares(axes)


def _draw_loss(axes: Axes, episodes: Floats, loss: Floats) -> None:
    axes.set_title("loss", fontsize=11)
    _draw_curve(axes, episodes, loss, COLOURS[1])
    if not np.isfinite(loss).any():
        axes.text(0.5, 0.5, "no update yet", transform=axes.transAxes, ha="center", color="0.4")
        axes.set_yticks([])
    elif (loss[np.isfinite(loss)] > 0).all():
        axes.set_yscale("log")


def _draw_skills(axes: Axes, episodes: Floats, usage: Floats, entropy: Floats) -> None:
    """Mean weight of each skill [R, S, K], and the entropy [R, S] as a share of its maximum."""
    axes.set_title("weight of the skills", fontsize=11)
    skills = usage.shape[2]
    for skill in range(skills):
        colour = COLOURS[skill % len(COLOURS)]
        _draw_curve(axes, episodes, usage[..., skill], colour, f"skill {skill + 1}")
    if np.isfinite(entropy).any():
        share = entropy / math.log(skills)
        _draw_curve(axes, episodes, share, _INK, f"gate entropy / log {skills}", ":")
    _finish_shares(axes)


def _finish_shares(axes: Axes) -> None:
    """A scale from 0 to 1, with room above it for the legend."""
    entries = len(axes.get_legend_handles_labels()[0])
    axes.set_ylim(-0.02, 1.06 + 0.13 * math.ceil(entries / 3))
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.legend(fontsize=9, loc="upper center", ncols=3, columnspacing=1.2, frameon=False)


def _add_minutes(axes: Axes, episodes: Floats, wall_seconds: Floats) -> None:
    """A second scale at the top: minutes of wall-clock time, where the rows know it."""
    known = np.isfinite(wall_seconds)
    if not known.any():
        return
    # A resumed run may start its clock anew; a scale must not turn back.
    minutes = np.maximum.accumulate(wall_seconds[known]) / 60
    ticks: Any = MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(minutes[0], minutes[-1])
    ticks = ticks[(ticks >= minutes[0]) & (ticks <= minutes[-1])]
    if ticks.size < 2:
        ticks = minutes[-1:]
    places = np.interp(ticks, minutes, episodes[known])
    top = axes.secondary_xaxis("top")
    top.set_xticks(places, [f"{tick:.3g}" for tick in ticks], fontsize=9)
    top.tick_params(color="0.5", labelcolor="0.35")
    top.set_xlabel("minutes", fontsize=9, color="0.35")


class _Panel(NamedTuple):
    """A goal (x, y) m and the indices of the episodes that had it; `reached` from the quickest."""

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

    A path ends where it first enters the goal radius; without success it is drawn whole and ends in
    a cross. Its colour is the weight of the first skill in each step. A panel draws at most
    `MAX_PATHS` paths, failures first (they get half of the places, more if there are not enough
    successes), successes evenly from the quickest to the slowest. The title counts all episodes;
    its steps are the mean over those that reached the goal.

    With more goals than panels, half of the panels go to the goals with most failures, the rest to
    those with most episodes; where goals are equal in that, the one farthest from those chosen.

    Args:
        occupancy_map: the map the episodes ran on.
        goals: [E, 2] x, y in the grid frame, m; equal within 1e-6 m means the same goal.
        poses: [T + 1, E, 3] x m, y m, heading rad; the first is the start.
        skill_weights: [T, E, K] the skill decision of each step, 0..1; K = 1 gives one colour.
        success: [E] bool, the goal was reached.
        time_steps: [E] int, the step of the first entry, counted from 1; not read for failures.
        goal_radius: m.
        title: stands above all panels.
        max_panels: goals shown at most, >= 1.
        robot_radius: m; where the robot does not fit, there is no distance to the goal.

    Raises:
        ValueError: shapes that do not belong together, no episode, or a goal in no free cell.
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
    figure, grid = _panel_grid(occupancy_map, len(panels))
    norm = Normalize(0.0, float(fields[np.isfinite(fields)].max()))
    for axes, panel, field in zip(grid, panels, fields, strict=True):
        image = _draw_field(axes, occupancy_map, field, norm)
        for episode in _chosen_episodes(panel):
            end = int(steps[episode]) if success[episode] else length
            colours = weights[:end, episode, 0] if skills > 1 else None
            _draw_path(axes, poses[: end + 1, episode], colours, reached=bool(success[episode]))
        _draw_goal(axes, panel, steps, goal_radius)
    figure.colorbar(image, ax=grid, label="distance to the goal, m", aspect=35, pad=0.02)
    if skills > 1:
        lines = next(child for child in grid[0].collections if isinstance(child, LineCollection))
        figure.colorbar(lines, ax=grid, label="weight of skill 1", aspect=35, pad=0.02)
    _add_legend(figure, goal_radius, any_failure=any(panel.failed.size for panel in panels))
    shown = f"{success.sum()} of {count} reached"
    if len(panels) < len(all_panels):
        shown += f", {len(panels)} of {len(all_panels)} goals shown"
    if max(panel.total for panel in panels) > MAX_PATHS:
        shown += f", at most {MAX_PATHS} paths a goal drawn"
    figure.suptitle(f"{title}\n{shown}", fontsize=12)
    # The layout of panels with a fixed aspect settles in the second pass; a drawing makes one.
    figure.draw_without_rendering()
    return figure


def _check_shapes(weights: Floats, **arrays: NDArray[Any]) -> None:
    """Refuse arrays that do not describe the same E episodes of T steps as `weights` [T, E, K]."""
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
    left = np.arange(len(goals))
    while left.size:
        same = np.abs(goals[left] - goals[left[0]]).max(axis=1) <= 1e-6
        members, (x, y) = left[same], goals[left[0]]
        reached = members[success[members]]
        by_steps = np.argsort(steps[reached], kind="stable")
        panels.append(_Panel((x, y), members[~success[members]], reached[by_steps], members.size))
        left = left[~same]
    return panels


def _chosen_panels(panels: list[_Panel], limit: int) -> list[_Panel]:
    """At most `limit` panels, by the rule that `trajectories` states."""
    chosen: list[_Panel] = []

    def rank(panel: _Panel) -> tuple[int, int, float]:
        apart = min((math.dist(panel.goal, other.goal) for other in chosen), default=0.0)
        failures = panel.failed.size if 2 * len(chosen) < limit else 0
        return failures, panel.total, apart

    left = list(panels)
    while left and len(chosen) < limit < len(panels):
        chosen.append(left.pop(max(range(len(left)), key=lambda i: rank(left[i]))))
    return chosen or panels


def _chosen_episodes(panel: _Panel) -> NDArray[np.intp]:
    """The episodes drawn, failures first, by the rule that `trajectories` states."""
    failed = _evenly(panel.failed, max(MAX_PATHS // 2, MAX_PATHS - panel.reached.size))
    return np.concatenate([failed, _evenly(panel.reached, MAX_PATHS - failed.size)])


def _evenly(items: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """At most `count` items, evenly from the first to the last."""
    return items[np.linspace(0, items.size - 1, min(count, items.size)).round().astype(int)]


def _panel_grid(occupancy_map: OccupancyMap, count: int) -> tuple[Figure, list[Axes]]:
    """A figure with one panel a goal, its height fitted to the shape of the map."""
    columns = min(count, 2)  # three would squeeze the titles into each other
    lines = math.ceil(count / columns)
    width, height = occupancy_map.size_m
    panel_width = (WIDTH_IN - 2.2) / columns
    height_in = lines * (panel_width * height / width + 0.35) + 1.2
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="compressed")
    grid = list(figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).flat)
    for axes in grid[count:]:
        axes.remove()
    for number, axes in enumerate(grid[:count]):
        lowest, leftmost = number + columns >= count, number % columns == 0
        axes.set(aspect="equal", xlim=(0, width), ylim=(0, height))
        axes.set(xlabel="x, m" if lowest else "", ylabel="y, m" if leftmost else "")
        axes.locator_params(nbins=9, steps=[1, 2, 5, 10])
        axes.tick_params(labelsize=9, labelbottom=lowest)
    return figure, grid[:count]


def _draw_field(
    axes: Axes, occupancy_map: OccupancyMap, field: NDArray[np.float32], norm: Normalize
) -> AxesImage:
    """Obstacles dark, places without a path to the goal grey, all others by their distance."""
    width, height = occupancy_map.size_m
    look: dict[str, Any] = {"origin": "lower", "extent": (0.0, width, 0.0, height)}
    axes.imshow(occupancy_map.occupied, cmap=_GROUND_MAP, vmin=0, vmax=1, **look)
    return axes.imshow(np.ma.masked_invalid(field), cmap=_FIELD_MAP, norm=norm, **look)


def _draw_path(axes: Axes, poses: Floats, weights: Floats | None, *, reached: bool) -> None:
    """One path [S + 1, 3] coloured by the weights [S] of its steps, with its start and its end."""
    points = poses[:, :2]
    segments = list(np.stack([points[:-1], points[1:]], axis=1))
    width, order = (2.0, 3) if reached else (1.4, 2)
    lines = LineCollection(segments, linewidths=width, capstyle="round", zorder=order)
    if weights is None:
        lines.set_color(COLOURS[0])
    else:
        lines.set(array=weights, cmap=_WEIGHT_MAP, norm=Normalize(0.0, 1.0))
    axes.add_collection(lines, autolim=False)
    axes.plot(*points[0], "o", ms=6, mfc="white", mec=_INK, mew=1.3, zorder=5)
    if not reached:
        cross = axes.plot(*points[-1], "x", ms=9, mec=_RED, mew=2.5, zorder=6)[0]
        cross.set_path_effects([patheffects.withStroke(linewidth=4.5, foreground="white")])


def _draw_goal(axes: Axes, panel: _Panel, steps: NDArray[Any], goal_radius: float) -> None:
    """The goal, and above the panel how many reached it, in how many steps on average."""
    axes.add_patch(Circle(panel.goal, goal_radius, fill=False, ec=_INK, lw=1.2, zorder=4))
    axes.plot(*panel.goal, "*", ms=11, mfc=_YELLOW, mec=_INK, mew=1.0, zorder=7)
    mean = f", {steps[panel.reached].mean():.0f} steps" if panel.reached.size else ""
    where = f"goal ({panel.goal[0]:.1f}, {panel.goal[1]:.1f}) m"
    axes.set_title(f"{where}: {panel.reached.size} of {panel.total} reached{mean}", fontsize=10)


def _add_legend(figure: Figure, goal_radius: float, *, any_failure: bool) -> None:
    """What the marks mean, below the panels."""
    marks = [("start", "o", 6, "white", _INK), ("goal", "*", 11, _YELLOW, _INK)]
    marks.append((f"goal radius {goal_radius:g} m", "o", 10, "none", _INK))
    if any_failure:
        marks.append(("not reached", "x", 9, "none", _RED))
    handles: list[Line2D | Patch] = [
        Line2D([], [], ls="", marker=marker, ms=size, mfc=face, mec=edge, mew=1.3, label=label)
        for label, marker, size, face, edge in marks
    ]
    handles += [Patch(fc=_OBSTACLE, label="obstacle"), Patch(fc=_UNREACHABLE, label="unreachable")]
    look: dict[str, Any] = {"ncols": len(handles), "frameon": False, "columnspacing": 1.4}
    figure.legend(handles=handles, loc="outside lower center", fontsize=9, **look)


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, all or nothing; missing folders are made.

    Raises:
        ValueError: the name does not end in .png, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path}: the name ends in {path.suffix!r}, expected .png")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without the software's version, the same figure gives the same file.
        figure.savefig(partial, format="png", dpi=DPI, metadata={"Software": None})
        partial.replace(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
