"""What the figures have in common: size, colours, axes, and how they are written."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

DPI = 160
WIDTH_IN = 9.0

# Okabe and Ito's colours, told apart under every common colour blindness; no yellow on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
INK, OBSTACLE = "#222222", "#333a42"


def tidy(axes: Axes) -> None:
    """A light grid, and no frame at the top and at the right."""
    axes.grid(color="0.9")
    axes.spines[["top", "right"]].set_visible(False)


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
