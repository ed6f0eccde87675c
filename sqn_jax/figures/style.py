"""Common to all figures: size, colors, axes, and writing them to files."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sqn_jax.storage.files import NotWritten, written_whole

DPI = 160
WIDTH_IN = 9.0

# Colors of Okabe and Ito, distinct under all common color blindness; no yellow on white.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
INK, OBSTACLE = "#222222", "#333a42"


def plain(text: str) -> str:
    """Escape dollar signs in a text, which Matplotlib would read as formulas."""
    return text.replace("$", r"\$")


def tidy(axes: Axes) -> None:
    """Draw a light grid, and no frame at the top and right."""
    axes.grid(color="0.9")
    axes.spines[["top", "right"]].set_visible(False)


@dataclass(frozen=True)
class Picture:
    """A picture that a notebook shows if it is the last line of a cell; needs no IPython."""

    png: bytes = field(repr=False)
    """The PNG file."""

    def _repr_png_(self) -> bytes:
        """The hook by which notebooks show an object."""
        return self.png


def picture(figure: Figure) -> Picture:
    """A figure as PNG in memory: the bytes that `save` would write."""
    buffer = io.BytesIO()
    _write_png(figure, buffer)
    return Picture(buffer.getvalue())


def _write_png(figure: Figure, target: Path | BinaryIO) -> None:
    # Without the version of Matplotlib, so that the same figure gives the same file.
    figure.savefig(target, format="png", dpi=DPI, metadata={"Software": None})


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, all or nothing; missing folders are created.

    Raises:
        ValueError: the name does not end in .png, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path}: the name ends in {path.suffix!r}, expected .png")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NotWritten(path, error) from None
    with written_whole(path) as partial:
        _write_png(figure, partial)
