"""Maps by their names, one and several."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from map_files import write_room

from sqn_jax.config.map_names import MapFile, MapSet, ProceduralMap, ProjectMap, parse
from sqn_jax.maps import load_map
from sqn_jax.maps.generate import generate


def room_called(folder: Path, name: str) -> Path:
    """A room's YAML file by another name."""
    return write_room(folder, grey=np.full((60, 60), 254, dtype=np.uint8)).rename(folder / name)


@pytest.mark.parametrize("name", ["a,b.yaml", "a*2.yaml", "a:1.yaml", ' a b".yaml', '"a".yaml'])
def test_a_file_may_have_any_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = room_called(tmp_path, name)
    monkeypatch.chdir(tmp_path)
    for way in (str(path), name, path, Path(name), parse(path), MapFile(name), str(MapFile(name))):
        assert load_map(way).name == Path(name).stem
    with_others = load_map(f"{MapFile(name)}*2,{MapFile(str(write_room(tmp_path)))}")
    assert with_others.weights == (2, 1)


def test_weights_belong_to_the_maps_they_stand_behind() -> None:
    assert load_map("maze*8,maze:0-1*3").weights == (8, 3, 3)


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


def test_text_and_what_is_parsed_from_it_are_the_same_map() -> None:
    names = (ProjectMap("maze"), ProceduralMap("column", 3))
    text, value = load_map("maze*2,column:3"), load_map(MapSet(names, (2, 1)))
    assert (text.name, text.identity()) == (value.name, value.identity())
    assert load_map(names[1]).identity() == load_map("column:3").identity()


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("maze,", ["'maze,'", "missing"]),
        ("maze,maze", ["maze comes twice"]),
        ("maze:1,maze:0-3", ["maze:1 comes twice"]),
        ("maze,nowhere", ["'nowhere'", "maze"]),
        ("maze:5-3", ["'maze:5-3'", "backwards", "FIRST-LAST"]),
        ("maze:0-999999999", ["256"]),
        ("maze*0,maze:1", ["'maze*0'", "1 to 100"]),
        ("maze,maze:1-2*101", ["'maze:1-2*101'", "1 to 100"]),
        ("maze*8*8,maze:1", ["unknown map", "maze*8"]),
        ("maze*,maze:1", ["unknown map", "maze*"]),
        ("maze*2,maze", ["maze comes twice"]),
        ("maze:0-200,column:0-200", ["402 maps", "at most 256"]),
        ("maze:9999999999", ["expected seeds from 0 to 999999999"]),
        ("maze*1000000000", ["'maze*1000000000'", "1 to 100"]),
        ("maze*" + "9" * 5000, ["1 to 100"]),
        ("ocean:3", ["unknown map", "ocean:3"]),
        ("../maze:3", ["unknown map"]),
        ("maze:1-", ["unknown map", "maze:1-"]),
        ("ocean:1-2", ["unknown map", "ocean:1-2"]),
        ("x" * 5000, ["unknown map"]),
        ('"a"b,maze', ["unknown map", '"a"b']),
        ('"",maze', ["missing"]),
        ("", ["''", "missing"]),
    ],
)
def test_what_is_no_map_is_named_in_one_line(text: str, names: list[str]) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        load_map(text)
    assert "\n" not in str(caught.value)
    for name in names:
        assert name in str(caught.value)
