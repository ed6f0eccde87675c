"""Maps in the text form of the MovingAI path-finding benchmarks (suffix .map)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.occupancy import MAX_CELLS, OccupancyMap
from sqn_jax.maps.regions import Points, complete
from sqn_jax.outside.messages import named
from sqn_jax.outside.reading import read_at_most

_FREE = b".GS"  # ground, and swamp, which can be crossed
_BLOCKED = b"@OTW"  # out of bounds, trees, water
_MAX_BYTES = 2 * MAX_CELLS


def load_movingai(path: Path, *, robot_radius: float, resolution: float = 1.0) -> OccupancyMap:
    """Load a `.map` file; it names no scale and no points, so these are given and sampled.

    Args:
        path: the file: `type octile`, `height H`, `width W`, `map`, then H lines of W letters, the
            first one the north edge.
        robot_radius: m.
        resolution: m per cell.

    Raises:
        ValueError: one line naming the file, the field and what was expected.
    """
    data = read_at_most(path, _MAX_BYTES, "a MovingAI map")
    # One byte a line end, whatever the file has, so that row r begins at r * (width + 1). The body
    # is not split: a file of the largest size may have more lines than there is memory for.
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    *lines, body = [*data.split(b"\n", 4), b"", b"", b"", b""][:5]
    header = {}
    for number, line in enumerate(lines[:3]):
        fields = line.split(None, 2)
        if len(fields) != 2:
            raise ValueError(
                f"{named(path)}: header: line {number + 1}: expected a key and a value"
            )
        header[fields[0]] = fields[1]
    if header.get(b"type") != b"octile" or lines[3].strip() != b"map":
        raise ValueError(f"{named(path)}: header: expected type octile, height, width, map")
    rows, cols = (_side(path, key, header) for key in ("height", "width"))
    if rows * cols > MAX_CELLS:
        raise ValueError(
            f"{named(path)}: height, width: {rows} x {cols} cells, expected at most {MAX_CELLS}"
        )
    free = _free_cells(path, body, rows, cols)
    empty = np.empty((0, 2))
    drawn = OccupancyMap(path.stem, ~free[::-1], resolution, empty, empty)
    try:
        loaded = complete(drawn, Points(), robot_radius)
    except ValueError as error:
        raise ValueError(f"{named(path)}: map: {error}") from error
    notes = tuple(f"{named(path)}: {note}" for note in loaded.warnings)
    return dataclasses.replace(loaded, warnings=notes)


def _side(path: Path, key: str, header: Mapping[bytes, bytes]) -> int:
    """The height or the width, in cells."""
    text = header.get(key.encode(), b"")
    if not (text.isdigit() and len(text) < 9 and int(text) > 0):
        raise ValueError(f"{named(path)}: {key}: {text[:20]!r}, expected a whole number above 0")
    return int(text)


def _free_cells(path: Path, body: bytes, rows: int, cols: int) -> NDArray[np.bool_]:
    """The letters as free cells [rows, cols], the first line first; what follows is left out."""
    wrong = ValueError(f"{named(path)}: map: expected {rows} lines of {cols} letters")
    body = body[: rows * (cols + 1)]
    if len(body) == rows * (cols + 1) - 1:  # The last line need not end.
        body += b"\n"
    if len(body) != rows * (cols + 1):
        raise wrong
    letters = np.frombuffer(body, dtype=np.uint8).reshape(rows, cols + 1)
    ends = letters == ord("\n")
    if ends[:, :-1].any() or not ends[:, -1].all():
        raise wrong
    letters = letters[:, :-1]
    free = np.isin(letters, np.frombuffer(_FREE, dtype=np.uint8))
    if not (free | np.isin(letters, np.frombuffer(_BLOCKED, dtype=np.uint8))).all():
        known = (_FREE + _BLOCKED).decode()
        raise ValueError(f"{named(path)}: map: unknown letter, expected {known}")
    return free
