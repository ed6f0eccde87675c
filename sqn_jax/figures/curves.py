"""Curves of training: those of one run, or of several agents together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import (
    EngFormatter,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
)
from numpy.typing import NDArray

from sqn_jax.evaluation.statistics import seed_interval
from sqn_jax.figures.style import COLORS, DPI, INK, WIDTH_IN, plain, tidy
from sqn_jax.storage.metrics import evaluated_rows

Floats = NDArray[np.float64]
Rows = Sequence[Mapping[str, Any]]

_TICK_GAP = 0.12  # of the axis between two labels of minutes
_MULTIPLES = ((10, (1, 2, 3, 5)), (100, (1, 2, 5)))
"""Up to which factor a logarithmic scale has which multiples of powers of ten."""


def _metric(rows: Rows, name: str) -> Floats:
    """A metric as [R, S] (rows, seeds); NaN for None and for rows without it."""
    values = [np.asarray(row.get(name, np.nan), dtype=np.float64) for row in rows]
    shapes = sorted({value.shape for value in values})
    if len(shapes) > 1:
        raise ValueError(f"{name} has the shapes {shapes} in some rows, expected one in all")
    return np.stack(values).reshape(len(rows), -1)


def _draw_curve(
    axes: Axes, episodes: Floats, values: Floats, color: str, label: str = "", style: str = "-"
) -> None:
    """Draw the mean of values [R, S] over seeds as a bold line, and several seeds as thin lines."""
    # A single point would not show as a line.
    marker = "o" if len(episodes) == 1 else ""
    options: dict[str, Any] = {"color": color, "linestyle": style, "marker": marker}
    if values.shape[1] > 1:
        axes.plot(episodes, values, ms=3, lw=0.8, alpha=0.4, **options)
    # Masked, because nanmean warns about rows without any number.
    mean = np.ma.masked_invalid(values).mean(axis=1).filled(np.nan)
    axes.plot(episodes, mean, ms=5, lw=2.0, label=label, **options)


def learning_curve(rows: Rows, *, title: str, paper_reward: float | None = None) -> Figure:
    """Plot reward, success, loss and skill weights of a run over its training episodes.

    Args:
        rows: the rows of a run's `metrics.jsonl`, one per chunk. `episodes` (cumulative) is
            required; `mean_reward`, `success`, `loss`, `epsilon`, `gate_entropy` (nat) and
            `wall_seconds` are drawn if present. Each is a number, or a list of one number per
            training seed: then each seed is a thin line and their mean a bold one. `skill_usage` is
            [K] or [seeds, K]. NaN and None leave a gap. `eval_mean_reward` and `eval_success`, of
            the greedy policy, are drawn over the rows that have them.
        title: above all panels.
        paper_reward: the paper's final mean reward, drawn as a line beside `eval_mean_reward`.

    Returns:
        Three panels, or four if there are several skills.

    Raises:
        ValueError: no rows, rows without `episodes`, or a metric whose shape changes.
    """
    if not rows or any("episodes" not in row for row in rows):
        raise ValueError(f"{len(rows)} rows of metrics, expected at least one, all with episodes")
    episodes = _metric(rows, "episodes").max(axis=1)
    skills = np.shape(rows[0].get("skill_usage") or [1.0])[-1]
    lines, columns = (2, 2) if skills > 1 else (1, 3)
    height = 6.4 if skills > 1 else 3.7
    figure = Figure(figsize=(WIDTH_IN, height), dpi=DPI)
    panels = list(figure.subplots(lines, columns, sharex=True).flat)
    # By hand: a layout engine draws every text once more to measure it.
    figure.subplots_adjust(
        **{"left": 0.075, "right": 0.985, "wspace": 0.17 if columns == 2 else 0.26},
        **{"bottom": 0.55 / height, "top": 1 - 1.08 / height, "hspace": 0.3},
    )
    panels[0].set_title("Mean reward per step", fontsize=11)
    _draw_reward(panels[0], rows, paper_reward)
    _draw_success(panels[1], rows)
    _draw_loss(panels[2], episodes, _metric(rows, "loss"))
    if skills > 1:
        usage = _metric(rows, "skill_usage").reshape(len(rows), -1, skills)
        _draw_skills(panels[3], episodes, usage, _metric(rows, "gate_entropy"))
    wall_seconds = _metric(rows, "wall_seconds").max(axis=1)
    for number, axes in enumerate(panels):
        tidy(axes)
        axes.set_xlim(0, 1.02 * max(1.0, episodes.max()))
        axes.locator_params(axis="x", nbins=5, steps=[1, 2, 5, 10])
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if number < columns:
            _add_minutes(axes, episodes, wall_seconds)
        if number >= len(panels) - columns:
            axes.set_xlabel("training episodes")
    seeds = _metric(rows, "mean_reward").shape[1]
    suffix = f" (thin: {seeds} seeds, bold: their mean)" if seeds > 1 else ""
    figure.suptitle(plain(title + suffix), fontsize=13)
    return figure


def _draw_reward(axes: Axes, rows: Rows, paper_reward: float | None) -> None:
    """Mean reward while exploring, and that of the greedy policy beside the paper's."""
    episodes = _metric(rows, "episodes").max(axis=1)
    _draw_curve(axes, episodes, _metric(rows, "mean_reward"), COLORS[0], "exploring")
    if _draw_evaluation(axes, rows, "eval_mean_reward"):
        if paper_reward is not None:
            axes.axhline(paper_reward, color="0.45", ls=":", lw=1.5, label="the paper's")
        axes.legend(fontsize=9, loc="best", frameon=False)


