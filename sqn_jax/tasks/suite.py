"""A suite of tasks and its file: JSON that names maps, starts, goals, limits and the robot.

    {"schema": 1, "name": "two rooms",
     "tasks": [{"map": "rooms.yaml", "start": [1.0, 2.0, null], "goal": [7.5, 2.0]}]}

Maps are files in the suite's folder or below, named relative to it, or maps by name ("maze:3").
Places are in the map's frame, that of `origin`.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import reprlib
import typing
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from sqn_jax.config.groups import EnvConfig
from sqn_jax.config.map_names import FILE_SUFFIXES, MapFile, parse
from sqn_jax.maps.ros import MAX_PLACE, known_maps
from sqn_jax.outside.messages import named, one_line
from sqn_jax.outside.reading import read_at_most
from sqn_jax.storage.files import write_whole

SCHEMA = 1
MAX_TASKS = 100_000
MAX_FILE_BYTES = 64 * 2**20
MAX_STEPS = 100_000
MAX_LENGTH = 1e6  # m
MAX_BODY = 100.0  # m
MAX_NAME = 100  # letters
DEFAULT_MAX_STEPS = 1200
DEFAULT_GOAL_RADIUS = 0.3  # m

_INSIDE = (
    "a map in the folder of this file or below: copy it there, or allow maps outside where that is "
    "offered (sqn tasks check --allow-outside, read_suite(..., allow_outside=True))"
)
_KEYS = ("schema", "name", "tasks", "robot", "collision_ends")
_TASK_KEYS = ("map", "start", "goal", "max_steps", "goal_radius", "shortest_path")
_OF_A_TASK = ("max_steps", "goal_radius")
ROBOT_FIELDS = tuple(
    name
    for name, hint in typing.get_type_hints(EnvConfig).items()
    if hint in (int, float) and name not in _OF_A_TASK
)
"""Settings of `EnvConfig` that a suite can fix: numbers, but those that each task has itself."""


def steps_along(path_length: float) -> int:
    """Steps that a path of so many m takes at the full speed of our robot, without a turn."""
    return math.ceil(path_length / (EnvConfig.forward_speed * EnvConfig.time_step))


@dataclass(frozen=True)
class Task:
    """One start and one goal on a map."""

    map_file: str
    """A map by name ("maze", "maze:3"), or the absolute path of a map's file."""
    start: tuple[float, float]
    """x, y in m in the map's frame, that of `origin`."""
    heading: float | None
    """At the start, rad in the map's frame; None: drawn anew for each episode."""
    goal: tuple[float, float]
    """x, y in m in the map's frame."""
    max_steps: int
    """Length of an episode."""
    goal_radius: float
    """The goal counts as reached within this distance, m."""
    shortest_path: float | None
    """From start to goal for this robot, m; None: computed by the evaluation."""


@dataclass(frozen=True)
class TaskSuite:
    """Tasks that are evaluated together."""

    name: str
    tasks: tuple[Task, ...]
    robot: tuple[tuple[str, float], ...] = ()
    """Settings of `EnvConfig` by name (`ROBOT_FIELDS`) that this suite fixes."""
    collision_ends: bool = False
    """Whether a collision ends the episode as a failure; a move that a bumper stopped is none."""

    def robot_of(self, env_config: EnvConfig) -> EnvConfig:
        """A robot with what this suite fixes.

        Raises:
            ValueError: a setting is unknown or out of range.
        """
        for name, _ in self.robot:
            if name not in ROBOT_FIELDS:
                raise ValueError(_unknown(name, ROBOT_FIELDS))
        return dataclasses.replace(env_config, **typing.cast(Any, dict(self.robot)))


def read_suite(path: Path, *, allow_outside: bool = False) -> TaskSuite:
    """Read and check a suite; whether its tasks can be solved is up to `check_tasks`.

    Args:
        path: a file as the module describes.
        allow_outside: let the file name maps outside its own folder, by an absolute path or one
            that leads out of it.

    Raises:
        ValueError: one line that names the file, the task and the key, and what was expected.
    """
    path = Path(path)
    data = read_at_most(path, MAX_FILE_BYTES, "a suite of tasks")
    # A task has one pair of braces and two of brackets: what cannot be a suite is not taken apart.
    if data.count(b"{") > MAX_TASKS + 100 or data.count(b"[") > 2 * MAX_TASKS + 100:
        raise ValueError(f"{named(path)}: tasks: too many, expected at most {MAX_TASKS:,}")
    try:
        contents = json.loads(data.decode("utf-8"), object_pairs_hook=_mapping)
    except (ValueError, RecursionError) as error:
        reason = one_line(error)[:200]
        raise ValueError(f"{named(path)}: not valid JSON ({reason})") from None
    return _suite(contents, _Reader(path, allow_outside))


