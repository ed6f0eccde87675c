"""Readers of public benchmarks, on files made by hand and by arithmetic on paper."""

from __future__ import annotations

import io
import math
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sqn_jax.cli import main
from sqn_jax.maps import load_map
from sqn_jax.maps.occupancy import OccupancyMap, points_to_cells
from sqn_jax.tasks import Task, check_tasks, read_suite
from sqn_jax.tasks.barn import barn_score, read_barn
from sqn_jax.tasks.movingai import read_movingai
from sqn_jax.tasks.mrpb import read_mrpb


def occupied_at(occupancy_map: OccupancyMap, x: float, y: float) -> bool:
    """Whether a place in the map's frame lies in an obstacle."""
    row, column = points_to_cells(occupancy_map.to_grid_frame([x, y]), occupancy_map.resolution)
    return bool(occupancy_map.occupied[row, column])


# A map of 4 x 3 cells with a wall around: a corridor, and a way down at its east end.
SCEN = "version 1\n0\tsmall.map\t6\t5\t1\t1\t4\t3\t5.0\n1\tsmall.map\t6\t5\t4\t1\t1\t1\t3.0\n"
MAP = "type octile\nheight 5\nwidth 6\nmap\n@@@@@@\n@....@\n@@@@.@\n@@@@.@\n@@@@@@\n"


def movingai(folder: Path, scen: str = SCEN) -> Path:
    (folder / "small.map").write_text(MAP)
    (folder / "small.scen").write_text(scen)
    return folder / "small.scen"


def test_cells_of_a_scenario_count_from_the_upper_left(tmp_path: Path) -> None:
    (converted,) = read_movingai(movingai(tmp_path), resolution=0.5)
    # Cell (1, 1) of five rows: x = 1.5 x 0.5 m, y = (5 - 1 - 1 + 0.5) x 0.5 m.
    first, second = converted.tasks
    assert (first.start, first.goal) == ((0.75, 1.75), (2.25, 0.75))
    assert (second.start, second.goal) == ((2.25, 1.75), (0.75, 1.75))
    # Eight directions of a point are not the path of a robot.
    assert (first.heading, first.shortest_path) == (None, None)
    assert (first.max_steps, first.goal_radius) == (1200, 0.3)
    for free in (first.start, first.goal, second.start, (2.25, 1.25)):
        assert not occupied_at(converted.occupancy_map, *free)
    assert occupied_at(converted.occupancy_map, 0.75, 0.75)