def _draw_evaluation(axes: Axes, rows: Rows, name: str) -> bool:
    """Draw a metric of the greedy policy at the points of the learning curve, if there are any."""
    points = evaluated_rows(rows)
    if points:
        episodes, values = _metric(points, "episodes").max(axis=1), _metric(points, name)
        _draw_curve(axes, episodes, values, COLORS[3], "evaluation")
    return bool(points)


def _draw_success(axes: Axes, rows: Rows) -> None:
    """Success, and the fraction of random actions (epsilon) under which it was measured."""
    axes.set_title("Success while exploring", fontsize=11)
    episodes, epsilon = _metric(rows, "episodes").max(axis=1), _metric(rows, "epsilon")
    _draw_curve(axes, episodes, _metric(rows, "success"), COLORS[2], "success")
    if np.isfinite(epsilon).any():
        _draw_curve(axes, episodes, epsilon[:, :1], "0.45", "epsilon", "--")
    if _draw_evaluation(axes, rows, "eval_success"):
        axes.set_title("Success while exploring, and in evaluation", fontsize=11)
    _finish_fractions(axes)


def _draw_loss(axes: Axes, episodes: Floats, loss: Floats) -> None:
    axes.set_title("Loss", fontsize=11)
    _draw_curve(axes, episodes, loss, COLORS[1])
    if not np.isfinite(loss).any():
        axes.text(0.5, 0.5, "no update yet", transform=axes.transAxes, ha="center", color="0.4")
        axes.set_yticks([])
    elif (loss[np.isfinite(loss)] > 0).all():
        _scale_by_factors(axes, loss[np.isfinite(loss)])


def _scale_by_factors(axes: Axes, values: Floats) -> None:
    """A logarithmic scale for values > 0, labeled in plain numbers."""
    axes.set_yscale("log")
    factor = values.max() / values.min()
    if factor < 4:
        axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        multiples = next((multiples for most, multiples in _MULTIPLES if factor < most), (1,))
        axes.yaxis.set_major_locator(LogLocator(subs=multiples))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _draw_skills(axes: Axes, episodes: Floats, usage: Floats, entropy: Floats) -> None:
    """Mean weight of each skill [R, S, K], and the entropy [R, S] as a fraction of its maximum."""
    axes.set_title("Skill weights", fontsize=11)
    skills = usage.shape[2]
    for skill in range(skills):
        color = COLORS[skill % len(COLORS)]
        _draw_curve(axes, episodes, usage[..., skill], color, f"skill {skill + 1}")
    if np.isfinite(entropy).any():
        fraction = entropy / math.log(skills)
        _draw_curve(axes, episodes, fraction, INK, f"gate entropy / log {skills}", ":")
    _finish_fractions(axes)


