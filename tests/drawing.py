"""What figures consist of, read back from their artists, and their resolution."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from sqn_jax.figures import curves, episode, paths, skills, style, timeline


def set_dpi(monkeypatch: pytest.MonkeyPatch, dpi: int) -> None:
    """Dots an inch of what is drawn and saved from now on."""
    for module in (curves, episode, paths, skills, style, timeline):
        monkeypatch.setattr(module, "DPI", dpi)


def drawn(figure: Any) -> Any:
    """Run everything that only happens when a figure is rendered (warnings are errors)."""
    FigureCanvasAgg(figure).draw()
    return figure


def panels(figure: Any) -> list[Any]:
    return [axes for axes in figure.axes if axes.get_title()]


def marks(axes: Any, marker: str) -> NDArray[np.float64]:
    """Places [M, 2] of the marks of one kind."""
    places = [line.get_xydata() for line in axes.lines if line.get_marker() == marker]
    return np.concatenate(places) if places else np.zeros((0, 2))


def drawn_paths(axes: Any) -> list[Any]:
    """The paths drawn in a panel, each in pieces that have colors of their own."""
    return [child for child in axes.collections if isinstance(child, LineCollection)]


def metrics_row(chunk: int, **changes: Any) -> dict[str, Any]:
    """A row of metrics.jsonl as one seed writes it."""
    plain = {
        "episodes": 100 * chunk,
        "env_steps": 40_000 * chunk,
        "updates": 16 * chunk,
        "wall_seconds": 30.0 * chunk,
        "mean_reward": -0.1 + 0.2 * chunk,
        "success": 0.1 * chunk,
        "time_steps": 400.0 - 20 * chunk,
        "loss": 0.5 / chunk,
        "epsilon": 0.5 - 0.04 * chunk,
        "gate_entropy": 0.6 / chunk,
        "skill_usage": [0.2 * chunk / 2, 1 - 0.2 * chunk / 2],
    }
    return plain | changes


def tick_labels(axis: Any) -> list[Any]:
    """Those within the axis; Matplotlib keeps labels beyond its ends and does not draw them."""
    low, high = sorted(axis.get_view_interval())
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    inside = [tick for tick in ticks if low <= tick.get_loc() <= high]
    return [label for tick in inside for label in (tick.label1, tick.label2)]


def check_texts(figure: Any) -> None:
    """Every visible text lies on the page and apart from all others; legends leave panels free."""
    renderer = figure.canvas.get_renderer()
    for legend in figure.legends:
        frame = legend.get_window_extent(renderer).padded(-1)
        assert not any(frame.overlaps(axes.get_tightbbox(renderer)) for axes in figure.axes)
    texts = [figure._suptitle, *(text for legend in figure.legends for text in legend.get_texts())]
    for axes in [a for parent in figure.axes for a in (parent, *parent.child_axes)]:
        texts += [axes.title, axes.xaxis.label, axes.yaxis.label, *axes.texts]
        texts += [label for axis in (axes.xaxis, axes.yaxis) for label in tick_labels(axis)]
        if axes.get_legend():
            texts += axes.get_legend().get_texts()
    seen = [text for text in texts if text.get_visible() and text.get_text().strip()]
    boxes = [text.get_window_extent(renderer).padded(-1) for text in seen]
    width, height = figure.canvas.get_width_height()
    for number, box in enumerate(boxes):
        inside = box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height
        assert inside, f"{seen[number].get_text()!r} leaves the page"
        for other in range(number):
            pair = f"{seen[number].get_text()!r} and {seen[other].get_text()!r}"
            assert not box.overlaps(boxes[other]), f"{pair} overlap"
