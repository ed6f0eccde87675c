"""The file of a suite: what it says, and that what it cannot mean is one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sqn_jax.config import EnvConfig
from sqn_jax.maps import OccupancyMap, save_map
from sqn_jax.tasks import Task, TaskSuite, check_tasks, read_suite, write_suite

TASK: dict[str, Any] = {"map": "maze:3", "start": [1, 2.5, None], "goal": [3, 4]}
SUITE: dict[str, Any] = {"schema": 1, "name": "two", "tasks": [TASK]}


def two_rooms(gap: bool) -> OccupancyMap:
    """3 x 2 m at 0.1 m a cell, lower left corner at (-1, 5), a wall with a gap or none at x = 0.5.

    The gap is 0.4 m wide, from y = 5.8 to 6.2.
    """
    occupied = np.ones((20, 30), dtype=bool)
    occupied[1:-1, 1:-1] = False
    occupied[:, 15] = True
    if gap:
        occupied[8:12, 15] = False
    points = np.array([[0.75, 1.05], [0.85, 1.05]])
    return OccupancyMap("rooms", occupied, 0.1, points, points, (-1.0, 5.0, 0.0), 0.1)


def written(folder: Path, contents: object) -> Path:
    """A file with a text or with JSON."""
    path = folder / "suite.json"
    path.write_text(contents if isinstance(contents, str) else json.dumps(contents))
    return path


def test_what_a_file_leaves_out_has_defaults(tmp_path: Path) -> None:
    suite = read_suite(written(tmp_path, SUITE))
    task = Task("maze:3", (1.0, 2.5), None, (3.0, 4.0), 1200, 0.3, None)
    assert suite == TaskSuite("two", (task,), (), False)


def test_what_is_written_is_read_back_and_the_folder_can_move(tmp_path: Path) -> None:
    (tmp_path / "here" / "maps").mkdir(parents=True)
    save_map(two_rooms(gap=True), tmp_path / "here" / "maps" / "a, b.yaml")
    file = str(tmp_path / "here" / "maps" / "a, b.yaml")
    tasks = (
        Task(file, (-0.5, 6.0), 1.25, (1.5, 6.0), 7, 0.5, 2.125),
        Task("cave", (0.1, 0.2), None, (0.3, 0.4), 100_000, 1e-6, None),
    )
    suite = TaskSuite("été", tasks, (("robot_radius", 0.25), ("num_beams", 36)), True)
    write_suite(tmp_path / "here" / "suite.json", suite)
    assert read_suite(tmp_path / "here" / "suite.json") == suite
    (tmp_path / "here").rename(tmp_path / "there")
    moved = read_suite(tmp_path / "there" / "suite.json")
    assert moved.tasks[0].map_file == file.replace("/here/", "/there/")
    assert suite.robot_of(EnvConfig()).robot_radius == 0.25


def of_task(**changes: object) -> dict[str, Any]:
    """A suite whose second task has something wrong."""
    return {**SUITE, "tasks": [TASK, {**TASK, **changes}]}


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        (of_task(max_step=5), ["tasks[1]", "did you mean max_steps"]),
        (of_task(map="../x.yaml"), ["tasks[1].map", "in the folder of this file"]),
        (of_task(map="/x.yaml"), ["tasks[1].map", "in the folder of this file"]),
        (of_task(map="x.yaml"), ["tasks[1].map", "no such file"]),
        (of_task(map="x\0.yaml"), ["tasks[1].map", "path"]),
        (of_task(map="x" * 5000 + "/y.yaml"), ["tasks[1].map", "too long"]),
        (of_task(map="labyrinth"), ["tasks[1].map", "cave, column, forest, maze"]),
        (of_task(map="maze:0-3"), ["tasks[1].map", "one map"]),
        (of_task(map="maze*2"), ["tasks[1].map", "one map"]),
        (of_task(map=7), ["tasks[1].map", "path"]),
        (of_task(start=[1, 2]), ["tasks[1].start", "heading"]),
        (of_task(start=[1, 2, "north"]), ["tasks[1].start[2]", "north"]),
        (of_task(goal=[1, float("nan")]), ["tasks[1].goal[1]", "nan"]),
        (of_task(goal=[float("inf"), 1]), ["tasks[1].goal[0]", "inf"]),
        (of_task(goal=[10**400, 1]), ["tasks[1].goal[0]", "from -1e+09"]),
        (of_task(goal=["1", 1]), ["tasks[1].goal[0]", "'1'"]),
        (of_task(goal=[True, 1]), ["tasks[1].goal[0]", "True"]),
        (of_task(max_steps=True), ["tasks[1].max_steps", "whole number"]),
        (of_task(max_steps=1e3), ["tasks[1].max_steps", "whole number"]),
        (of_task(goal_radius=0), ["tasks[1].goal_radius", "from 1e-06"]),
        (of_task(shortest_path=-1), ["tasks[1].shortest_path", "null or"]),
        ({**SUITE, "tasks": [{"map": "maze", "goal": [1, 2]}]}, ["tasks[0]", "start: missing"]),
        ({**SUITE, "tasks": []}, ["tasks", "100,000"]),
        ({**SUITE, "tasks": [0] * 100_001}, ["tasks", "100,000"]),
        ({**SUITE, "schema": 2}, ["schema", "2"]),
        ({**SUITE, "schema": True}, ["schema", "True"]),
        ({**SUITE, "name": "a\nb"}, ["name", "printed"]),
        ({**SUITE, "collision_ends": 0}, ["collision_ends", "true or false"]),
        ({**SUITE, "robot": {"robot_radus": 1}}, ["robot", "did you mean robot_radius"]),
        ({**SUITE, "robot": {"robot_radius": -1}}, ["robot.robot_radius", "positive"]),
        ({**SUITE, "robot": {"robot_radius": 1e300}}, ["robot.robot_radius", "100"]),
        ({**SUITE, "robot": {"num_beams": 2.5}}, ["robot.num_beams", "whole number"]),
        (json.dumps(SUITE).replace('"goal"', '"goal": [0, 0], "goal"'), ["tasks[0]", "twice"]),
        ("[" * 100_000, ["JSON"]),
        ('{"tasks": [' + "{}," * 200_000 + "{}]}", ["tasks", "100,000"]),
        ("\ud800".encode("utf-8", "surrogatepass").decode("latin-1"), ["JSON"]),
        ("7", ["mapping"]),
    ],
)
def test_a_file_that_cannot_be_used_is_one_line(
    tmp_path: Path, contents: object, words: list[str]
) -> None:
    path = written(tmp_path, contents)
    with pytest.raises(ValueError, match=r"suite\.json: ") as caught:
        read_suite(path)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < len(str(path)) + 600
    for word in words:
        assert word in message


def test_a_map_outside_is_read_where_that_is_allowed(tmp_path: Path) -> None:
    save_map(two_rooms(gap=True), tmp_path / "rooms.yaml")
    (tmp_path / "inner").mkdir()
    path = written(tmp_path / "inner", of_task(map="../rooms.yaml"))
    suite = read_suite(path, allow_outside=True)
    assert suite.tasks[1].map_file == str((tmp_path / "rooms.yaml").resolve())
    with pytest.raises(ValueError, match="in the folder of this file"):
        write_suite(tmp_path / "inner" / "other.json", suite)
    assert not (tmp_path / "inner" / "other.json").exists()


@pytest.mark.parametrize(
    ("gap", "radius", "start", "goal", "words"),
    [
        (True, 0.1, (-0.5, 6.0), (1.5, 6.0), None),
        (False, 0.1, (-0.5, 6.0), (1.5, 6.0), r"tasks\[2\]\.goal .*cannot be reached"),
        # Half of 0.4 m is too narrow for 0.25 m; by the centers of cells the limit is 0.15 m.
        (True, 0.25, (-0.5, 6.0), (1.5, 6.0), r"tasks\[2\]\.goal .*cannot be reached"),
        (True, 0.1, (0.55, 6.5), (1.5, 6.0), r"tasks\[2\]\.start .*lies in an obstacle"),
        (True, 0.1, (0.44, 6.5), (1.5, 6.0), r"tasks\[2\]\.start .*too near"),
        (True, 0.1, (-0.5, 6.0), (1.5, 7.1), r"tasks\[2\]\.goal .*lies outside"),
        # In the map's frame, not in that of the grid.
        (True, 0.1, (0.5, 1.0), (1.5, 6.0), r"tasks\[2\]\.start .*lies outside"),
    ],
)
def test_tasks_are_checked_on_each_map_once(
    gap: bool,
    radius: float,
    start: tuple[float, float],
    goal: tuple[float, float],
    words: str | None,
) -> None:
    loaded: list[str] = []

    def load(map_file: str) -> OccupancyMap:
        loaded.append(map_file)
        return two_rooms(gap)

    good = Task("a", (-0.5, 6.0), None, (-0.3, 6.5), 10, 0.3, None)
    tasks = (good, Task("b", *(good.start, None, good.goal), 10, 0.3, None))
    tasks += (Task("a", start, None, goal, 10, 0.3, None),)
    suite = TaskSuite("rooms", tasks, (("robot_radius", radius),))
    if words is None:
        check_tasks(suite, load)
        assert loaded == ["a", "b"]
    else:
        with pytest.raises(ValueError, match=words):
            check_tasks(suite, load)
