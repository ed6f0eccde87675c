"""Tasks of MRPB, the mobile robot local planning benchmark: a map, and poses in a `config.txt`."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from sqn_jax.maps.files import named, read_at_most
from sqn_jax.maps.load import load_map
from sqn_jax.maps.ros import MAX_PLACE
from sqn_jax.tasks.convert import ConvertedMap, by_number, finite_number
from sqn_jax.tasks.suite import DEFAULT_GOAL_RADIUS, DEFAULT_MAX_STEPS, Task

CONFIG, MAP = "config.txt", "map.yaml"
_MAX_CONFIG_BYTES = 2**20
_ARGUMENT = re.compile(
    r"""<arg\s+name\s*=\s*["']([^"'<>]*)["']\s+default\s*=\s*["']([^"'<>]*)["']\s*/>"""
)
_KEYS = ("initial_pose_x", "initial_pose_y", "initial_pose_a", "goal_pose_x", "goal_pose_y")

Headings = Literal["random", "given"]


def read_mrpb(source: Path, *, headings: Headings = "random") -> Iterator[ConvertedMap]:
    """The tasks of a folder with `map.yaml` and `config.txt`, or of a folder of such folders.

    Each test is two tasks: from its initial pose to its goal, and back.

    Args:
        source: the folder.
        headings: "random": drawn anew for each episode; "given": `initial_pose_a` on the way to
            the goal. The benchmark gives none for the way back: there it is drawn.

    Raises:
        ValueError: one line that names the file and the test.
    """
    if (source / CONFIG).exists() or (source / MAP).exists():
        folders = [source]
    else:
        folders = sorted((path.parent for path in source.glob(f"*/{CONFIG}")), key=by_number)
    if not folders:
        raise ValueError(
            f"{named(source)}: no MRPB tasks, expected a folder with {MAP} and {CONFIG}, or a "
            "folder of such folders"
        )
    return (_read_folder(folder, headings) for folder in folders)


def _read_folder(folder: Path, headings: Headings) -> ConvertedMap:
    config = folder / CONFIG
    tests = _read_tests(config)
    occupancy_map = dataclasses.replace(load_map(folder / MAP), name=folder.resolve().name)
    tasks: list[Task] = []
    sources: list[str] = []
    for number, test in enumerate(tests, 1):
        x, y, heading, goal_x, goal_y = (test[key] for key in _KEYS)
        given = heading if headings == "given" else None
        for start, at_start, goal in (
            ((x, y), given, (goal_x, goal_y)),
            ((goal_x, goal_y), None, (x, y)),
        ):
            tasks.append(
                Task("", start, at_start, goal, DEFAULT_MAX_STEPS, DEFAULT_GOAL_RADIUS, None)
            )
            sources.append(f"{named(config)}: test {number}")
    return ConvertedMap(occupancy_map, tasks, sources)


def _read_tests(path: Path) -> list[dict[str, float]]:
    """The numbers of each test by their names; a name that comes again begins the next test."""
    data = read_at_most(path, _MAX_CONFIG_BYTES, "the tasks of an MRPB map")
    text = data.decode("utf-8", errors="replace")
    arguments = _ARGUMENT.findall(text)
    if not arguments or len(arguments) != text.count("<arg"):
        raise ValueError(
            f'{named(path)}: expected lines <arg name="initial_pose_x" default="1.5"/>, in each '
            f"test {', '.join(_KEYS)}"
        )
    tests: list[dict[str, float]] = [{}]
    for name, value in arguments:
        if name not in _KEYS:
            continue
        if name in tests[-1]:
            tests.append({})
        number = finite_number(value.strip())
        if number is None or abs(number) > MAX_PLACE:
            raise ValueError(
                f"{named(path)}: test {len(tests)}: {name}: {value[:40]!r}, expected a number of m "
                f"or rad from {-MAX_PLACE:g} to {MAX_PLACE:g}"
            )
        tests[-1][name] = number
    for index, test in enumerate(tests, 1):
        for name in _KEYS:
            if name not in test:
                raise ValueError(
                    f"{named(path)}: test {index}: {name}: missing, expected {', '.join(_KEYS)}"
                )
    return tests