def test_so_many_first_tasks_of_each_file_and_one_map_for_all(tmp_path: Path) -> None:
    movingai(tmp_path)
    (tmp_path / "more.scen").write_text(SCEN)
    (converted,) = read_movingai(tmp_path, first=1)
    assert [task.goal for task in converted.tasks] == [(2.25, 0.75)] * 2


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("version 1", "version 2", "line 1"),
        ("6\t5\t1\t1", "7\t5\t1\t1", r"line 2: a map of 7 x 5 .* has 6 x 5"),
        ("1\t1\t4\t3\t5.0", "1\t2\t4\t3\t5.0", r"line 2: start \(0\.75, 1\.25\) lies in an ob"),
        ("4\t3\t5.0", "6\t3\t5.0", r"line 2: goal \(6, 3\)"),
        ("5.0", "nan", "line 2.*optimal length"),
        ("small.map", "../../other.map", r"line 2: .*other\.map: no such file"),
        ("small.map", "passwd", r"line 2: 'passwd', expected the name of a \.map"),
        (SCEN.removeprefix("version 1\n"), "", "no tasks"),
    ],
)
def test_scenarios_of_another_map_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, words: str
) -> None:
    source = movingai(tmp_path, SCEN.replace(old, new))
    assert main(["tasks", "movingai", str(source), "--out", str(tmp_path / "out.json")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(words, line), line
    assert not list(tmp_path.glob("*out*")) + list(tmp_path.glob(".*"))


def world(*posts: tuple[float, float]) -> str:
    """A BARN world, each post in the world and in its state, among what else such a file holds."""
    models = "".join(
        f"<model name='unit_cylinder_{number}'><pose frame=''>{x} {y} 0 0 0 0</pose>"
        "<link name='link'><pose>9 9 0 0 0 0</pose></link></model>"
        for number, (x, y) in enumerate(posts)
    )
    ground = "<model name='ground_plane'><pose>0 0 0 0 0 0</pose></model>"
    return f"<sdf><world>{ground}{models}<state>{ground}{models}</state></world></sdf>"


def barn(folder: Path, text: str, path: bytes | None = None) -> Path:
    (folder / "world_7.world").write_text(text)
    if path is not None:
        (folder / "path_7.npy").write_bytes(path)
    return folder


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def test_posts_of_a_world_stand_where_it_says(tmp_path: Path) -> None:
    # The second column of the first row, and the last column of the last row.
    worlds, robot = read_barn(barn(tmp_path, world((-4.275, 0.075), (-0.075, 9.525))))
    (converted,) = worlds
    posts = converted.occupancy_map
    # 3 x 3 cells of 0.05 m around (-4.275, 0.075), and nothing next to them.
    for dx in (-0.06, 0.0, 0.06):
        for dy in (-0.06, 0.0, 0.06):
            assert occupied_at(posts, -4.275 + dx, 0.075 + dy)
            assert occupied_at(posts, -0.075 + dx, 9.525 + dy)
    for x, y in ((-4.36, 0.075), (-4.19, 0.075), (-4.275, 0.16), (-0.16, 9.525), (-0.075, 9.44)):
        assert not occupied_at(posts, x, y)
    # Inside 30 x 64 posts' places of 9 cells each, less the two posts.
    inside = posts.to_grid_frame([[-4.5, 0.0], [0.0, 9.6]]) / 0.05
    (left, bottom), (right, top) = inside.round().astype(int)
    assert (right - left, top - bottom) == (90, 192)
    assert posts.occupied[bottom:top, left:right].sum() == 18
    # Solid beside the box, open ground north of it, and a closed border.
    assert occupied_at(posts, -4.52, 9.5)
    assert occupied_at(posts, 0.02, 0.1)
    assert not any(occupied_at(posts, x, y) for x in (-5.5, -2.25, 1.0) for y in (9.62, 14.6))
    assert posts.occupied[[0, -1]].all()
    assert posts.occupied[:, [0, -1]].all()
    (task,) = converted.tasks
    assert task == Task("", (-2.25, 3.0), math.pi / 2, (-2.25, 13.0), 1000, 1.0, None)
    assert dict(robot) == {"robot_radius": 0.33, "forward_speed": 2.0, "time_step": 0.1}


def test_the_path_of_a_world_is_measured_from_start_to_goal(tmp_path: Path) -> None:
    # Steps (13, 0) and (23, 20): (-2.625, 5.075) and (-1.125, 8.075) m.
    steps = npy(np.array([[13, 0], [23, 20]]))
    worlds, _ = read_barn(barn(tmp_path, world((-4.275, 0.075)), steps))
    (task,) = next(worlds).tasks
    expected = math.hypot(0.375, 2.075) + math.hypot(1.5, 3.0) + math.hypot(1.125, 4.925)
    assert task.shortest_path == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "path", "words"),
    [
        ('<!DOCTYPE x [<!ENTITY a "aa">]>' + world((-4.275, 0.075)), None, "DOCTYPE"),
        ("<!DOCTYPE sdf>" + world((-4.275, 0.075)), None, "DOCTYPE"),
        ("<a>" * 200, None, "within each other"),
        (world((-4.275, 0.075))[:-3], None, "XML"),
        (world(), None, "no posts"),
        (world((-4.2, 0.075)), None, "lattice"),
        (world((-4.575, 0.075)), None, "lattice"),
        (world((float("nan"), 0.075)), None, "pose"),
        (world((-4.275, 0.075)), npy(np.zeros((3, 2))), "int64"),
        (world((-4.275, 0.075)), npy(np.zeros((3, 3), np.int64)), "int64"),
        (world((-4.275, 0.075)), npy(np.full((3, 2), -(2**63))), "lattice"),
        (world((-4.275, 0.075)), npy(np.array([[{}, 1]])), "int64"),
        (world((-4.275, 0.075)), b"\x80\x04N.", "int64"),
    ],
)
def test_a_world_that_cannot_be_used_is_one_line(
    tmp_path: Path, text: str, path: bytes | None, words: str
) -> None:
    worlds, _ = read_barn(barn(tmp_path, text, path))
    with pytest.raises(ValueError, match=r"(world_7\.world|path_7\.npy): ") as caught:
        list(worlds)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_path_that_claims_to_be_large_is_refused_before_it_is_made(tmp_path: Path) -> None:
    # The header keeps its length: the seven letters more replace some of the spaces behind it.
    honest, claim = b"(3, 2), }" + b" " * 7, b"(10000000, 2), }"
    path = npy(np.zeros((3, 2), np.int64))
    assert honest in path
    worlds, _ = read_barn(barn(tmp_path, world((-4.275, 0.075)), path.replace(honest, claim)))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"path_7\.npy: .*int64"):
            list(worlds)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 10_000_000  # The claim is 160 MB.


