"""Damage to map images that keeps their format: hostile headers, chunks whose sums are right."""

from __future__ import annotations

import io
import random
import struct
import zlib

import numpy as np
from mutations import COLS, GREY, ROWS, mutated_bytes
from PIL import Image

Chunks = list[tuple[bytes, bytes]]
"""Kind and contents of each chunk of a PNG, in order."""


def pnm_bytes(kind: bytes, top: int, body: bytes) -> bytes:
    """A sound PNM of a kind such as P5 whose largest value is `top`."""
    return b"%s\n%d %d\n%d\n%s" % (kind, COLS, ROWS, top, body)


def png_bytes(mode: str, **options: object) -> bytes:
    """A sound PNG of a pixel type of Pillow's."""
    buffer = io.BytesIO()
    image = Image.fromarray(GREY.astype(np.uint16) * 257 if mode == "I;16" else GREY)
    (image if mode == "I;16" else image.convert(mode)).save(buffer, format="PNG", **options)
    return buffer.getvalue()


PNM = {
    "binary PGM": (b"P5", 255, GREY.tobytes()),
    "text PGM": (b"P2", 255, b" ".join(b"%d" % value for value in GREY.ravel())),
    "16 bit PGM": (b"P5", 65535, (GREY.astype(">u2") * 257).tobytes()),
    "colour PPM": (b"P6", 255, np.repeat(GREY, 3).tobytes()),
}
PNG = {
    "grey PNG": png_bytes("L"),
    "16 bit PNG": png_bytes("I;16"),
    "palette PNG": png_bytes("P", transparency=7),
    "RGB PNG": png_bytes("RGB", transparency=(0, 0, 0)),
    "RGBA PNG": png_bytes("RGBA"),
    "grey and alpha PNG": png_bytes("LA"),
    "1 bit PNG": png_bytes("1"),
}

_SIDES = (0, 1, 2, 19, 20, 21, 29, 30, 31, 300, 8191, 8192, 8193, 2**20, 2**31 - 1, 2**32 - 1)
_WIDE = (4095, 4096, 4097, 6_500)  # Squares of these are about the largest that may be read.
_PNM_KINDS = (b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"P7", b"Pf", b"PF", b"P0")
_TOPS = (0, 1, 15, 100, 254, 255, 256, 1000, 65534, 65535, 65536, 2**31, -1)
_NO_NUMBERS = (b"", b"x", b"1e2", b"+3", b"\xb2", b"0030", b"9" * 40)
_BLANKS = (
    b"\n",
    b" ",
    b"\r\n",
    b"\t",
    b"\n# a 9\n",
    b"#\n",
    b" #\r",
    b"\n" * 9,
    b"\x0b",
    b"",
    b"\0",
)
_ODD_VALUES = (b"-1 ", b"300 ", b"x ", b"# 1 2\n", b"#", b"9" * 30, b"1.5 ", b"\n", b"\0 ")
# Of the fields of IHDR, in their order.
_HEADER = (
    *(_SIDES, _SIDES, (0, 1, 2, 3, 4, 8, 16, 32), (0, 1, 2, 3, 4, 6, 7)),
    *((0, 1), (0, 1), (0, 1, 2)),
)
_BOMB = zlib.compress(bytes(2**22))
_TEXTS = (b"zTXt", b"a\0\0" + _BOMB), (b"iTXt", b"a\0\1\0\0\0" + _BOMB), (b"iCCP", b"a\0\0" + _BOMB)
_MOVING = (
    (b"acTL", struct.pack(">II", 2, 0)),
    (b"fcTL", struct.pack(">IIIIIHHBB", 0, 2**31, 2**31, 0, 0, 1, 1, 9, 9)),
)
_CLEAR = *((b"tRNS", bytes(count)) for count in (0, 1, 2, 6, 300)), (b"PLTE", bytes(3))
_ANY_CONTENTS = (
    *(b"PLTE", b"tRNS", b"bKGD", b"gAMA", b"pHYs", b"sRGB", b"cHRM", b"iCCP", b"zTXt", b"tEXt"),
    *(b"eXIf", b"acTL", b"fcTL", b"fdAT", b"IDAT", b"\0\0\0\0", b"QQQQ"),
)


