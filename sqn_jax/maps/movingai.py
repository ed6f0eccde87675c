"""Maps in the text form of the MovingAI path-finding benchmarks (suffix .map)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sqn_jax.maps.image import MAX_PIXELS
from sqn_jax.maps.occupancy import (
    EVALUATION_COUNT,
    OccupancyMap,
    close_border,
    sample_spawn_points,
)

_FREE = b".GS"  # ground, and swamp, which can be crossed
_BLOCKED = b"@OTW"  # out of bounds, trees, water
_MAX_BYTES = 2 * MAX_PIXELS


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
    try:
        if not path.is_file():
            raise ValueError(f"{path}: no such file, expected a MovingAI map")
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"{path}: larger than {_MAX_BYTES} bytes, expected a MovingAI map")
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    header = {}
    for number, line in enumerate(lines[:3]):
        words = line.split()
        if len(words) != 2:
            raise ValueError(f"{path}: line {number + 1}: expected a key and a value")
        header[words[0]] = words[1]
    if header.get(b"type") != b"octile" or [line.strip() for line in lines[3:4]] != [b"map"]:
        raise ValueError(f"{path}: header: expected type octile, height, width, map")
    size = {}
    for key in ("height", "width"):
        text = header.get(key.encode(), b"")
        if not (text.isdigit() and len(text) < 9 and int(text) > 0):
            raise ValueError(f"{path}: {key}: {text[:20]!r}, expected a whole number above 0")
        size[key] = int(text)
    rows = lines[4 : 4 + size["height"]]
    if len(rows) < size["height"] or any(len(row) != size["width"] for row in rows):
        raise ValueError(f"{path}: map: expected {size['height']} lines of {size['width']} letters")
    letters = np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(len(rows), size["width"])
    free = np.isin(letters, np.frombuffer(_FREE, dtype=np.uint8))
    if not (free | np.isin(letters, np.frombuffer(_BLOCKED, dtype=np.uint8))).all():
        raise ValueError(f"{path}: map: unknown letter, expected {(_FREE + _BLOCKED).decode()}")
    occupied = close_border(~free[::-1])
    try:
        points = sample_spawn_points(occupied, resolution, robot_radius)
    except ValueError as error:
        raise ValueError(f"{path}: map: {error}") from error
    return OccupancyMap(path.stem, occupied, resolution, points, points[:EVALUATION_COUNT])