def write_suite(path: Path, suite: TaskSuite) -> None:
    """Write a suite, one task a line, as a whole or not at all; `read_suite` gives it back.

    Raises:
        ValueError: one line: `read_suite` would not take it (a map outside the file's folder, a
            number out of range), or the file cannot be written.
    """
    path = Path(path)
    folder = path.absolute().parent.resolve()
    tasks = [_task_entry(task, folder) for task in suite.tasks]
    head = {
        "schema": SCHEMA,
        "name": suite.name,
        "robot": dict(suite.robot),
        "collision_ends": suite.collision_ends,
    }
    _suite({**head, "tasks": tasks}, _Reader(path, allow_outside=False))
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}," for key, value in head.items()]
    text = ",\n".join("    " + json.dumps(task, allow_nan=False) for task in tasks)
    write_whole(path, "\n".join(["{", *lines, '  "tasks": [', text, "  ]", "}"]) + "\n")


def _task_entry(task: Task, folder: Path) -> dict[str, Any]:
    map_name = Path(task.map_file)
    if map_name.is_absolute() and map_name.is_relative_to(folder):
        # A name such as "maze" alone would be that of a map of the project.
        map_name = map_name.relative_to(folder)
    return {
        "map": map_name.as_posix(),
        "start": [*task.start, task.heading],
        "goal": [*task.goal],
        "max_steps": task.max_steps,
        "goal_radius": task.goal_radius,
        "shortest_path": task.shortest_path,
    }


class _Repeated(dict[str, Any]):
    """A mapping in which a key stood twice."""

    key = ""


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) == len(pairs):
        return mapping
    seen: set[str] = set()
    repeated = _Repeated(mapping)
    for key, _ in pairs:
        if key in seen:
            repeated.key = key
        seen.add(key)
    return repeated


def _unknown(key: str, known: Collection[str]) -> str:
    """What is said about an unknown key: the nearest known one, or all."""
    near = difflib.get_close_matches(key[:100], known, n=1)
    expected = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}"
    return f"{_shown(key)} is not known, {expected}"


def _shown(value: object) -> str:
    return one_line(reprlib.repr(value))[:100]


class _Reader:
    """Checks of values, which know the file they come from for their errors."""

    def __init__(self, path: Path, allow_outside: bool) -> None:
        self.path = path
        self.folder = path.absolute().parent.resolve()
        self.allow_outside = allow_outside
        self.maps: dict[str, str] = {}  # As it stands in the file -> `Task.map_file`.

    def fail(self, where: str, value: object, expected: str) -> NoReturn:
        raise ValueError(f"{named(self.path)}: {where}: {_shown(value)}, expected {expected}")

    def mapping(
        self, where: str, value: object, known: Iterable[str], required: Iterable[str]
    ) -> dict[str, Any]:
        """A mapping whose keys are known and stand once."""
        if not isinstance(value, dict):
            self.fail(where or "file", value, "a mapping of keys")
        prefix = f"{named(self.path)}: {where}: " if where else f"{named(self.path)}: "
        if isinstance(value, _Repeated):
            raise ValueError(f"{prefix}{_shown(value.key)} stands twice, expected every key once")
        for key in value:
            if key not in known:
                raise ValueError(f"{prefix}{_unknown(key, list(known))}")
        for key in required:
            if key not in value:
                raise ValueError(f"{prefix}{key}: missing, expected the keys {', '.join(required)}")
        return value

    def number(self, where: str, value: object, low: float, high: float, form: str) -> float:
        """A finite number from `low` to `high`."""
        if isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high:
            return float(value)
        self.fail(where, value, f"{form} from {low:g} to {high:g}")

    def whole_number(self, where: str, value: object, low: int, high: int) -> int:
        """A whole number from `low` to `high`, written as one."""
        if type(value) is int and low <= value <= high:
            return value
        self.fail(where, value, f"a whole number from {low} to {high}")

    def place(self, where: str, value: object, form: str) -> list[Any]:
        """A list that begins with x and y; numbers or null by the form `[x m, y m, ...]`."""
        count = form.count(",") + 1
        if not isinstance(value, list) or len(value) != count:
            self.fail(where, value, f"a list {form}")
        x, y = (
            self.number(f"{where}[{i}]", value[i], -MAX_PLACE, MAX_PLACE, "a number (m)")
            for i in range(2)
        )
        return [x, y, *value[2:]]

    def map_file(self, where: str, value: object) -> str:
        """A map that exists: by name, or the absolute path of its file."""
        if not isinstance(value, str) or not value:
            self.fail(where, value, "the path of a .yaml or .map file, or a map by name (maze:3)")
        if value not in self.maps:
            is_file = "/" in value or value.lower().endswith(FILE_SUFFIXES)
            self.maps[value] = (self._path if is_file else self._name)(where, value)
        return self.maps[value]

    def _name(self, where: str, value: str) -> str:
        try:
            maps = parse(value)
        except ValueError as error:
            raise ValueError(f"{named(self.path)}: {where}: {one_line(error)}") from None
        if len(maps.names) > 1 or maps.weights != (1,) or isinstance(maps.names[0], MapFile):
            self.fail(where, value, "one map alone")
        name = str(maps.names[0])
        if ":" not in name and name not in (known := known_maps()):
            form = f"a map of the project ({', '.join(known)}), KIND:SEED or the path of a file"
            self.fail(where, value, form)
        return name

    def _path(self, where: str, value: str) -> str:
        form = "the path of a .yaml or .map file"
        if not value.lower().endswith(FILE_SUFFIXES) or "\0" in value:
            self.fail(where, value, form)
        try:
            path = (self.folder / value).resolve()
            is_file = path.is_file()
        # Too long, a circle of links, or a character that no name of a file can hold.
        except (OSError, RuntimeError, ValueError) as error:
            reason = getattr(error, "strerror", None) or "no file can have this name"
            self.fail(where, value, f"{form} ({reason})")
        if not (self.allow_outside or path.is_relative_to(self.folder)):
            self.fail(where, value, _INSIDE)
        if not is_file:
            self.fail(where, value, f"{form} (no such file)")
        return str(path)


