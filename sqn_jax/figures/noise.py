"""Success under noise, several agents side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sqn_jax.figures.style import COLORS, DPI, WIDTH_IN, plain, tidy

_MARKERS = ("o", "s", "^", "D", "v", "P")


def robustness(results: Sequence[Mapping[str, Any]], *, title: str) -> Figure:
    """Plot success over velocity noise and over range noise, one line per agent.

    Args:
        results: entries of an evaluation file for one map and one goal radius, each with at least
            one of the two noises at 0.
        title: above both panels.

    Returns:
        Two panels; the bars are 95 % intervals over episodes.

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
            mean = np.array([metric["mean"] for metric in success])
            low, high = np.array([metric["ci95"] for metric in success]).T
            axes.errorbar(
                [entry[noise] for entry in entries],
                mean,
                yerr=[np.maximum(mean - low, 0), np.maximum(high - mean, 0)],
                color=COLORS[number % len(COLORS)],
                marker=_MARKERS[number % len(_MARKERS)],
                capsize=3,
                label=plain(agent),
            )
        unit = results[0][f"{noise}_unit"]
        axes.set_xlabel(_NOISE_LABELS[noise, unit])
        tidy(axes)
    panels[0].set_ylabel("success")
    panels[0].set_ylim(0, 1.02)
    panels[0].legend(frameon=False)
    figure.suptitle(plain(title))
    return figure


_NOISE_LABELS = {
    ("velocity_noise", "relative"): "velocity noise, sigma as a fraction of full speed",
    ("velocity_noise", "absolute"): "velocity noise, sigma in m/s and rad/s",
    ("range_noise", "relative"): "range noise, half-width as a fraction of the reading",
    ("range_noise", "absolute"): "range noise, half-width as a fraction of the range",
}
