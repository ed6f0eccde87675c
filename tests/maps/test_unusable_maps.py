"""Whatever a map file holds, loading it ends in a map or in one clear line."""

from __future__ import annotations

import os
import struct
import tempfile
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_files import write_room
from PIL import Image

from sqn_jax.maps import OccupancyMap, load_map, validate

Room = Callable[..., Path]


def assert_refused(path: Path | str, *words: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        load_map(path)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 700
    for word in words:
        assert word in message, message


def test_an_unknown_name_lists_the_known_ones() -> None:
    assert_refused("labyrinth", "unknown map 'labyrinth'", "maze", ".yaml")


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    assert_refused(tmp_path / "none.yaml", "none.yaml", "no such file")
    (tmp_path / "folder.yaml").mkdir()
    assert_refused(tmp_path / "folder.yaml", "folder.yaml", "no such file")
    assert_refused(tmp_path / ("x" * 300 + ".yaml"), "cannot be read")


@pytest.mark.parametrize(
    "key", ["image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"]
)
def test_a_missing_key_is_named(room: Room, key: str) -> None:
    assert_refused(room(drop=key), "room.yaml", f"{key}: missing")


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("resolution", "0", "above 0"),
        ("resolution", "-0.05", "above 0"),
        ("resolution", ".nan", "finite number"),
        ("resolution", "nan", "finite number"),
        ("resolution", "1e999", "finite number"),
        ("resolution", "five", "'five'"),
        ("resolution", "[0.05]", "finite number"),
        ("resolution", "1.2.3", "finite number"),
        ("resolution", "true", "finite number"),
        ("resolution", "", "finite number"),
        ("resolution", "1e9", "at most 1000"),
        ("origin", "[0, 0]", "3 numbers"),
        ("origin", "[0, 0, .inf]", "finite number"),
        ("origin", "[0, x, 0]", "origin[1]"),
        ("origin", "0", "3 numbers"),
        ("negate", "2", "0 or 1"),
        ("negate", "[]", "0 or 1"),
        ("mode", "binary", "trinary, scale, raw"),
        ("mode", "{}", "trinary, scale, raw"),
        ("occupied_thresh", "1.5", "0 to 1"),
        ("free_thresh", "-0.1", "0 to 1"),
        ("free_thresh", "0.65", "below occupied_thresh"),
        ("spawn_points", "[]", "a list of 2"),
        ("spawn_points", "[[1, 1]]", "a list of 2"),
        ("spawn_points", "[[1, 1], [1, 2, 3]]", "spawn_points[1]"),
        ("spawn_points", "[[1, 1], [1, y]]", "spawn_points[1][1]"),
        ("spawn_points", "{a: 1}", "a list of 2"),
        ("spawn_points", "[[1, 1], [50, 1]]", "outside"),
        ("spawn_points", "[[1, 1], [1e300, -1e300]]", "outside"),
        ("evaluation_points", "~", "a list of 2"),
        ("evaluation_points", "[[1, 1], [0.05, 1]]", "obstacle"),
        ("spawn_radius", "-1", ">= 0"),
        ("spawn_radius", "wide", "finite number"),
        ("max_steps", "0", "1 to 1000000"),
        ("max_steps", "2.5", "whole number"),
        ("max_steps", "1e12", "1 to 1000000"),
        ("image", "[]", "PNG or PGM"),
        ("image", "''", "PNG or PGM"),
        ("image", "absent.png", "no such file"),
        ("image", ".", "PNG or PGM"),
        ("image", '"a\\0b"', "PNG or PGM"),
        ("image", "y" * 300, "PNG or PGM"),
    ],
)
def test_a_bad_value_is_named_with_what_was_expected(
    room: Room, field: str, value: str, expected: str
) -> None:
    path = room()
    lines = [line for line in path.read_text().splitlines() if not line.startswith(f"{field}:")]
    path.write_text("\n".join([*lines, f"{field}: {value}"]))
    assert_refused(path, "room.yaml", field, expected)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"- 1\n- 2\n",
        b"just text",
        b"image: [\n",
        b"image: 'open\n",
        b"\xff\xfe\x00\x01",
        b"a: \x07\n",
        b"[" * 3000,
        b"? [a]\n: 1\n",
        b"a: &a [*a]\nimage: *b\n",
        b"!!python/object/apply:os.system ['true']",
    ],
)
def test_yaml_that_is_no_map_is_refused(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "m.yaml").write_bytes(text)
    assert_refused(tmp_path / "m.yaml", "m.yaml")


def test_a_file_too_long_for_a_map_is_not_parsed(room: Room) -> None:
    path = room()
    path.write_bytes(path.read_bytes() + b"# long\n" * 150_000)
    assert_refused(path, "room.yaml", "larger than 1048576 bytes")


def test_a_bomb_of_aliases_is_not_unfolded(room: Room) -> None:
    levels = ["a: &a [1, 1]"] + [
        f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]"
        for old, new in zip("abcdefgh", "bcdefghi", strict=True)
    ]
    path = room()
    path.write_text("\n".join([*levels, path.read_text(), "spawn_points: *i"]))
    assert_refused(path, "spawn_points[0]")


