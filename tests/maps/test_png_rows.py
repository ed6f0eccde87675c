"""PNG files with too few pixels, plain and interlaced, packed by hand; cut and changed ones."""

from __future__ import annotations

import resource
import struct
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sqn_jax.maps import load_map
from sqn_jax.maps.image import GrayImage, read_pixels

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


@pytest.fixture
def read(tmp_path: Path) -> Callable[[bytes], GrayImage]:
    """Decode an image out of a file."""

    def read(data: bytes) -> GrayImage:
        (tmp_path / "image").write_bytes(data)
        return read_pixels(tmp_path / "image")

    return read


Read = Callable[[bytes], GrayImage]
TRUNCATED = "image file is truncated"
MISSING = "rows of pixels are missing"


@pytest.mark.parametrize("depth", [1, 2, 8])
@pytest.mark.parametrize("lace", [0, 1])
def test_all_rows_are_enough_and_a_byte_or_a_row_less_are_not(
    depth: int, lace: int, read: Read
) -> None:
    rng = np.random.default_rng(depth)
    for _ in range(40):
        height, width = rng.integers(1, 20, 2)
        pixels = rng.integers(0, 2**depth, (height, width))
        rows = (interlaced if lace else packed)(pixels, depth)
        # The bytes are those of this image indeed.
        level = read(png(width, height, rows, depth, 0, lace)).level
        np.testing.assert_array_equal(level, pixels * (255 // (2**depth - 1)))
        with pytest.raises(ValueError, match=TRUNCATED):
            read(png(width, height, rows[:-1], depth, 0, lace))
        fewer = rows[: -len(last_row(pixels, depth, lace))]
        # Without a single row the decoder has not begun.
        with pytest.raises(ValueError, match=MISSING if fewer else f"{MISSING}|{TRUNCATED}"):
            read(png(width, height, fewer, depth, 0, lace))


def last_row(pixels: np.ndarray, depth: int, lace: int) -> bytes:
    """What is sent last, with its filter's byte."""
    height, width = pixels.shape
    if not lace:
        return packed(pixels[-1:], depth)
    if height > 1:
        return packed(pixels[-1 - height % 2 :][:1], depth)  # Of the seventh image.
    columns = pixels[:, 1::2] if width > 1 else pixels
    return packed(columns, depth)


@pytest.mark.parametrize(
    ("colour", "depth", "row"), [(2, 8, 91), (6, 16, 241), (4, 8, 61), (3, 4, 16), (0, 16, 61)]
)
def test_every_channel_counts(colour: int, depth: int, row: int, read: Read) -> None:
    # 30 pixels a row: 3, 4 or 2 channels of 1, 2 or 1 bytes, half a byte, or one of 2 bytes; and
    # the filter's byte.
    assert read(png(30, 20, bytes(20 * row), depth, colour)).level.shape == (20, 30)
    with pytest.raises(ValueError, match=TRUNCATED):
        read(png(30, 20, bytes(20 * row - 1), depth, colour))
    with pytest.raises(ValueError, match=MISSING):
        read(png(30, 20, bytes(19 * row), depth, colour))


def test_an_image_with_rows_missing_is_refused_and_not_made_up(
    room: Callable[..., Path],
) -> None:
    rows = (b"\0" + b"\xfe" * 60) * 20
    assert load_map(room(image=png(60, 20, rows))).shape == (22, 62)
    with pytest.raises(ValueError, match=rf"room\.yaml: image: 'room\.pgm': {MISSING}"):
        load_map(room(image=png(60, 20, rows[:-61])))
    # A file of a few bytes that claims a million rows costs little.
    began = time.monotonic()
    with pytest.raises(ValueError, match=MISSING):
        load_map(room(image=png(60, 2**18, rows)))
    assert time.monotonic() - began < 2


def test_an_image_cut_short_or_changed_is_refused(read: Read) -> None:
    rng = np.random.default_rng(0)
    whole = png(30, 20, packed(rng.integers(0, 256, (20, 30)), 8))
    read(whole)
    for length in range(1, len(whole) - 4):  # Four more are the checksum of nothing.
        with pytest.raises(ValueError, match="expected a "):
            read(whole[:length])
    for at in range(whole.index(b"IDAT"), whole.index(b"IEND") - 4):
        changed = whole[:at] + bytes([whole[at] ^ 1 << int(rng.integers(8))]) + whole[at + 1 :]
        with pytest.raises(ValueError, match="expected a "):
            read(changed)


def test_what_is_packed_is_unpacked_only_as_far_as_needed(read: Read) -> None:
    def peak() -> int:
        largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return largest if sys.platform == "darwin" else largest * 1024

    bomb = png(30, 20, bytes(2**28))
    claims = png(4000, 4000, bytes(2000 * 4001))
    before = peak()
    read(bomb)
    with pytest.raises(ValueError, match=MISSING):
        read(claims)
    assert peak() - before < 2**28


@pytest.mark.parametrize(
    "data",
    [b"\x89PNG\r\n\x1a\n", png(30, 20, b"")[:20], png(3, 2, bytes(8), colour=5)],
)
def test_a_header_without_sense_is_refused(data: bytes, read: Read) -> None:
    with pytest.raises(ValueError, match=r"expected a .*PNG, PGM, PPM or BMP image"):
        read(data)
