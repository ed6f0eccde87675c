"""The text maps of the MovingAI benchmarks."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from sqn_jax.maps import load_map

SOUND = "type octile\nheight 5\nwidth 7\nmap\nTTTTTTT\n@....W@\n@GSO..@\n@.....@\n@@@@@@@\n"


def test_letters_become_cells_with_the_last_line_at_the_bottom(tmp_path: Path) -> None:
    path = tmp_path / "small.map"
    path.write_bytes(SOUND.replace("\n", "\r\n").encode())
    loaded = load_map(path)
    expected = ["1111111", "1000001", "1001001", "1000011", "1111111"]
    assert ["".join("01"[int(cell)] for cell in row) for row in loaded.occupied] == expected
    assert (loaded.name, loaded.resolution, loaded.size_m) == ("small", 1.0, (7.0, 5.0))
    assert loaded.occupied.dtype == np.bool_


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("octile", "tile", "octile"),
        ("height 5", "height five", "height"),
        ("height 5", "height", "line 2"),
        ("width 7", "width 0", "width"),
        ("width 7", "width 8", "5 lines of 8"),
        ("width 7", "width 3\n", "header"),
        ("height 5\nwidth 7", "height 9000\nwidth 9000", "9000 x 9000 cells"),
        ("height 5", "height 6", "6 lines of 7"),
        ("map\n", "", "header"),
        ("GSO", "GxO", "letter"),
        ("@GSO..@\n", "@GSO.@\n", "lines of 7"),
        ("@GSO..@\n", "@GSO..@.\n", "lines of 7"),
        ("@GSO..@\n", "@GS\n..@\n", "lines of 7"),
        ("@GSO..@\n", "@GSO..@@", "lines of 7"),
        ("@GSO..@\n", "@GSO..@\n\n", "lines of 7"),
        (SOUND, "", "header"),
        (".", "@", "no free space"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "bad.map"
    text = SOUND.replace(old, new)
    path.write_text(text.replace("G", "@").replace("S", "@") if words == "no free space" else text)
    with pytest.raises(ValueError, match=r"bad\.map: ") as caught:
        load_map(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_the_last_line_need_not_end_and_what_follows_is_left_out(tmp_path: Path, end: str) -> None:
    path = tmp_path / "small.map"
    path.write_bytes(SOUND.replace("\n", end).encode())
    whole = load_map(path).occupied
    for text in (SOUND.rstrip("\n"), SOUND + "\n\n", SOUND + "more\n" * 9):
        path.write_bytes(text.replace("\n", end).encode())
        np.testing.assert_array_equal(load_map(path).occupied, whole)


def test_a_file_of_nothing_but_line_ends_needs_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "lines.map"
    path.write_bytes(b"type octile\nheight 9\nwidth 9\nmap\n" + b"ab\n" * 700_000)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="9 lines of 9 letters"):
            load_map(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # The file's bytes, a few times over; as 700,000 lines they would take thirty million.
    assert peak < 12_000_000


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        load_map(tmp_path / "absent.map")


def test_a_scale_behind_the_name_is_that_of_the_cells(tmp_path: Path) -> None:
    path = tmp_path / "small.map"
    path.write_text(SOUND)
    loaded, plain = load_map(f"{path}@0.25"), load_map(path)
    assert (loaded.resolution, loaded.size_m, loaded.name) == (0.25, (1.75, 1.25), "small")
    np.testing.assert_array_equal(loaded.occupied, plain.occupied)


def test_doors_in_the_outermost_cells_stay_open(tmp_path: Path) -> None:
    # Three rooms that only the outermost cells join.
    rows = [".......", ".@@@@@.", "...@...", ".@@@@@.", "......."]
    path = tmp_path / "ring.map"
    path.write_text("\n".join(["type octile", "height 5", "width 7", "map", *rows]))
    loaded = load_map(path)
    drawn = np.array([[letter == "@" for letter in row] for row in rows[::-1]])
    np.testing.assert_array_equal(loaded.occupied[1:-1, 1:-1], drawn)
    assert loaded.occupied.sum() == drawn.sum() + 2 * 9 + 2 * 5
    # The lower left corner of the file's map stays the origin of its frame.
    np.testing.assert_allclose(loaded.to_grid_frame([0.0, 0.0]), [1.0, 1.0])
