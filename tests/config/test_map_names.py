"""The text that names maps, and what it is parsed into."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.config.map_names import (
    KINDS,
    MAX_MAPS,
    MAX_SEED,
    MAX_WEIGHT,
    MapFile,
    MapSet,
    ProceduralMap,
    ProjectMap,
    parse,
)

# Characters that the grammar cares about come often.
PATH_TEXT = st.text(
    st.one_of(st.sampled_from(',:*" \\/.-0123"ayml'), st.characters(exclude_characters="\0")),
    min_size=1,
    max_size=12,
)
PATHS = st.one_of(PATH_TEXT, PATH_TEXT.map(lambda text: text + ".yaml"))
NAMES = st.one_of(
    st.from_regex(r"[a-z]\w{0,8}", fullmatch=True).map(ProjectMap),
    PATHS.map(MapFile),
    st.builds(MapFile, PATH_TEXT.map(lambda text: text + ".map"), st.floats(1e-6, 1e3)),
    st.builds(
        ProceduralMap,
        st.sampled_from(KINDS),
        st.one_of(st.integers(0, 6), st.integers(MAX_SEED - 2, MAX_SEED)),
    ),
)
MAP_SETS = st.lists(
    st.tuples(NAMES, st.one_of(st.integers(1, 2), st.integers(1, MAX_WEIGHT))),
    min_size=1,
    max_size=12,
    unique_by=lambda pair: pair[0],
).map(lambda pairs: MapSet(*(tuple(column) for column in zip(*pairs, strict=True))))


@given(MAP_SETS)
@example(MapSet((MapFile("a,b.yaml"), MapFile('"/c"'), MapFile("/d*3")), (1, 2, 1)))
@example(
    MapSet((MapFile("a.map@0.5"), MapFile("a.map", 0.5), MapFile("a,b.map", 1e-05)), (1, 2, 1))
)
@example(MapSet((MapFile(" a.yaml"), MapFile("maze"), MapFile("maze:7")), (1, 1, 1)))
@example(MapSet((MapFile("\ud800,.yaml"),), (1,)))
def test_the_text_of_maps_reads_as_the_same_maps(maps: MapSet) -> None:
    assert parse(str(maps)) == maps
    assert str(parse(str(maps))) == str(maps)
    for name in maps.names:
        assert parse(str(name)).names == (name,)


@given(st.text(st.sampled_from(',*:"\\ -019.maze/y\n'), max_size=20))
def test_text_is_refused_in_one_line_or_has_one_form(text: str) -> None:
    try:
        maps = parse(text)
    except ValueError as error:
        message = str(error)
    else:
        assert parse(str(maps)) == maps
        return
    assert re.fullmatch(r"(unknown )?map\b.*, expected .*|map .*: expected .*", message)


@pytest.mark.parametrize(
    ("text", "names", "canonical"),
    [
        ("maze", [ProjectMap("maze")], "maze"),
        ("maze:7", [ProceduralMap("maze", 7)], "maze:7"),
        ("maze:7-7", [ProceduralMap("maze", 7)], "maze:7"),
        ("maze:007", [ProceduralMap("maze", 7)], "maze:7"),
        ("maze:8-10", [ProceduralMap("maze", seed) for seed in (8, 9, 10)], "maze:8-10"),
        (
            "maze, column:1,column:2,x/y.yaml",
            [
                ProjectMap("maze"),
                ProceduralMap("column", 1),
                ProceduralMap("column", 2),
                MapFile("x/y.yaml"),
            ],
            "maze,column:1-2,x/y.yaml",
        ),
        ("a b.YML", [MapFile("a b.YML")], "a b.YML"),
        ("x:y.map", [MapFile("x:y.map")], "x:y.map"),
        (
            "x/y.map@0.50*3,maze",
            [MapFile("x/y.map", 0.5), ProjectMap("maze")],
            "x/y.map@0.5*3,maze",
        ),
        ('"a,b.map"@2', [MapFile("a,b.map", 2.0)], '"a,b.map"@2.0'),
        ('"a,b.yaml", maze', [MapFile("a,b.yaml"), ProjectMap("maze")], '"a,b.yaml",maze'),
        ("x" * 5000, [ProjectMap("x" * 5000)], "x" * 5000),
    ],
)
def test_a_text_stands_for_these_maps(
    text: str, names: list[ProjectMap | MapFile | ProceduralMap], canonical: str
) -> None:
    assert list(parse(text).names) == names
    assert str(parse(text)) == canonical


def test_weights_belong_to_the_maps_they_stand_behind() -> None:
    maps = parse("maze*8,maze:0-1*3,maze:2,maze:3, x/y.yaml*10")
    assert maps.weights == (8, 3, 3, 1, 1, 10)
    assert str(maps) == "maze*8,maze:0-1*3,maze:2-3,x/y.yaml*10"
    assert str(parse("maze*1,maze:2*2,maze:3")) == "maze,maze:2*2,maze:3"
    assert str(parse("maze:1,column:2,maze:4")) == "maze:1,column:2,maze:4"


@pytest.mark.parametrize("name", ["a,b.yaml", "a*2", "maze,maze:1", " c.yaml"])
def test_a_text_that_is_a_file_as_a_whole_is_that_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    assert parse(name).names == (MapFile(name),)
    assert parse(str(tmp_path / name)) == parse(tmp_path / name)
    (tmp_path / name).unlink()
    assert MapFile(name) not in parse("maze" if name == " c.yaml" else name.strip()).names


def test_a_file_does_not_hide_a_name_that_needs_no_splitting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("maze", "maze:7", "maze:1-2"):
        (tmp_path / name).touch()
        assert MapFile(name) not in parse(name).names


def test_files_that_exist_get_absolute_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.yaml").touch()
    resolved = parse("maze:1*2,a.yaml*3,b.yaml").resolved()
    assert str(resolved) == f"maze:1*2,{tmp_path}/a.yaml*3,b.yaml"


def test_folders_are_named_after_maps_without_their_folders() -> None:
    for text, stem in [
        ("maze*8,maze:0-14", "maze*8,maze:0-14"),
        ("/x/office.yaml", "office"),
        ("/x/office.yaml*3,y/hall.yaml", "office*3,hall"),
    ]:
        assert parse(text).stem == stem


def test_a_set_checks_itself_and_values_have_limits() -> None:
    maze = ProjectMap("maze")
    many = tuple(ProceduralMap("maze", seed) for seed in range(MAX_MAPS + 1))
    MapSet(many[:-1], (MAX_WEIGHT,) * MAX_MAPS)
    for make in (
        lambda: MapSet((), ()),
        lambda: MapSet((maze,), ()),
        lambda: MapSet((maze, maze), (1, 1)),
        lambda: MapSet((MapFile("a\nb/c"),) * 2, (1, 1)),
        lambda: MapSet((maze,), (0,)),
        lambda: MapSet((maze,), (MAX_WEIGHT + 1,)),
        lambda: MapSet(many, (1,) * len(many)),
        lambda: ProceduralMap("ocean", 1),
        lambda: ProceduralMap("maze", -1),
        lambda: ProceduralMap("maze", MAX_SEED + 1),
        lambda: ProjectMap("maze:7"),
        lambda: ProjectMap("a.yaml"),
        lambda: ProjectMap(" a"),
        lambda: ProjectMap(""),
        lambda: MapFile(""),
        lambda: MapFile("a.yaml", 0.5),
        lambda: MapFile("a.map", 0.0),
        lambda: parse("a.map@0"),
        lambda: parse("a.map@1e9"),
        lambda: parse("a.map@1.2.3"),
        lambda: parse("a.yaml@0.5"),
    ):
        with pytest.raises(ValueError, match=r"map.*expected"):
            make()


def test_settings_hold_one_text_for_equal_maps() -> None:
    written, canonical = (
        TrainConfig(map="maze*8, maze:0,maze:1"),
        TrainConfig(map="maze*8,maze:0-1"),
    )
    assert written == canonical
    assert hash(written) == hash(canonical)
    assert configs.to_dict(written)["map"] == "maze*8,maze:0-1"
    assert written.maps == parse("maze*8,maze:0-1")
    assert dataclasses.replace(written, map="cave").maps == parse("cave")


@pytest.mark.parametrize("text", ["ocean:3", "maze*0", "maze*101", "maze:3-1", "maze,maze", ""])
def test_settings_refuse_what_names_no_map(text: str) -> None:
    for make in (lambda: TrainConfig(map=text), lambda: configs.from_dict({"map": text})):
        with pytest.raises(ValueError, match=r"map.*expected"):
            make()


def test_a_file_of_settings_holds_readable_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a,b.yaml").touch()
    config = TrainConfig(map="a,b.yaml")
    configs.save(config, tmp_path / "config.json")
    (tmp_path / "a,b.yaml").unlink()  # What the text means does not hang on the file.
    assert json.loads((tmp_path / "config.json").read_text())["map"] == '"a,b.yaml"'
    assert configs.load(tmp_path / "config.json").maps.names == (MapFile("a,b.yaml"),)


def test_naming_maps_needs_no_numerical_library() -> None:
    code = "import sys, sqn_jax.config.map_names; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
