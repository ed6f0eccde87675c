"""Several agents in one picture: learning curves and robustness to noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from sqn_jax.figures.runs import COLOURS, DPI, WIDTH_IN
from sqn_jax.statistics import bootstrap_interval

Rows = Sequence[Mapping[str, Any]]

_MARKERS = ("o", "s", "^", "D", "v", "P")


def learning_curves(runs: Mapping[str, Sequence[Rows]], *, title: str) -> Figure:
    """Mean reward and success of training over the episodes, one line an agent.

    Args:
        runs: for each agent the `metrics.jsonl` rows of its runs; `mean_reward` and `success` are
            numbers, or lists with one a training seed. Runs of an agent are cut to the shortest.
        title: stands above both panels.

    Returns:
        Two panels. The line is the mean over an agent's training seeds, the band a 95 % bootstrap
        interval of it; with one seed there is no band.

    Raises:
        ValueError: an agent has no rows.
    """
    figure = Figure(figsize=(WIDTH_IN, 3.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, 2)
    for number, (agent, rows_of_runs) in enumerate(runs.items()):
        if not rows_of_runs or not all(rows_of_runs):
            raise ValueError(f"agent {agent}: no rows of metrics, expected at least one a run")
        length = min(len(rows) for rows in rows_of_runs)
        episodes = np.array([row["episodes"] for row in rows_of_runs[0][:length]], float)
        for axes, name in zip(panels, ("mean_reward", "success"), strict=True):
            columns = [
                np.array([np.atleast_1d(row[name]) for row in rows[:length]], float)
                for rows in rows_of_runs
            ]
            values = np.concatenate(columns, axis=1)
            _draw_band(axes, episodes, values, COLOURS[number % len(COLOURS)], agent)
    for axes, name in zip(panels, ("mean reward a step", "success while training"), strict=True):
        axes.set_title(name, fontsize=11)
        axes.set_xlabel("episodes")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        _tidy(axes)
    panels[1].set_ylim(0, 1.02)
    panels[0].legend(frameon=False)
    figure.suptitle(title)
    return figure


def _draw_band(
    axes: Axes, episodes: NDArray[Any], values: NDArray[Any], colour: str, label: str
) -> None:
    """Mean of values [R, S] over the seeds, and its interval where there are several."""
    axes.plot(episodes, values.mean(axis=1), color=colour, lw=2, label=label)
    if values.shape[1] > 1:
        low, high = np.array([bootstrap_interval(row, resamples=400) for row in values]).T
        axes.fill_between(episodes, low, high, color=colour, alpha=0.2, lw=0)


def robustness(results: Sequence[Mapping[str, Any]], *, title: str) -> Figure:
    """Success over velocity noise and over range noise, one line an agent.

    Args:
        results: entries of an evaluation file on one map, for one goal radius, each with one of
            the two noises at 0.
        title: stands above both panels.

    Returns:
        Two panels; the bars are the entries' 95 % intervals over episodes.

    Raises:
        ValueError: there are no entries.
    """
    if not results:
        raise ValueError("no results, expected at least one entry")
    figure = Figure(figsize=(WIDTH_IN, 3.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    agents = list(dict.fromkeys(entry["agent"] for entry in results))
    for axes, noise, other in (
        (panels[0], "velocity_noise", "range_noise"),
        (panels[1], "range_noise", "velocity_noise"),
    ):
        for number, agent in enumerate(agents):
            entries = [e for e in results if e["agent"] == agent and e[other] == 0]
            entries = sorted(entries, key=lambda entry: entry[noise])
            success = [entry["success"] for entry in entries]
            mean = np.array([told["mean"] for told in success])
            low, high = np.array([told["ci95"] for told in success]).T
            axes.errorbar(
                [entry[noise] for entry in entries],
                mean,
                yerr=[np.maximum(mean - low, 0), np.maximum(high - mean, 0)],
                color=COLOURS[number % len(COLOURS)],
                marker=_MARKERS[number % len(_MARKERS)],
                capsize=3,
                label=agent,
            )
        unit = results[0][f"{noise}_unit"]
        axes.set_xlabel(_NOISE_LABELS[noise, unit])
        _tidy(axes)
    panels[0].set_ylabel("success")
    panels[0].set_ylim(0, 1.02)
    panels[0].legend(frameon=False)
    figure.suptitle(title)
    return figure


_NOISE_LABELS = {
    ("velocity_noise", "relative"): "velocity noise, sigma as a share of full speed",
    ("velocity_noise", "absolute"): "velocity noise, sigma in m/s and rad/s",
    ("range_noise", "relative"): "range noise, half-width as a share of the reading",
    ("range_noise", "absolute"): "range noise, half-width as a share of the range",
}


def _tidy(axes: Axes) -> None:
    axes.grid(color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