def test_an_image_outside_the_folder_is_refused(room: Room, tmp_path: Path) -> None:
    path = room()
    inner = tmp_path / "inner"
    inner.mkdir()
    moved = path.rename(inner / "room.yaml")
    text = moved.read_text()
    os.symlink(tmp_path / "room.pgm", inner / "link.pgm")
    for name in ("../room.pgm", str(tmp_path / "room.pgm"), "link.pgm"):
        moved.write_text(text.replace("room.pgm", name))
        assert_refused(moved, "image", "folder")


def png_claiming(width: int, height: int) -> bytes:
    """A PNG whose header names a size and whose data are one short row."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return (
        b"\x89PNG\r\n\x1a\n"
        + header
        + chunk(b"IDAT", zlib.compress(b"\0" * 9))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (b"", "bytes"),
        (b"no image at all", "PNG or PGM"),
        (b"GIF89a\x01\x00\x01\x00\x00\x00\x00;", "PNG or PGM"),
        (png_claiming(10, 10), "PNG or PGM"),
        (png_claiming(60_000, 60_000), "PNG or PGM"),
        (png_claiming(9_000, 8_000), "pixels"),
        (b"P5\n120 90\n255\n" + b"\xfe" * 500, "PNG or PGM"),
        (b"P5\n99999999 99999999\n255\n", "PNG or PGM"),
        (b"P5\n12 9\n0\n" + b"\0" * 108, "PNG or PGM"),
        (b"P5\n12 9\n70000\n" + b"\0" * 216, "PNG or PGM"),
        (b"P5\n-3 9\n255\n", "PNG or PGM"),
        (b"P2\n3 2\n255\n1 2 x 4 5 6\n", "PNG or PGM"),
        (b"Pf\n2 1\n-1.0\n" + b"\0" * 8, "pixel type"),
        (b"P5\n1 1\n255\n\xfe", "no free space"),
        (b"P5\n60 20\n255\n" + b"\0" * 1200, "no free space"),
        (b"P5\n60 20\n255\n" + b"\xcd" * 1200, "no free space"),
    ],
)
def test_an_unusable_image_is_refused(room: Room, image: bytes, expected: str) -> None:
    assert_refused(room(image=image), "room.yaml", "image", expected)


def test_unreachable_spawn_points_are_named(room: Room) -> None:
    grey = np.full((30, 80), 254, dtype=np.uint8)
    grey[:, 40] = 0
    path = room(grey=grey, spawn_points="[[1, 1], [2, 2], [6, 1]]")
    assert_refused(path, "room.yaml", "spawn_points[2]", "cannot be reached from spawn_points[0]")


@pytest.mark.parametrize("radius", [-0.1, float("nan"), float("inf")])
def test_an_impossible_robot_is_refused(radius: float) -> None:
    with pytest.raises(ValueError, match="robot_radius"):
        load_map("maze", robot_radius=radius)


def load_or_refuse(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            loaded = load_map(path)
        except ValueError as error:
            message = str(error)
        else:
            message = ""
    if message:
        assert "\n" not in message
        assert path.name in message
        return
    assert isinstance(loaded, OccupancyMap)
    validate(loaded, 0.1)
    assert np.isfinite(loaded.origin).all()


EDITS = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 3), st.binary(max_size=4)),
    min_size=1,
    max_size=4,
)


def edited(data: bytes, edits: list[tuple[float, int, bytes]]) -> bytes:
    """Bytes with some stretches replaced: (where as a share, how many bytes go, what comes)."""
    for share, gone, new in edits:
        at = int(share * len(data))
        data = data[:at] + new + data[at + gone :]
    return data


@settings(max_examples=150)
@given(edits=EDITS)
def test_damaged_yaml_is_refused_or_still_a_map(edits: list[tuple[float, int, bytes]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        points = "[[1.0, 1.0], [4.5, 1.0]]"
        grey = np.full((20, 60), 254, dtype=np.uint8)
        path = write_room(Path(folder), grey=grey, spawn_points=points, max_steps="300")
        path.write_bytes(edited(path.read_bytes(), edits))
        load_or_refuse(path)


@settings(max_examples=150)
@given(edits=EDITS, kind=st.sampled_from(["pgm", "png", "text"]))
def test_a_damaged_image_is_refused_or_still_a_map(
    edits: list[tuple[float, int, bytes]], kind: str
) -> None:
    grey = np.full((20, 30), 254, dtype=np.uint8)
    grey[5:9, 10:20] = 0
    text = b"P2\n30 20\n255\n" + b" ".join(b"%d" % value for value in grey.ravel())
    with tempfile.TemporaryDirectory() as folder:
        path = write_room(Path(folder), grey=grey, **({"image": text} if kind == "text" else {}))
        if kind == "png":
            Image.fromarray(grey).save(Path(folder) / "room.pgm", format="PNG")
        image = Path(folder) / "room.pgm"
        image.write_bytes(edited(image.read_bytes(), edits))
        load_or_refuse(path)
