"""Tasks of BARN, the benchmark for autonomous robot navigation: worlds of posts, and its score.

A world is a box of 4.5 x 9.6 m in which posts stand on a lattice; the robot starts inside and
leaves it through the open north side.
"""

from __future__ import annotations

import io
import math
import typing
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sqn_jax.maps.files import named, one_line, read_at_most
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.tasks.convert import ConvertedMap, by_number, finite_number
from sqn_jax.tasks.suite import Task

ROBOT_RADIUS = 0.33  # m
SPEED = 2.0  # m/s
SECONDS = 100.0
GOAL_RADIUS = 1.0  # m
START, HEADING, GOAL = (-2.25, 3.0), math.pi / 2, (-2.25, 13.0)

_PITCH = 0.15  # m from post to post
_COLUMNS, _ROWS = 30, 64
_FIRST_POST = (-4.425, 0.075)  # m
_OFF_LATTICE = 0.01  # m
_RESOLUTION = 0.05  # m a cell
_POST_CELLS = 3
_BESIDE, _BEYOND = 50, 108  # cells west and east of the box, and open ones north of it
_PATH_ORIGIN = (-4.575, 5.075)  # m

_MAX_WORLD_BYTES = 20 * 10**6
_MAX_PATH_BYTES = 2**20
_MAX_DEPTH = 100


def read_barn(
    source: Path, *, robot_radius: float = ROBOT_RADIUS, time_step: float = 0.1
) -> tuple[Iterator[ConvertedMap], tuple[tuple[str, float], ...]]:
    """The worlds of a folder, `world_N.world`, with the organizers' paths, `path_N.npy`, if any.

    Args:
        source: the folder.
        robot_radius: m.
        time_step: s; 100 s of it are an episode.

    Returns:
        The maps with a task each, and the robot.

    Raises:
        ValueError: one line that names the file and what is wrong with it.
    """
    paths = sorted(source.glob("world_*.world"), key=by_number)
    if not paths:
        raise ValueError(f"{named(source)}: no BARN worlds, expected a folder of world_*.world")
    robot = (
        ("robot_radius", robot_radius),
        ("forward_speed", SPEED),
        ("time_step", time_step),
    )
    max_steps = round(SECONDS / time_step)
    return (_read_world(path, max_steps) for path in paths), robot


def barn_score(
    success: ArrayLike, seconds: ArrayLike, path_length: ArrayLike
) -> NDArray[np.float64]:
    """The score of episodes: success x OT / clip(AT, 2 OT, 8 OT), at most 0.5.

    Args:
        success: whether the goal was reached, without a collision before it.
        seconds: AT, the time it took.
        path_length: m, `Task.shortest_path`; at 2 m/s it takes OT, the best time.

    Returns:
        float64, of the shape that the arguments have together.
    """
    best = np.asarray(path_length, dtype=np.float64) / SPEED
    time = np.clip(np.asarray(seconds, dtype=np.float64), 2 * best, 8 * best)
    return np.asarray(success, dtype=np.float64) * best / time


def _read_world(path: Path, max_steps: int) -> ConvertedMap:
    posts = _read_posts(path)
    number = path.stem.removeprefix("world_")
    path_file = path.with_name(f"path_{number}.npy")
    length = _path_length(path_file) if path_file.exists() else None
    task = Task("", START, HEADING, GOAL, max_steps, GOAL_RADIUS, length)
    return ConvertedMap(world_map(path.stem, posts), [task], [named(path)])


def world_map(name: str, posts: set[tuple[int, int]]) -> OccupancyMap:
    """The box with its posts (column, row), solid ground around it and open ground north of it."""
    width, height = _COLUMNS * _POST_CELLS, _ROWS * _POST_CELLS
    occupied = np.ones((1 + height + _BEYOND + 1, width + 2 * _BESIDE), dtype=bool)
    occupied[1 + height : -1, 1:-1] = False
    box = np.zeros((_ROWS, _COLUMNS), dtype=bool)
    for column, row in posts:
        box[row, column] = True
    cells = box.repeat(_POST_CELLS, axis=0).repeat(_POST_CELLS, axis=1)
    occupied[1 : 1 + height, _BESIDE : _BESIDE + width] = cells
    west, south = (first - _PITCH / 2 for first in _FIRST_POST)
    origin = (round(west - _BESIDE * _RESOLUTION, 9), round(south - _RESOLUTION, 9), 0.0)
    places = np.array([START, GOAL]) - origin[:2]
    return OccupancyMap(name, occupied, _RESOLUTION, places, places, origin)


