"""Damage to map files: to the bytes of any, and to what YAML and MovingAI texts say.

A mutation follows from the random numbers it is given and from nothing else. One that knows nothing
of a format cuts and turns bytes; one that knows it puts hostile values into its fields, and so gets
past the first check.
"""

from __future__ import annotations

import random

import numpy as np
from map_files import HEAD

ROWS, COLS = 20, 30
GREY = np.full((ROWS, COLS), 254, dtype=np.uint8)
GREY[5:9, 10:20] = 0
FIELDS = {
    **HEAD,
    "mode": "trinary",
    "spawn_points": "[[0.5, 0.5], [2.5, 0.5]]",
    "evaluation_points": "[[0.5, 0.5], [2.5, 1.5]]",
    "spawn_radius": "0.5",
    "max_steps": "300",
}
YAML = "".join(f"{key}: {value}\n" for key, value in FIELDS.items()).encode()
MOVINGAI = b"type octile\nheight 20\nwidth 30\nmap\n" + b"".join(
    b"".join(b"." if cell else b"@" for cell in row) + b"\n" for row in GREY
)

_VALUES = (
    *("", "~", "null", "0", "-0.0", "1", "-1", "0.5", "1e308", "-1e308", "1e309", "5e-324", "1e-6"),
    *("nan", ".nan", ".inf", "-.inf", "inf", "1_000", "0x10", "0o7", "1e", "1..2", "+", "1e-999"),
    *("9" * 400, "0." + "9" * 400, "1" + "0" * 5000, "1e9", "1000000", "1e6", "0.05", "100", "5"),
    *("true", "yes", "raw", "scale", "trinary", "[]", "{}", "[[]]", "[[[[]]]]", "[0, 0]"),
    *("[0, 0, 0]", "[1e9, -1e9, 3]", "[1e308, 1e308, 1e308]", "[-1e308, 1, 1e300]", "[1, [2], 3]"),
    *("[0, 0, nan]", "[-0.0, -0.0, -0.0]", "[1, 2, 3, 4]", "[[0.5, 0.5], [2.5, 0.5]]"),
    *("[[0.5, 0.5]]", "[[1e308, -1e308], [1, 1]]", "[[1, 1], [1e300, 1]]", "[[-0.0, 0], [1, 1]]"),
    *("[[1, 1], [1, 1]]", "[[1.2, 0.7], [0.5, 0.5]]", "[" + "[0.5, 0.5], " * 300 + "]", "[" * 500),
    *("[" * 300 + "]" * 300, "{a: " * 200 + "}" * 200, "&a [*a]", "&a [[0.5, 0.5], *b]", "*a"),
    *("&a 0.1", "*nothing", "!!python/object/apply:os.getcwd []", "!!float 0.1", "!!binary AAAA"),
    *("!<x> 1", "! 0", "!!set {a}", "2026-01-01", "12:30:45", '"\\UFFFFFFFF"', '"\\U00110000"'),
    *('"\\uD800"', '"\\0"', '"\\x07"', "'", '"', '"0.1', "|", ">", "|\n  0.1", ">-\n  0.1\n"),
    *("? a", "- 1", "a: b", "a: b: c", "%TAG", "@", "`", "#", "room.pgm", "../room.pgm", "/"),
    *("room.yaml", ".", "..", "/dev/zero", "/dev/stdin", "~/x", "n" * 300, "room.pgm/x", "\u0661"),
    *("\u00e9", "\u2028", "\ufeff0.1", "\x85", "0.1 # why", "0.1\t", "\t0.1", "[0.1", "0.1]"),
)
# Of the right sort for their field, and at the limits or beyond them.
_FITTING = {
    "image": ("./room.pgm", "'room.pgm'", "x/../room.pgm", "../room.pgm", "ROOM.PGM"),
    "resolution": (
        "1e-6",
        "9.9e-7",
        "1000",
        "1000.1",
        "1",
        "0.05",
        "1e-3",
        "+.1",
        "0.1e0",
        "1e-320",
    ),
    "origin": ("[1e9, -1e9, 0]", "[1e9, 0, 1e9]", "[0, 0, -7]", "[-0.0, 3, 1.5]", "[1e308, 0, 0]"),
    "negate": ("1", "true", "False", "2", "-0"),
    "occupied_thresh": ("1", "1.0", "0.2", "0.196", "1.01", "0"),
    "free_thresh": ("0", "1e-9", "0.65", "0.6499", "0.9", "-0.0", "5e-324"),
    "mode": ("raw", "scale", "Trinary"),
    "spawn_points": (
        "[[0.1, 0.1], [2.9, 1.9]]",
        "[[0.15, 0.15], [2.85, 1.85]]",
        "[[3, 2], [1, 1]]",
    ),
    "evaluation_points": (
        "[[0.5, 0.5], [0.5, 0.5]]",
        "[[1.5, 1.3], [0.5, 0.5]]",
        "[[0, 0], [3, 2]]",
    ),
    "spawn_radius": ("0", "-0.0", "1e308", "5e-324", "-1"),
    "max_steps": ("1", "1000000", "1e6", "3e2", "1000001", "0.5"),
}
_LINES = ("{}\n", "x: {}\n", "? {}\n: 1\n", "{}: 1\n", "<<: {}\n", "# {}\n", "--- {}\n", "  {}\n")
_BEGINNINGS = ("%YAML 1.1\n---\n", "---\n", "--- ", "\ufeff", "%YAML 9.9\n", "# a\n", "\n\n", " ")
_CODECS = ("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "latin-1", "cp037", "utf-7")
_ENDS = ("\r\n", "\r", "\n\n", "\x85", "\u2028", "\n\r", "\n ", "\n\t", " \n", "\n---\n", "\n...\n")
_COMMON_BYTES = bytes((0, 9, 10, 13, 32, 35, 45, 48, 57, 127, 128, 255))
_KEYS = (b"height", b"width", b"type", b"map", b"", b"\0", b"type octile", b"height\t", b"HEIGHT")
_NUMBERS = (
    b"0",
    b"-1",
    b"1e1",
    b"\xb2",
    b"9" * 9,
    b"99999999",
    b"8192",
    b"20",
    b"30",
    b"30 1",
    b"",
)
_ROWS = (
    b"",
    b"G" * 30,
    b"@" * 30,
    b"\0" * 30,
    b" " * 30,
    b"x" * 30,
    b"." * 29,
    b"S" * 30,
    b"S" * 31,
    b"." * 61,
)


def mutated_bytes(data: bytes, rng: random.Random) -> bytes:
    """One to four places cut out, turned, swapped, doubled, or filled with what was not there."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(data) + 1)
        if rng.random() < 0.5:  # Half of all damage goes to where the headers are.
            at %= 100
        piece = data[at : at + rng.choice((1, 1, 2, 4, 30, 200))]
        end = at + len(piece)
        elsewhere = rng.randrange(len(data) + 1)
        what = rng.randrange(8)
        if what == 0:
            piece = bytes(byte ^ (1 << rng.randrange(8)) for byte in piece[:1]) + piece[1:]
        elif what == 1:
            piece = rng.randbytes(len(piece))
        elif what == 2:
            piece += rng.randbytes(rng.randint(1, 8))
        elif what == 3:
            piece = b""
        elif what == 4:
            piece = data[elsewhere : elsewhere + rng.choice((1, 5, 50))]
        elif what == 5:
            piece = bytes([rng.choice(_COMMON_BYTES)]) * len(piece)
        elif what == 6:
            piece *= rng.choice((2, 3, 40))
        elif rng.random() < 0.3:
            end = len(data)
        data = data[:at] + piece + data[end:]
    return data


def mutated_yaml(rng: random.Random) -> bytes:
    """Hostile values, keys that are missing, doubled or strange, other encodings and line ends."""
    fields = dict(FIELDS)
    if rng.random() < 0.4:  # Points are then sampled, wherever the origin is.
        del fields["spawn_points"], fields["evaluation_points"]
    for _ in range(rng.choice((1, 1, 1, 1, 1, 3))):
        field = rng.choice(list(fields))
        fields[field] = rng.choice(_FITTING[field] if rng.random() < 0.7 else _VALUES)
    if rng.random() < 0.5:  # Often nothing more, lest every file falls at the first check.
        return "".join(f"{key}: {value}\n" for key, value in fields.items()).encode()
    if rng.random() < 0.1:
        del fields[rng.choice(list(fields))]
    lines = [f"{key}: {value}\n" for key, value in fields.items()]
    if rng.random() < 0.3:
        more = (rng.choice(_LINES).format(rng.choice(_VALUES)), rng.choice(lines))
        lines.insert(rng.randrange(len(lines) + 1), rng.choice(more))
    if rng.random() < 0.1:
        rng.shuffle(lines)
    text = "".join(lines)
    if rng.random() < 0.3:
        text = text.replace("\n", rng.choice(_ENDS), rng.choice((1, 3, -1)))
    if rng.random() < 0.1:
        text = rng.choice(_BEGINNINGS) + text
    codec = rng.choice(_CODECS) if rng.random() < 0.2 else "utf-8"
    return text.encode(codec, errors="replace")


def mutated_movingai(rng: random.Random) -> bytes:
    """Odd sizes, keys and letters, other line ends; lines too many, few, long or short."""
    lines = MOVINGAI.splitlines()
    if rng.random() < 0.3:
        at = rng.randrange(4)
        key = rng.choice((lines[at].split()[0], *_KEYS))
        lines[at] = key + b" " * rng.randint(0, 2) + rng.choice(_NUMBERS)
    if rng.random() < 0.3:
        lines[rng.randrange(4, len(lines))] = rng.choice(_ROWS)
    if rng.random() < 0.1:
        lines.insert(rng.randrange(len(lines)), rng.choice((b"", b"\n", lines[-1], lines[0])))
    if rng.random() < 0.1:
        del lines[rng.randrange(len(lines)) :]
    end = rng.choice((b"\n", b"\n", b"\n", b"\r\n", b"\r", b"\n\n", b"\x0b", b"\0"))
    return end.join(lines) + rng.choice((b"", end, end * 50, b"more"))
