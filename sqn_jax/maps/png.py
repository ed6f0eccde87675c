"""Whether a PNG file holds the pixels it claims: Pillow would leave rows that are missing black."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
# First column and row of each pass of an interlaced image, and the steps between its pixels.
_PASSES = (
    *((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4)),
    *((0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)),
)
_STEP = 2**20  # bytes unpacked at a time


def require_all_rows(data: bytes) -> None:
    """Check that the packed data of a PNG unpack to all of its rows; other files pass.

    Nothing is kept: the memory this takes does not depend on the size the file claims.

    Raises:
      ValueError: the header is unusable, or rows are missing.
      zlib.error: what is packed is damaged.
    """
    if not data.startswith(_SIGNATURE):
        return
    kind, header = next(_chunks(data), (b"", b""))
    if kind != b"IHDR" or len(header) != 13:
        raise ValueError("no PNG header")
    missing = _unpacked_size(header)
    unpack = zlib.decompressobj()
    for kind, packed in _chunks(data):
        while kind == b"IDAT" and packed and missing > 0:
            missing -= len(unpack.decompress(packed, _STEP))
            packed = unpack.unconsumed_tail
    if missing > 0:
        raise ValueError(f"{missing} bytes of pixels are missing")


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and contents of each chunk; the last may be cut short."""
    at = len(_SIGNATURE)
    while at + 8 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        yield data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        at += length + 12


def _unpacked_size(header: bytes) -> int:
    """Bytes of all rows, each with one for its filter, that an IHDR stands for."""
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    if colour not in _CHANNELS:
        raise ValueError(f"colour type {colour}")
    size = 0
    for left, top, step_x, step_y in _PASSES if interlaced else ((0, 0, 1, 1),):
        columns, rows = (width - left - 1) // step_x + 1, (height - top - 1) // step_y + 1
        if columns > 0:
            size += max(rows, 0) * (1 + (columns * depth * _CHANNELS[colour] + 7) // 8)
    return size