def mutated_pnm(kind: bytes, top: int, body: bytes, rng: random.Random) -> bytes:
    """Another kind, odd numbers, comments and blanks in the header, less or more to read."""
    width, height = COLS, ROWS
    if rng.random() < 0.2:
        kind = rng.choice(_PNM_KINDS)
    if rng.random() < 0.4:
        width = rng.choice((*_SIDES, -1))
    if rng.random() < 0.4:
        height = rng.choice((*_SIDES, -1))
    if rng.random() < 0.04:
        width, height = rng.choices(_WIDE, k=2)
    if rng.random() < 0.5:
        top = rng.choice(_TOPS)
    numbers = [b"%d" % number for number in (width, height, top)]
    if rng.random() < 0.1:
        numbers[rng.randrange(3)] = rng.choice(_NO_NUMBERS)
    header = kind
    for word in (*numbers, b""):
        header += (rng.choice(_BLANKS) if rng.random() < 0.3 else b"\n") + word
    if rng.random() < 0.3:
        body = rng.choice((b"", body[:-1], body[:9], body + b"\n", b"#" + body, body * 9))
    if rng.random() < 0.2:
        body = rng.choice(_ODD_VALUES) + body
    return header + body


def mutated_png(data: bytes, rng: random.Random) -> bytes:
    """Hostile contents of a chunk or two; chunks missing, doubled, misplaced, or too many."""
    chunks, at = [], 8
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    for _ in range(rng.randint(1, 2)):
        rng.choice((_odd_header, _odd_header, _odd_pixels, _odd_chunk, _one_more))(chunks, rng)
    return data[:8] + b"".join(
        struct.pack(">I", len(contents))
        + kind
        + contents
        # The sum that the decoder will find to be right.
        + struct.pack(">I", zlib.crc32(kind + contents))
        for kind, contents in chunks
    )


def _odd_header(chunks: Chunks, rng: random.Random) -> None:
    """One field of IHDR."""
    for number, (kind, contents) in enumerate(chunks):
        if kind == b"IHDR" and len(contents) == 13:
            fields = list(struct.unpack(">IIBBBBB", contents))
            which = rng.choice((0, 1, 2, 2, 3, 3, 4, 5, 6))
            fields[which] = rng.choice(_HEADER[which])
            if rng.random() < 0.04:
                fields[:2] = rng.choices(_WIDE, k=2)
            chunks[number] = kind, struct.pack(">IIBBBBB", *fields)


def _odd_pixels(chunks: Chunks, rng: random.Random) -> None:
    """Pixels changed before packing, too few, too many; packed data cut, or none at all."""
    packed = b"".join(contents for kind, contents in chunks if kind == b"IDAT")
    try:
        rows = bytearray(zlib.decompress(packed))
    except zlib.error:
        rows = bytearray(packed)
    for _ in range(rng.choice((0, 1, 20)) if rows else 0):
        rows[rng.randrange(len(rows))] = rng.choice((0, 1, 4, 5, 255, rng.randrange(256)))
    rows = rng.choice((rows, rows, rows[:-1], rows[: len(rows) // 2], rows * 2, bytearray(2**20)))
    packed = zlib.compress(rows)
    packed = rng.choice((packed, packed, packed[:-4], packed + b"more", b"", rng.randbytes(50)))
    cut = rng.choice((len(packed), len(packed) // 2, 0))
    chunks[:] = [
        *(chunk for chunk in chunks if chunk[0] not in (b"IDAT", b"IEND")),
        *((b"IDAT", packed[:cut]), (b"IDAT", packed[cut:]), (b"IEND", b"")),
    ]


def _odd_chunk(chunks: Chunks, rng: random.Random) -> None:
    """One chunk with other contents, gone, doubled, all in another order, or of another kind."""
    at = rng.randrange(len(chunks))
    kind, contents = chunks[at]
    what = rng.randrange(5)
    if what == 0:
        chunks[at] = kind, mutated_bytes(contents, rng)
    elif what == 1:
        del chunks[at]
    elif what == 2:
        chunks.insert(rng.randrange(len(chunks)), chunks[at])
    elif what == 3:
        rng.shuffle(chunks)
    else:
        chunks[at] = rng.choice(_ANY_CONTENTS), contents


def _one_more(chunks: Chunks, rng: random.Random) -> None:
    """Transparency, a text or profile that unpacks to 4 MiB, animation, or random contents."""
    contents = rng.randbytes(rng.choice((0, 1, 2, 3, 6, 12, 255, 256, 257, 768, 771)))
    new = rng.choice((rng.choice(_TEXTS), rng.choice(_MOVING), rng.choice(_CLEAR), (b"", contents)))
    chunks.insert(
        rng.randrange(len(chunks)), new if new[0] else (rng.choice(_ANY_CONTENTS), contents)
    )