class _Posts:
    """What the parser of a world hands its parts to: collects the places of the posts.

    No tree is built; a world lists each post twice, in the world and in its state.
    """

    def __init__(self) -> None:
        self.places: dict[str, tuple[int, int]] = {}
        self._tags: list[str] = []
        self._post: str | None = None
        self._text: list[str] = []

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._tags.append(tag)
        if len(self._tags) > _MAX_DEPTH:
            raise ValueError(f"more than {_MAX_DEPTH} elements within each other")
        if tag == "model":
            name = attributes.get("name", "")
            self._post = name if name.startswith("unit_cylinder_") else None
        self._text = []

    def data(self, text: str) -> None:
        if self._post is not None and self._tags[-2:] == ["model", "pose"]:
            self._text.append(text)

    def end(self, tag: str) -> None:
        if self._post is not None and self._tags[-2:] == ["model", "pose"]:
            self._add(self._post, "".join(self._text))
        if tag == "model":
            self._post = None
        self._tags.pop()

    def close(self) -> set[tuple[int, int]]:
        return set(self.places.values())

    def _add(self, name: str, pose: str) -> None:
        numbers = [finite_number(number) for number in pose.split()[:2]]
        if len(numbers) != 2 or None in numbers:
            raise ValueError(f"{name[:40]}: pose {pose[:40]!r}, expected x m, y m, ...")
        cell = []
        for number, first, count in zip(numbers, _FIRST_POST, (_COLUMNS, _ROWS), strict=True):
            assert number is not None
            place = (number - first) / _PITCH
            index = round(place) if abs(place) < 1e6 else -1
            if not 0 <= index < count or abs(place - index) * _PITCH > _OFF_LATTICE:
                raise ValueError(
                    f"{name[:40]}: pose {pose[:40]!r}, expected a place of BARN's lattice, x from "
                    f"-4.425 to -0.075 and y from 0.075 to 9.525 in steps of {_PITCH} m"
                )
            cell.append(index)
        self.places[name] = (cell[0], cell[1])


def _read_posts(path: Path) -> set[tuple[int, int]]:
    """The posts (column, row) of a world."""
    data = read_at_most(path, _MAX_WORLD_BYTES, "a BARN world")
    try:
        text = data.decode("utf-8")
        upper = text.upper()
        # Text that stands for other text can be small and mean gigabytes, or other files.
        if "<!DOCTYPE" in upper or "<!ENTITY" in upper:
            raise ValueError("declares entities (DOCTYPE), which no BARN world does")
        parser = ElementTree.XMLParser(target=_Posts())
        parser.feed(text)
        posts = typing.cast(set[tuple[int, int]], parser.close())
    except ElementTree.ParseError as error:
        raise ValueError(f"{named(path)}: not readable as XML ({one_line(error)[:200]})") from None
    except ValueError as error:
        raise ValueError(f"{named(path)}: {one_line(error)[:300]}") from None
    if not posts:
        raise ValueError(f"{named(path)}: no posts, expected models unit_cylinder_*")
    return posts


def _path_length(path: Path) -> float:
    """Length in m of the organizers' path, from the start to the goal."""
    form = "a NumPy file of whole numbers, int64 [N, 2], steps of a BARN path"
    data = read_at_most(path, _MAX_PATH_BYTES, form)
    stream = io.BytesIO(data)
    try:
        # The header first: an array as large as it may claim is not made.
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("another version of the format")
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
        if dtype != np.int64 or len(shape) != 2 or shape[1] != 2:
            raise ValueError(f"{dtype} {list(shape)}"[:100])
        if shape[0] * 16 != len(data) - stream.tell():
            raise ValueError(f"{len(data)} bytes")
        steps = np.load(io.BytesIO(data), allow_pickle=False)
    # What is said about a damaged header may be of several kinds and many lines.
    except Exception as error:
        raise ValueError(f"{named(path)}: {one_line(error)[:100]}, expected {form}") from None
    if np.abs(steps.clip(-1000, 1000)).max(initial=0) >= 1000:
        raise ValueError(f"{named(path)}: steps off BARN's lattice, expected {form}")
    points = np.concatenate([[START], steps * _PITCH + np.array(_PATH_ORIGIN), [GOAL]])
    return float(np.hypot(*np.diff(points, axis=0).T).sum())
