"""The words a user writes for maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from map_files import write_room

from sqn_jax.maps import load_map, split_names, weighted_names
from sqn_jax.maps.generate import generate


@pytest.mark.parametrize(
    ("word", "names"),
    [
        ("maze", ["maze"]),
        ("maze:7", ["maze:7"]),
        ("maze:7-7", ["maze:7"]),
        ("maze:8-10", ["maze:8", "maze:9", "maze:10"]),
        ("maze, column:1-2,x/y.yaml", ["maze", "column:1", "column:2", "x/y.yaml"]),
        ("ocean:1-2", ["ocean:1-2"]),
        ("maze:1-", ["maze:1-"]),
        ("x" * 5000, ["x" * 5000]),
    ],
)
def test_a_word_stands_for_these_maps(word: str, names: list[str]) -> None:
    assert split_names(word) == names


def test_a_file_may_have_a_comma_in_its_name(tmp_path: Path) -> None:
    grey = np.full((60, 60), 254, dtype=np.uint8)
    path = write_room(tmp_path, grey=grey).rename(tmp_path / "a,b.yaml")
    assert split_names(str(path)) == [str(path)]
    assert load_map(str(path)).name == "a,b"


def test_weights_belong_to_the_maps_they_stand_behind(tmp_path: Path) -> None:
    word = "maze*8,maze:0-1*3,cave:2, x/y.yaml*10"
    expected = {"maze": 8, "maze:0": 3, "maze:1": 3, "cave:2": 1, "x/y.yaml": 10}
    assert dict(weighted_names(word)) == expected
    assert split_names(word) == list(expected)
    assert load_map("maze*8,maze:0-1*3").weights == (8, 3, 3)
    starred = write_room(tmp_path, grey=np.full((60, 60), 254, dtype=np.uint8))
    starred = starred.rename(tmp_path / "a*2")
    assert weighted_names(str(starred)) == [(str(starred), 1)]


def test_weights_tell_one_training_from_another() -> None:
    """A run on other weights is another run; weights of 1 are none."""
    plain, same, other = (load_map(f"maze{w},maze:0").identity() for w in ("", "*1", "*2"))
    assert plain == same
    assert plain["contents"] != other["contents"]


def test_a_procedural_map_is_that_of_its_seed() -> None:
    for kind in ("maze", "column", "forest"):
        found, made = load_map(f"{kind}:12"), generate(kind, 12)
        np.testing.assert_array_equal(found.occupied, made.occupied)
        np.testing.assert_array_equal(found.spawn_points, made.spawn_points)
        assert found.name == f"{kind}:12"


def test_several_lie_side_by_side() -> None:
    found = load_map("maze,maze:0-2")
    assert found.tiles == (2, 2)
    np.testing.assert_array_equal(found.occupied[:340, :340], load_map("maze").occupied)
    np.testing.assert_array_equal(found.occupied[340:, 340:], generate("maze", 2).occupied)


@pytest.mark.parametrize(
    ("word", "names"),
    [
        ("maze,", ["'maze,'", "missing"]),
        ("maze,maze", ["maze comes twice"]),
        ("maze:1,maze:0-3", ["maze:1 comes twice"]),
        ("maze,nowhere", ["'nowhere'", "maze"]),
        ("maze:5-3", ["'maze:5-3'", "FIRST-LAST"]),
        ("maze:0-999999999", ["256"]),
        ("maze*0,maze:1", ["'maze*0'", "1 to 100"]),
        ("maze,maze:1-2*101", ["'maze:1-2*101'", "1 to 100"]),
        ("maze*8*8,maze:1", ["unknown map", "maze*8"]),
        ("maze*,maze:1", ["unknown map", "maze*"]),
        ("maze*2,maze", ["maze comes twice"]),
        ("maze:0-200,column:0-200", ["402 maps", "at most 256"]),
        ("maze:9999999999", ["unknown map"]),
        ("ocean:3", ["unknown map", "ocean:3"]),
        ("../maze:3", ["unknown map"]),
        ("", ["unknown map"]),
    ],
)
def test_what_is_no_map_is_named_in_one_line(word: str, names: list[str]) -> None:
    with pytest.raises(ValueError, match=r".") as told:
        load_map(word)
    assert "\n" not in str(told.value)
    for name in names:
        assert name in str(told.value)