def test_the_score_of_barn() -> None:
    # A path of 10 m takes 5 s at best: 2 OT is 10 s, 8 OT 40 s.
    score = barn_score([1, 1, 1, 1, 0], [4.0, 10.0, 20.0, 100.0, 20.0], 10.0)
    np.testing.assert_allclose(score, [0.5, 0.5, 0.25, 0.125, 0.0])


TEST = (
    '<arg name="initial_pose_x" default="-9.25"/>\n<arg name="initial_pose_y" default="4.5"/>\n'
    '<arg name="initial_pose_a" default="0.0"/>\n<arg name="goal_pose_x" default="-8.5"/>\n'
    '<arg name="goal_pose_y" default="4.25"/>\n<arg name="goal_pose_a" default="3.0"/>\n'
)


def mrpb(folder: Path, config: str) -> Path:
    """30 x 20 pixels of 0.05 m from (-9.75, 3.75), one post at (-9.0, 4.0) alone."""
    folder.mkdir()
    gray = np.full((20, 30), 254, np.uint8)
    gray[[0, -1]] = gray[:, [0, -1]] = 0
    gray[20 - 1 - 5, 15] = 0  # x from -9.0, y from 4.0.
    Image.fromarray(gray).save(folder / "map.pgm")
    (folder / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.05\norigin: [-9.75, 3.75, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    (folder / "config.txt").write_text(config)
    return folder


@pytest.mark.parametrize("headings", ["random", "given"])
def test_a_test_of_mrpb_is_two_tasks(tmp_path: Path, headings: str) -> None:
    mrpb(tmp_path / "room", "# Test 1\n" + TEST + "# Test 2\n" + TEST.replace("4.25", "4.375"))
    out = tmp_path / "out.json"
    arguments = ["tasks", "mrpb", str(tmp_path), "--headings", headings, "--out", str(out)]
    assert main(arguments) == 0
    suite = read_suite(out)
    heading = {"random": None, "given": 0.0}[headings]
    map_file = str((tmp_path / "out_maps" / "room.yaml").resolve())
    forth = Task(map_file, (-9.25, 4.5), heading, (-8.5, 4.25), 1200, 0.3, None)
    back = Task(map_file, (-8.5, 4.25), None, (-9.25, 4.5), 1200, 0.3, None)
    assert suite.tasks[:2] == (forth, back)
    assert len(suite.tasks) == 4
    assert suite.tasks[2].goal == (-8.5, 4.375)
    assert (suite.name, suite.robot, suite.collision_ends) == ("out", (), False)
    check_tasks(suite, load_map)
    occupancy_map = load_map(map_file)
    assert occupied_at(occupancy_map, -8.975, 4.025)
    for x, y in ((-9.025, 4.025), (-8.925, 4.025), (-8.975, 3.975), (-8.975, 4.075)):
        assert not occupied_at(occupancy_map, x, y)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (TEST + TEST.replace('y" default="4.25', 'q" default="4.25'), "test 2: goal_pose_y: miss"),
        (TEST.replace("4.25", "nan"), "test 1: goal_pose_y: 'nan'"),
        (TEST.replace("4.25", "1e99"), "test 1: goal_pose_y: '1e99'"),
        (TEST.replace("4.25", "3.75"), "test 1: goal .*obstacle"),
        (TEST.replace("4.25", "99"), "test 1: goal .*outside"),
        (TEST + '<arg name="x"', "expected lines"),
        ("", "expected lines"),
    ],
)
def test_tests_that_cannot_be_used_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], config: str, words: str
) -> None:
    source = mrpb(tmp_path / "room", config)
    assert main(["tasks", "mrpb", str(source), "--out", str(tmp_path / "out.json")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(r"config\.txt: .*" + words.removeprefix("test"), line), line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["room"]


def test_a_folder_of_one_test_and_of_none(tmp_path: Path) -> None:
    (converted,) = read_mrpb(mrpb(tmp_path / "room", TEST))
    assert converted.occupancy_map.name == "room"
    with pytest.raises(ValueError, match="no MRPB tasks"):
        read_mrpb(tmp_path / "nothing")
