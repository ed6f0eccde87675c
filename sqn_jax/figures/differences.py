"""Differences between arms of an experiment, with their intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from sqn_jax.figures.style import COLORS, DPI, WIDTH_IN, plain, tidy


def paired_differences(entries: Sequence[Mapping[str, Any]], *, title: str) -> Figure:
    """Draw the difference in SPL of each arm to the reference, paired by training seed.

    Args:
        entries: with `maps`, `tasks`, `arm`, `difference` and `difference_ci95` (None with one
            seed), and `seeds`.
        title: above the panels.

    Returns:
        A panel for each pair of maps and tasks: a point for each arm and its interval as a line.

    Raises:
        ValueError: no entries.
    """
    if not entries:
        raise ValueError("no differences, expected at least one")
    panels: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for entry in entries:
        epsilon = f", epsilon {entry['epsilon']:g}" if entry.get("epsilon") else ""
        panels.setdefault((entry["maps"] + epsilon, entry["tasks"]), []).append(entry)
    columns = min(2, len(panels))
    lines = -(-len(panels) // columns)
    tallest = max(map(len, panels.values()))
    height = lines * (0.75 + 0.28 * tallest) + 0.5
    figure = Figure(figsize=(WIDTH_IN, height), dpi=DPI, layout="constrained")
    all_axes = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, ((maps, tasks), shown) in zip(all_axes, panels.items(), strict=False):
        for place, entry in enumerate(reversed(shown)):
            if entry["difference_ci95"] is not None:
                axes.plot(entry["difference_ci95"], [place, place], color=COLORS[0], lw=2)
            axes.plot([entry["difference"]], [place], "o", color=COLORS[0])
        labels = [f"{entry['arm']} ({len(entry['seeds'])})" for entry in reversed(shown)]
        axes.set_yticks(range(len(shown)), [plain(label) for label in labels], fontsize=9)
        axes.set_ylim(-0.6, len(shown) - 0.4)
        axes.axvline(0, color="0.45", lw=1)
        axes.set_title(plain(f"{maps}, {tasks}"), fontsize=11)
        axes.locator_params(axis="x", nbins=5)
        axes.set_xlabel("difference in SPL", fontsize=9)
        tidy(axes)
    for axes in all_axes[len(panels) :]:
        axes.axis("off")
    figure.suptitle(plain(f"{title} (training seeds)"))
    return figure