def _finish_fractions(axes: Axes) -> None:
    """A scale from 0 to 1, with space above for the legend."""
    labels = axes.get_legend_handles_labels()[1]
    is_wide = axes.get_position().width > 0.4  # One of two panels, not of three.
    columns = 3 if is_wide and sum(map(len, labels)) < 40 else 2
    axes.set_ylim(-0.02, 1.06 + 0.13 * math.ceil(len(labels) / columns))
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.legend(fontsize=9, loc="upper center", ncols=columns, columnspacing=1.2, frameon=False)


def _add_minutes(axes: Axes, episodes: Floats, wall_seconds: Floats) -> None:
    """A second scale at the top: minutes of wall-clock time, if the rows have it."""
    is_known = np.isfinite(wall_seconds)
    if not is_known.any():
        return
    # The clock of a resumed run may restart, but a scale must not decrease.
    minutes = np.maximum.accumulate(wall_seconds[is_known]) / 60
    ticks: Any = MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(minutes[0], minutes[-1])
    ticks = ticks[(ticks >= minutes[0]) & (ticks <= minutes[-1])]
    if ticks.size < 2:
        ticks = minutes[-1:]
    positions = np.interp(ticks, minutes, episodes[is_known])
    # Compilation takes time without episodes: its minutes would lie on top of each other.
    clear = [0]
    for number in range(1, ticks.size):
        if positions[number] - positions[clear[-1]] >= _TICK_GAP * max(1.0, episodes.max()):
            clear.append(number)
    ticks, positions = ticks[clear], positions[clear]
    top = axes.secondary_xaxis("top")
    top.set_xticks(positions, [f"{tick:.3g}" for tick in ticks], fontsize=9)
    top.tick_params(color="0.5", labelcolor="0.35")
    top.set_xlabel("minutes", fontsize=9, color="0.35")


