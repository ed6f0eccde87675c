"""From tasks read elsewhere to a folder of our own: the suite, and its maps beside it.

The readers of benchmarks give a `ConvertedMap` at a time. Each is checked and its map written under
a hidden name; only when all are sound do files appear under their own.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sqn_jax.config.groups import EnvConfig
from sqn_jax.maps.files import named
from sqn_jax.maps.occupancy import (
    EVALUATION_COUNT,
    OccupancyMap,
    cells_to_points,
    connected_components,
    points_to_cells,
    traversable,
)
from sqn_jax.maps.ros import save_map
from sqn_jax.storage.files import NotWritten, probe_writable
from sqn_jax.tasks.check import first_unsolvable
from sqn_jax.tasks.suite import MAX_NAME, MAX_TASKS, Task, TaskSuite, write_suite

_MAX_SPAWN_POINTS = 100


@dataclass(frozen=True)
class ConvertedMap:
    """A map with its tasks, in the map's frame."""

    occupancy_map: OccupancyMap
    """Its name becomes that of its file; its points are not used."""
    tasks: Sequence[Task]
    """At least one; their `map_file` is not used."""
    sources: Sequence[str]
    """What errors call each of them: file and line, say."""


def finite_number(text: str) -> float | None:
    """A number as text, or None: `float` alone would take "nan", "1_000" and other digits too."""
    if re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text, re.ASCII):
        number = float(text)
        return number if math.isfinite(number) else None
    return None


def by_number(path: Path) -> list[str | int]:
    """A sort key for names with numbers: world_2 before world_10."""
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)]


def require_output(out: Path) -> None:
    """Check where a suite is to go, before anything is read.

    Raises:
        ValueError: one line: the name does not end in .json, or nothing can be written there.
    """
    if out.suffix != ".json" or not out.stem.isprintable() or len(out.stem) > MAX_NAME:
        form = f"a file ending in .json, of up to {MAX_NAME} letters that can be printed"
        raise ValueError(f"--out is {named(out)}, expected {form}")
    if not out.absolute().parent.is_dir() or out.is_dir():
        raise ValueError(f"--out {named(out)}: expected a file in an existing folder")
    try:
        probe_writable(out.absolute().parent)
    except OSError as error:
        raise ValueError(f"--out {named(out)}: cannot be written ({error.strerror})") from None


def write_converted(
    out: Path,
    converted: Iterable[ConvertedMap],
    *,
    robot: tuple[tuple[str, float], ...] = (),
    collision_ends: bool = False,
) -> TaskSuite:
    """Check tasks and write them: `NAME.json` and its maps in `NAME_maps/`, all or nothing.

    Maps of that folder with the same names are replaced, others stay.

    Raises:
        ValueError: one line that names the source of a task that cannot be solved, and why; or the
            files cannot be written.
    """
    out = out.absolute().resolve()
    suite = TaskSuite(out.stem, (), robot, collision_ends)
    robot_radius = suite.robot_of(EnvConfig()).robot_radius
    folder = out.with_name(f"{out.stem}_maps")
    tasks: list[Task] = []
    with _moved_when_whole(folder) as partial:
        names: set[str] = set()
        for part in converted:
            name = part.occupancy_map.name
            if name in names:
                raise ValueError(f"{part.sources[0]}: a second map {name}, expected names once")
            names.add(name)
            if len(tasks) + len(part.tasks) > MAX_TASKS:
                raise ValueError(f"{part.sources[0]}: more than {MAX_TASKS:,} tasks in all")
            starts = np.array([task.start for task in part.tasks])
            goals = np.array([task.goal for task in part.tasks])
            wrong = first_unsolvable(part.occupancy_map, starts, goals, robot_radius)
            if wrong is not None:
                raise ValueError(f"{part.sources[wrong[0]]}: {wrong[1]}")
            max_steps = max(task.max_steps for task in part.tasks)
            points = _spawn_points(part.occupancy_map, starts, goals, robot_radius)
            own = dataclasses.replace(
                part.occupancy_map,
                spawn_points=points,
                evaluation_points=points[:EVALUATION_COUNT],
                max_steps=max_steps,
            )
            save_map(own, partial / f"{name}.yaml")
            map_file = str(folder / f"{name}.yaml")
            tasks += [dataclasses.replace(task, map_file=map_file) for task in part.tasks]
    suite = dataclasses.replace(suite, tasks=tuple(tasks))
    write_suite(out, suite)
    return suite


def _spawn_points(
    occupancy_map: OccupancyMap,
    starts: NDArray[np.float64],
    goals: NDArray[np.float64],
    robot_radius: float,
) -> NDArray[np.float64]:
    """Where else episodes could start and end on the map: the places of the tasks, [2 to S, 2].

    Those that the first start reaches, as centers of their cells, in the grid frame.
    """
    resolution = occupancy_map.resolution
    places = np.stack([starts, goals], axis=1).reshape(-1, 2)
    cells = points_to_cells(occupancy_map.to_grid_frame(places), resolution)
    labels, _ = connected_components(traversable(occupancy_map.occupied, resolution, robot_radius))
    of_cells = labels[cells[:, 0], cells[:, 1]]
    cells = cells[of_cells == of_cells[0]]
    _, firsts = np.unique(cells, axis=0, return_index=True)
    selected = cells[np.sort(firsts)[:_MAX_SPAWN_POINTS]]
    return cells_to_points(np.resize(selected, (max(2, len(selected)), 2)), resolution)


@contextmanager
def _moved_when_whole(folder: Path) -> Iterator[Path]:
    """A hidden folder to write files to, which move to `folder` at the end or vanish."""
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir()
        yield partial
        folder.mkdir(exist_ok=True)
        for file in sorted(partial.iterdir()):
            file.replace(folder / file.name)
    except OSError as error:
        raise NotWritten(folder, error) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
