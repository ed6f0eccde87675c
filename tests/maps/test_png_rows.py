"""PNG files with too few pixels, and the sizes of interlaced ones, packed here by hand."""

from __future__ import annotations

import io
import struct
import time
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sqn_jax.maps import load_map
from sqn_jax.maps.png import require_all_rows

# The order in which an interlaced image is sent, in squares of 8 x 8 pixels, by the standard.
ADAM7 = """
1 6 4 6 2 6 4 6
7 7 7 7 7 7 7 7
5 6 5 6 5 6 5 6
7 7 7 7 7 7 7 7
3 6 4 6 3 6 4 6
7 7 7 7 7 7 7 7
5 6 5 6 5 6 5 6
7 7 7 7 7 7 7 7
"""


def png(
    width: int, height: int, rows: bytes, depth: int = 8, colour: int = 0, lace: int = 0
) -> bytes:
    """A PNG whose header and packed rows need not go together."""
    chunks = {b"IHDR": struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, lace)}
    chunks |= {b"IDAT": zlib.compress(rows), b"IEND": b""}
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks.items()
    )


def packed(pixels: np.ndarray, depth: int) -> bytes:
    """Rows of grey values, each with a byte for its filter and filled up to whole bytes."""
    bits = (pixels[..., None] >> np.arange(depth)[::-1] & 1).astype(np.uint8)
    return b"".join(b"\0" + np.packbits(row.reshape(-1)).tobytes() for row in bits)


def interlaced(pixels: np.ndarray, depth: int) -> bytes:
    """The rows of all seven images that an interlaced one is sent as, those without pixels not."""
    order = np.array([line.split() for line in ADAM7.split("\n") if line], dtype=int)
    turn = np.tile(order, (3, 3))[: pixels.shape[0], : pixels.shape[1]]
    rows = b""
    for number in range(1, 8):
        picked = turn == number
        part = pixels[picked.any(axis=1)][:, picked.any(axis=0)]
        rows += packed(part, depth) if part.size else b""
    return rows


@pytest.mark.parametrize("depth", [1, 2, 8])
@pytest.mark.parametrize("lace", [0, 1])
def test_all_rows_are_enough_and_a_byte_less_is_not(depth: int, lace: int) -> None:
    rng = np.random.default_rng(depth)
    for _ in range(40):
        height, width = rng.integers(1, 20, 2)
        pixels = rng.integers(0, 2**depth, (height, width))
        rows = (interlaced if lace else packed)(pixels, depth)
        whole = png(width, height, rows, depth, 0, lace)
        require_all_rows(whole)
        # The bytes are those of this image indeed.
        with Image.open(io.BytesIO(whole)) as image:
            found = np.asarray(image.convert("L"))
        np.testing.assert_array_equal(found, pixels * (255 // (2**depth - 1)))
        with pytest.raises(ValueError, match="1 bytes of pixels are missing"):
            require_all_rows(png(width, height, rows[:-1], depth, 0, lace))


@pytest.mark.parametrize(
    ("colour", "depth", "row"), [(2, 8, 91), (6, 16, 241), (4, 8, 61), (3, 4, 16)]
)
def test_every_channel_counts(colour: int, depth: int, row: int) -> None:
    # 30 pixels a row: 3, 4 or 2 channels of 1, 2 or 1 bytes, or half a byte; and the filter's byte.
    require_all_rows(png(30, 20, bytes(20 * row), depth, colour))
    with pytest.raises(ValueError, match="1 bytes of pixels"):
        require_all_rows(png(30, 20, bytes(20 * row - 1), depth, colour))


def test_an_image_with_rows_missing_is_refused_and_not_made_up(
    room: Callable[..., Path],
) -> None:
    rows = (b"\0" + b"\xfe" * 60) * 20
    assert load_map(room(image=png(60, 20, rows))).shape == (20, 60)
    with pytest.raises(ValueError, match=r"room\.yaml: image: 'room\.pgm': 61 bytes of pixels"):
        load_map(room(image=png(60, 20, rows[:-61])))
    # A file of a few bytes that claims a million rows costs nothing.
    began = time.monotonic()
    with pytest.raises(ValueError, match="bytes of pixels are missing"):
        load_map(room(image=png(60, 2**20, rows)))
    assert time.monotonic() - began < 2


def test_what_is_packed_is_unpacked_only_as_far_as_needed() -> None:
    # Four million bytes for an image of a thousand, and a wrong sum at their end.
    data = png(30, 20, np.random.default_rng(0).bytes(2**22))
    end = data.index(b"IEND") - 8
    require_all_rows(data[: end - 1] + bytes([data[end - 1] ^ 1]) + data[end:])


def test_what_is_packed_is_unpacked_in_small_pieces() -> None:
    bomb = png(30, 20, bytes(2**27))
    claims = png(8000, 8000, bytes(2**25))
    tracemalloc.start()
    try:
        require_all_rows(bomb)
        with pytest.raises(ValueError, match="bytes of pixels are missing"):
            require_all_rows(claims)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2**23


@pytest.mark.parametrize(
    "data",
    [b"\x89PNG\r\n\x1a\n", png(30, 20, b"")[:20], png(3, 2, bytes(8), colour=5)],
)
def test_a_header_without_sense_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"no PNG header|colour type 5"):
        require_all_rows(data)


def test_files_of_other_kinds_pass() -> None:
    require_all_rows(b"P5\n3 2\n255\n")
    require_all_rows(b"")
