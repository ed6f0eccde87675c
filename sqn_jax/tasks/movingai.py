"""Tasks of the MovingAI benchmarks: scenario files (.scen) beside their maps (.map)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sqn_jax.config.groups import EnvConfig
from sqn_jax.config.map_names import MAX_RESOLUTION, MIN_RESOLUTION
from sqn_jax.maps.movingai import load_movingai
from sqn_jax.outside.messages import named, one_line
from sqn_jax.outside.reading import read_at_most
from sqn_jax.tasks.convert import ConvertedMap, by_number, finite_number
from sqn_jax.tasks.suite import DEFAULT_GOAL_RADIUS, DEFAULT_MAX_STEPS, MAX_TASKS, Task

DEFAULT_RESOLUTION = 0.5
"""m a cell; the files name no scale."""
_MAX_SCEN_BYTES = 64 * 2**20
_FIELDS = "bucket, map, width, height, start x, start y, goal x, goal y, optimal length"


@dataclass(frozen=True)
class _Scenario:
    """One line of a scenario file, in cells from the upper left corner."""

    size: tuple[int, int]
    start: tuple[int, int]
    goal: tuple[int, int]
    source: str

    def task(self, resolution: float) -> Task:
        """The same in m from the lower left corner, from center to center of the cells."""
        height = self.size[1]
        places = [
            ((x + 0.5) * resolution, (height - 1 - y + 0.5) * resolution)
            for x, y in (self.start, self.goal)
        ]
        # The optimal length is that of a point that moves in eight directions from center to
        # center: a robot may go straight, and has to keep clear of corners. It is not its path.
        return Task("", places[0], None, places[1], DEFAULT_MAX_STEPS, DEFAULT_GOAL_RADIUS, None)


def read_movingai(
    source: Path, *, resolution: float = DEFAULT_RESOLUTION, first: int | None = None
) -> Iterator[ConvertedMap]:
    """The tasks of a `.scen` file, or of all in a folder; maps are looked for beside them.

    Args:
        source: the file or folder.
        resolution: m a cell.
        first: so many tasks of each file; None: all.

    Raises:
        ValueError: one line that names the file and the line: a file that is damaged, or of
            another map.
    """
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        form = f"m a cell, from {MIN_RESOLUTION:g} to {MAX_RESOLUTION:g}"
        raise ValueError(f"resolution: {resolution!r}, expected {form}")
    if first is not None and first < 1:
        raise ValueError(f"first: {first}, expected at least 1")
    paths = sorted(source.glob("*.scen"), key=by_number) if source.is_dir() else [source]
    if not paths:
        raise ValueError(f"{named(source)}: no .scen file, expected one or a folder of them")
    by_map: dict[Path, list[_Scenario]] = {}
    count = 0
    for path in paths:
        for map_name, scenario in _read_scenarios(path, first):
            by_map.setdefault(path.parent / map_name, []).append(scenario)
            count += 1
            if count > MAX_TASKS:
                raise ValueError(f"{scenario.source}: more than {MAX_TASKS:,} tasks in all")
    return (_with_map(path, scenarios, resolution) for path, scenarios in by_map.items())


def _with_map(path: Path, scenarios: list[_Scenario], resolution: float) -> ConvertedMap:
    try:
        occupancy_map = load_movingai(
            path, robot_radius=EnvConfig.robot_radius, resolution=resolution
        )
    except ValueError as error:
        raise ValueError(f"{scenarios[0].source}: {error}") from None
    size = _size(path)
    for scenario in scenarios:
        if scenario.size != size:
            raise ValueError(
                f"{scenario.source}: a map of {scenario.size[0]} x {scenario.size[1]} cells, "
                f"{named(path)} has {size[0]} x {size[1]}"
            )
    tasks = [scenario.task(resolution) for scenario in scenarios]
    return ConvertedMap(occupancy_map, tasks, [scenario.source for scenario in scenarios])


def _size(path: Path) -> tuple[int, int]:
    """Width and height of a map that was read, as its file has them: cells."""
    with path.open("rb") as file:
        head = file.read(4096)
    found = {key: re.search(rb"%s\s+(\d+)" % key, head) for key in (b"width", b"height")}
    width, height = (int(match[1]) if match else 0 for match in found.values())
    return width, height


def _read_scenarios(path: Path, first: int | None) -> Iterator[tuple[str, _Scenario]]:
    """The name of the map and the task of each line."""
    data = read_at_most(path, _MAX_SCEN_BYTES, "MovingAI scenarios")
    lines = data.decode("utf-8", errors="replace").splitlines()
    if not lines or not re.fullmatch(r"version\s+1(\.0*)?\s*", lines[0]):
        shown = one_line(lines[0][:40]) if lines else ""
        raise ValueError(f"{named(path)}: line 1: {shown!r}, expected 'version 1'")
    count = 0
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        if first is not None and count == first:
            break
        count += 1
        yield _scenario(line, f"{named(path)}: line {number}")
    if count == 0:
        raise ValueError(f"{named(path)}: no tasks, expected lines of {_FIELDS}")


def _scenario(line: str, source: str) -> tuple[str, _Scenario]:
    fields = line.split("\t") if "\t" in line else line.split()
    fields = [field.strip() for field in fields]
    whole = [field for index, field in enumerate(fields) if index not in (1, 8)]
    length = finite_number(fields[8]) if len(fields) == 9 else None
    if (
        length is None
        or length < 0
        or not all(re.fullmatch(r"\d{1,8}", field, re.ASCII) for field in whole)
    ):
        raise ValueError(f"{source}: {one_line(line[:60])!r}, expected {_FIELDS}")
    # Files of the benchmark may name folders, which their maps no longer lie in.
    map_name = re.split(r"[/\\]", fields[1])[-1]
    if not map_name.lower().endswith(".map"):
        raise ValueError(f"{source}: {one_line(fields[1][:60])!r}, expected the name of a .map")
    _, width, height, x, y, goal_x, goal_y = (int(field) for field in whole)
    for name, cell in (("start", (x, y)), ("goal", (goal_x, goal_y))):
        if cell[0] >= width or cell[1] >= height:
            raise ValueError(
                f"{source}: {name} {cell}, expected a cell of the map's {width} x {height}"
            )
    return map_name, _Scenario((width, height), (x, y), (goal_x, goal_y), source)