def _suite(contents: object, reader: _Reader) -> TaskSuite:
    fields = reader.mapping("", contents, _KEYS, ("schema", "name", "tasks"))
    schema = fields["schema"]
    if type(schema) is not int or schema != SCHEMA:
        reader.fail("schema", schema, f"{SCHEMA}, the only one that this version reads")
    name = fields["name"]
    if not (isinstance(name, str) and name.strip() and name.isprintable()) or len(name) > MAX_NAME:
        reader.fail("name", name, f"up to {MAX_NAME} letters that can be printed")
    collision_ends = fields.get("collision_ends", False)
    if not isinstance(collision_ends, bool):
        reader.fail("collision_ends", collision_ends, "true or false")
    entries = fields["tasks"]
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_TASKS:
        reader.fail("tasks", entries, f"a list of 1 to {MAX_TASKS:,} tasks")
    robot = _robot(fields.get("robot", {}), reader)
    tasks = tuple(_task(f"tasks[{index}]", entry, reader) for index, entry in enumerate(entries))
    return TaskSuite(name, tasks, robot, collision_ends)


def _robot(entry: object, reader: _Reader) -> tuple[tuple[str, float], ...]:
    fields = reader.mapping("robot", entry, ROBOT_FIELDS, ())
    hints = typing.get_type_hints(EnvConfig)
    robot: list[tuple[str, float]] = []
    for name, value in fields.items():
        where = f"robot.{name}"
        if hints[name] is int:
            robot.append((name, reader.whole_number(where, value, 0, 100_000)))
        else:
            most = MAX_BODY if name == "robot_radius" else MAX_LENGTH
            robot.append((name, reader.number(where, value, -MAX_LENGTH, most, "a number")))
    try:
        EnvConfig(**typing.cast(Any, dict(robot)))
    except ValueError as error:
        wrong = str(error).replace("env.", "robot.", 1)
        raise ValueError(f"{named(reader.path)}: {wrong}") from None
    return tuple(robot)


def _task(where: str, entry: object, reader: _Reader) -> Task:
    fields = reader.mapping(where, entry, _TASK_KEYS, ("map", "start", "goal"))
    *start, heading = reader.place(
        f"{where}.start", fields["start"], "[x m, y m, heading rad or null]"
    )
    if heading is not None:
        heading = reader.number(
            f"{where}.start[2]", heading, -MAX_PLACE, MAX_PLACE, "null or a number (rad)"
        )
    goal = reader.place(f"{where}.goal", fields["goal"], "[x m, y m]")
    shortest_path = fields.get("shortest_path")
    if shortest_path is not None:
        shortest_path = reader.number(
            f"{where}.shortest_path", shortest_path, 0.0, MAX_PLACE, "null or a number (m)"
        )
    return Task(
        map_file=reader.map_file(f"{where}.map", fields["map"]),
        start=(start[0], start[1]),
        heading=heading,
        goal=(goal[0], goal[1]),
        max_steps=reader.whole_number(
            f"{where}.max_steps", fields.get("max_steps", DEFAULT_MAX_STEPS), 1, MAX_STEPS
        ),
        goal_radius=reader.number(
            f"{where}.goal_radius",
            fields.get("goal_radius", DEFAULT_GOAL_RADIUS),
            1e-6,
            MAX_LENGTH,
            "a number (m)",
        ),
        shortest_path=shortest_path,
    )
