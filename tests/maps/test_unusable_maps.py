"""Whatever a map file holds, loading it ends in a map or in one clear line."""

from __future__ import annotations

import os
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from map_files import pgm_bytes
from PIL import ImageFile

from sqn_jax.baselines.shortest_paths import has_paths, shortest_path_lengths
from sqn_jax.config import EnvConfig
from sqn_jax.evaluation.agents import BaselineAgent, with_baselines
from sqn_jax.evaluation.compare import load_maps
from sqn_jax.evaluation.settings import Settings
from sqn_jax.maps import distance, load_map
from sqn_jax.maps import image as image_module
from sqn_jax.maps.check import describe

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


def test_paths_are_not_searched_on_a_map_too_large_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The graph of 16 million free cells takes some 18 GB."""
    monkeypatch.setattr(distance, "MAX_SEARCHED_CELLS", 20_000)
    maze = load_map("maze")
    assert "no distances" in describe(maze)
    assert not has_paths(maze)
    with pytest.raises(ValueError, match=r"map maze: \d+,\d+ free cells, expected at most"):
        shortest_path_lengths(maze, np.ones((1, 3)), np.ones((1, 2)), robot_radius=0.1)
    settings = Settings(maps=("maze",))
    with pytest.raises(ValueError, match="for the oracle to plan on"):
        load_maps(with_baselines([], baselines=True), settings)
    bug = BaselineAgent("bug", EnvConfig())
    assert load_maps([bug], settings)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    assert_refused(tmp_path / "none.yaml", "none.yaml", "no such file")
    (tmp_path / "folder.yaml").mkdir()
    assert_refused(tmp_path / "folder.yaml", "folder.yaml: is a folder")
    assert_refused(tmp_path / ("x" * 300 + ".yaml"), "cannot be read")


@pytest.mark.parametrize(
    "key", ["image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"]
)
def test_a_missing_key_is_named(room: Room, key: str) -> None:
    assert_refused(room(drop=key), "room.yaml", f"{key}: missing")


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("resolution", "0", "from 1e-06 to 1000"),
        ("resolution", "-0.05", "from 1e-06 to 1000"),
        ("resolution", ".nan", "finite number"),
        ("resolution", "nan", "finite number"),
        ("resolution", "1e999", "finite number"),
        ("resolution", "five", "'five'"),
        ("resolution", "[0.05]", "finite number"),
        ("resolution", "1.2.3", "finite number"),
        ("resolution", "true", "finite number"),
        ("resolution", "", "finite number"),
        ("resolution", "1e9", "from 1e-06 to 1000"),
        ("origin", "[0, 0]", "3 numbers"),
        ("origin", "[0, 0, .inf]", "finite number"),
        ("origin", "[0, x, 0]", "origin[1]"),
        ("origin", "[0, 0, 1e10]", "1e+09"),
        ("origin", "[-1e9, 0, 0]", "1e+09"),  # The wall around an open map stands beyond it.
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
        ("spawn_points", "[[1, 1], [1e8, -1e8]]", "outside"),
        ("spawn_points", "[[1, 1], [1e300, -1e300]]", "1e+09"),
        ("evaluation_points", "~", "a list of 2"),
        ("evaluation_points", "[[1, 1], [0.05, 1]]", "obstacle"),
        ("spawn_radius", "-1", ">= 0"),
        ("spawn_radius", "1e308", "at most 1e+09"),
        ("spawn_radius", "wide", "finite number"),
        ("max_steps", "0", "1 to 1000000"),
        ("max_steps", "2.5", "whole number"),
        ("max_steps", "1e12", "1 to 1000000"),
        ("image", "[]", "PNG, PGM"),
        ("image", "''", "PNG, PGM"),
        ("image", "absent.png", "no such file"),
        ("image", ".", "PNG, PGM"),
        ("image", '"a\\0b"', "PNG, PGM"),
        ("image", "y" * 300, "PNG, PGM"),
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
        b'a: "\\UFFFFFFFF"',
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


def test_a_tag_in_a_file_calls_nothing(room: Room, tmp_path: Path) -> None:
    made = tmp_path / "made"
    for tag in ("object/apply:os.mkdir", "object/new:os.mkdir"):
        path = room(note=f"!!python/{tag} ['{made}']")
        with pytest.warns(UserWarning, match="unknown key 'note'"):
            assert load_map(path).shape == (92, 122)
    assert not made.exists()


def test_a_key_that_stands_twice_is_named(room: Room) -> None:
    path = room()
    path.write_text(path.read_text() + "resolution: 0.2\n")
    assert_refused(path, "room.yaml", "'resolution' stands twice")


def test_a_name_that_no_line_can_hold_is_written_in_one(room: Room, tmp_path: Path) -> None:
    for name in ("two\nlines.yaml", "\x1b[31mred.yaml", "left\u202e.yaml"):
        path = room(resolution="0").rename(tmp_path / name)
        assert_refused(path, repr(name)[1:-1], "resolution")
        path = room(drop="origin").rename(tmp_path / name)
        assert_refused(path, repr(name)[1:-1], "origin: missing")
        (tmp_path / name).with_suffix(".map").write_text("type octile\nheight 0\nwidth 7\nmap\n")
        assert_refused((tmp_path / name).with_suffix(".map"), repr(name)[1:-6], "height")


def test_what_is_not_to_be_seen_in_a_file_is_not_in_the_refusal(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_bytes(b"\xef\xbb\xbfa: 1\n b: \xe2\x80\xae2\n")
    with pytest.raises(ValueError, match="not readable as YAML") as caught:
        load_map(tmp_path / "m.yaml")
    assert str(caught.value).isprintable()


def test_a_pipe_is_refused_and_not_waited_for(room: Room, tmp_path: Path) -> None:
    path = room()
    (tmp_path / "room.pgm").unlink()
    for name in ("room.pgm", "pipe.yaml", "pipe.map"):
        os.mkfifo(tmp_path / name)
    assert_refused(path, "image", "is a pipe")
    assert_refused(tmp_path / "pipe.yaml", "pipe.yaml: is a pipe")
    assert_refused(tmp_path / "pipe.map", "pipe.map: is a pipe")


def test_a_cell_too_small_to_reckon_with_is_refused_for_a_robot_of_no_size(room: Room) -> None:
    with pytest.raises(ValueError, match="from 1e-06 to 1000"):
        load_map(room(resolution="1e-320"), robot_radius=0.0)
    assert load_map(room(resolution="1e-6"), robot_radius=0.0).resolution == 1e-6


def test_a_bomb_of_aliases_is_not_unfolded(room: Room) -> None:
    levels = ["a: &a [1, 1]"] + [
        f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]"
        for old, new in zip("abcdefgh", "bcdefghi", strict=True)
    ]
    path = room()
    path.write_text("\n".join([*levels, path.read_text(), "spawn_points: *i"]))
    assert_refused(path, "spawn_points[0]")


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
        (b"no image at all", "PNG, PGM"),
        (b"GIF89a\x01\x00\x01\x00\x00\x00\x00;", "PNG, PGM"),
        (png_claiming(10, 10), "PNG, PGM"),
        (png_claiming(60_000, 60_000), "more pixels, expected at most 16777216"),
        (png_claiming(9_000, 8_000), "pixels"),
        (b"P5\n120 90\n255\n" + b"\xfe" * 500, "PNG, PGM"),
        (b"P5\n99999999 99999999\n255\n", "more pixels"),
        (b"P5\n12 9\n0\n" + b"\0" * 108, "PNG, PGM"),
        (b"P5\n12 9\n70000\n" + b"\0" * 216, "PNG, PGM"),
        (b"P5\n-3 9\n255\n", "PNG, PGM"),
        (b"P2\n3 2\n255\n1 2 x 4 5 6\n", "PNG, PGM"),
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


def test_too_many_pixels_are_refused_before_they_are_decoded(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(self: ImageFile.ImageFile) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(image_module, "MAX_CELLS", 120 * 90 - 1)
    monkeypatch.setattr(ImageFile.ImageFile, "load", decode)
    assert_refused(room(), "image", "120 x 90 pixels, expected at most 10799 cells")
    monkeypatch.setattr(image_module, "MAX_CELLS", 120 * 90)
    assert_refused(room(), "decoded")


def test_a_file_of_too_many_bytes_is_not_read(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    path = room()
    size = len(pgm_bytes(np.zeros((90, 120), dtype=np.uint8)))
    monkeypatch.setattr(image_module, "MAX_IMAGE_BYTES", size)
    assert load_map(path).shape == (92, 122)
    monkeypatch.setattr(image_module, "MAX_IMAGE_BYTES", size - 1)
    assert_refused(path, "image", f"1 to {size - 1} bytes, got {size}")


def test_a_text_image_made_of_comments_is_read_in_time(room: Room) -> None:
    # A decoder that takes them out one by one copies the rest of the file for each.
    body = b"#\n" * 1_000_000 + b"254 #\r\n" * 1200
    began = time.monotonic()
    assert load_map(room(image=b"P2\n60 20\n255\n" + body)).shape == (22, 62)
    assert time.monotonic() - began < 8


@pytest.mark.parametrize("radius", [-0.1, float("nan"), float("inf")])
def test_an_impossible_robot_is_refused(radius: float) -> None:
    with pytest.raises(ValueError, match="robot_radius"):
        load_map("maze", robot_radius=radius)