def learning_curves(
    runs: Mapping[str, Sequence[Rows]],
    *,
    title: str,
    paper_rewards: Mapping[str, float] | None = None,
) -> Figure:
    """Plot mean reward and success over the training episodes, one line per agent.

    Where all runs were evaluated while they were trained, those of the greedy policies, as in the
    paper's figure 6; else those of the robots that explore.

    Args:
        runs: for each agent, the rows of `metrics.jsonl` of its runs; `mean_reward` and `success`
            (or `eval_mean_reward` and `eval_success`) are numbers, or lists of one per training
            seed. Runs are cut to the agent's shortest.
        title: above both panels.
        paper_rewards: by agent, the paper's final mean rewards, drawn beside those of evaluation.

    Returns:
        Two panels. The line is the mean over the training seeds of an agent, the band Student's
        95 % interval; with one seed there is no band.

    Raises:
        ValueError: no agents, or an agent without rows.
    """
    if not runs:
        raise ValueError("no runs, expected at least one agent")
    for agent, rows_of_runs in runs.items():
        if not rows_of_runs or not all(rows_of_runs):
            raise ValueError(f"agent {agent}: no rows of metrics, expected at least one a run")
    points = {
        agent: [evaluated_rows(rows) for rows in of_agent] for agent, of_agent in runs.items()
    }
    is_evaluated = all(all(of_agent) for of_agent in points.values())
    prefix, how = ("eval_", "in evaluation") if is_evaluated else ("", "while exploring")
    figure = Figure(figsize=(WIDTH_IN, 3.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, 2)
    for number, (agent, rows_of_runs) in enumerate((points if is_evaluated else runs).items()):
        length = min(len(rows) for rows in rows_of_runs)
        episodes = np.array([row["episodes"] for row in rows_of_runs[0][:length]], float)
        for axes, name in zip(panels, ("mean_reward", "success"), strict=True):
            metrics = [_metric(rows[:length], prefix + name) for rows in rows_of_runs]
            values = np.concatenate(metrics, axis=1)
            _draw_band(axes, episodes, values, COLORS[number % len(COLORS)], plain(agent))
        if is_evaluated and paper_rewards and agent in paper_rewards:
            color, reward = COLORS[number % len(COLORS)], paper_rewards[agent]
            panels[0].axhline(reward, color=color, ls=":", lw=1.5, label=f"the paper's {agent}")
    for axes, name in zip(panels, ("Mean reward per step", f"Success {how}"), strict=True):
        axes.set_title(name, fontsize=11)
        axes.set_xlabel("training episodes")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        tidy(axes)
    panels[1].set_ylim(0, 1.02)
    panels[0].legend(frameon=False)
    figure.suptitle(plain(title))
    return figure


def _draw_band(
    axes: Axes, episodes: NDArray[Any], values: NDArray[Any], color: str, label: str
) -> None:
    """Draw the mean of values [R, S] over seeds; with several seeds, also its interval."""
    axes.plot(episodes, values.mean(axis=1), color=color, lw=2, label=label)
    intervals = [seed_interval(row) for row in values]
    if None not in intervals:
        low, high = np.array(intervals).T
        axes.fill_between(episodes, low, high, color=color, alpha=0.2, lw=0)


def gate_entropy_curves(rows_by_run: Mapping[str, Rows], *, title: str) -> Figure:
    """Plot the entropy of the skill decision in training, and how different the skills are.

    Args:
        rows_by_run: for each run, the rows of its `metrics.jsonl` with `episodes` (cumulative),
            `gate_entropy` (nat) and `skill_usage` ([K] or [seeds, K], for the number of skills);
            `skill_distance` is drawn if present. Numbers, or lists of one per training seed: then
            each seed is a thin line and their mean a bold one. NaN and None leave a gap.
        title: above the panels.

    Returns:
        Left, the entropy as a fraction of its maximum, log K: at 1 all skills have equal weight, at
        0 one has all. Right, if any run has it, the mean absolute deviation of the Q-values of the
        skills from their mean.

    Raises:
        ValueError: no runs, or a run without rows, without these metrics, or with one skill.
    """
    if not rows_by_run:
        raise ValueError("no runs, expected at least one")
    for run, rows in rows_by_run.items():
        required = ("episodes", "gate_entropy", "skill_usage")
        if not rows or any(name not in row for row in rows for name in required):
            raise ValueError(f"run {run}: {len(rows)} rows, expected some, all with {required}")
        if np.shape(rows[0]["skill_usage"])[-1] < 2:
            raise ValueError(f"run {run} has 1 skill, expected at least 2")
    has_distance = any("skill_distance" in row for rows in rows_by_run.values() for row in rows)
    names = ["Entropy / log K"]
    if has_distance:
        names.append("Distance between the skills' Q-values")
    figure = Figure(figsize=(WIDTH_IN, 3.7), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(names), squeeze=False)[0]
    for number, (run, rows) in enumerate(rows_by_run.items()):
        color = COLORS[number % len(COLORS)]
        episodes = _metric(rows, "episodes").max(axis=1)
        largest = math.log(np.shape(rows[0]["skill_usage"])[-1])
        _draw_curve(panels[0], episodes, _metric(rows, "gate_entropy") / largest, color, plain(run))
        if any("skill_distance" in row for row in rows):
            _draw_curve(panels[1], episodes, _metric(rows, "skill_distance"), color, plain(run))
    for axes, name in zip(panels, names, strict=True):
        axes.set_title(name, fontsize=11)
        axes.set_xlabel("training episodes")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        tidy(axes)
    panels[0].set_ylim(-0.02, 1.05)
    if has_distance:
        panels[1].set_ylim(bottom=0)
    handles, labels = panels[0].get_legend_handles_labels()
    columns = min(len(labels), 4)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    figure.suptitle(plain(title))
    return figure
