"""Small map files written byte by byte, so that no code under test writes what it reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HEAD = {
    "image": "room.pgm",
    "resolution": "0.1",
    "origin": "[0.0, 0.0, 0.0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}


def pgm_bytes(grey: NDArray[np.integer], maxval: int = 255) -> bytes:
    """A binary PGM (P5), row 0 at the top; two bytes a pixel, high one first, above 255."""
    rows, cols = grey.shape
    kind = ">u2" if maxval > 255 else "u1"
    return b"P5\n%d %d\n%d\n" % (cols, rows, maxval) + grey.astype(kind).tobytes()


def write_room(
    folder: Path,
    *,
    grey: NDArray[np.integer] | None = None,
    image: bytes | None = None,
    drop: str | None = None,
    **fields: str,
) -> Path:
    """Write room.yaml and its image: an empty 12 x 9 m room (90 rows, 120 columns) unless told."""
    if grey is None:
        grey = np.full((90, 120), 254, dtype=np.uint8)
    entries = {**HEAD, **fields}
    if drop is not None:
        del entries[drop]
    (folder / "room.pgm").write_bytes(pgm_bytes(grey) if image is None else image)
    path = folder / "room.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in entries.items()))
    return path
