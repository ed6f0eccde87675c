"""Maps by the words a user writes: names, files, procedural ones, and several at once.

maze                  a map of the project
folder/my_map.yaml    a file
maze:7                the procedural maze that belongs to seed 7 (`generate`)
maze,maze:0-14        sixteen maps side by side, to train on all of them (`side_by_side`)
maze*8,maze:0-14      the same, with eight times as many tasks on the first as on each other
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

from sqn_jax.maps.atlas import side_by_side
from sqn_jax.maps.generate import KINDS, generate
from sqn_jax.maps.occupancy import OccupancyMap, validate
from sqn_jax.maps.ros import DEFAULT_ROBOT_RADIUS, load_map_file

MAX_MAPS = 256
"""How many can be laid side by side."""

MAX_WEIGHT = 100
"""How many times as many tasks as on another a map can have."""

_WEIGHED = re.compile(r"(.+)\*(\d{1,9})")
_PROCEDURAL = re.compile(rf"({'|'.join(KINDS)}):(\d{{1,9}})(?:-(\d{{1,9}}))?")


def weighted_names(word: str | Path) -> list[tuple[str, int]]:
    """The maps that a word stands for, each by a word of its own, and their weights.

    Raises:
      ValueError: a range of seeds that runs backwards, a weight out of range, or more maps than
        `MAX_MAPS`.

    Example:
        >>> weighted_names("maze*8,maze:0-1")
        [('maze', 8), ('maze:0', 1), ('maze:1', 1)]
    """
    if isinstance(word, Path) or _is_file(word):  # Its name may hold a comma.
        return [(str(word), 1)]
    names: list[tuple[str, int]] = []
    for part in (part.strip() for part in word.split(",")):
        weighed = _WEIGHED.fullmatch(part)
        name, weight = (weighed.group(1), int(weighed.group(2))) if weighed else (part, 1)
        if not 1 <= weight <= MAX_WEIGHT:
            raise ValueError(f"map {part!r}: expected a weight from 1 to {MAX_WEIGHT}")
        found = _PROCEDURAL.fullmatch(name)
        if found is None or found.group(3) is None:
            names.append((name, weight))
        else:
            kind, first, last = found.group(1), int(found.group(2)), int(found.group(3))
            if not first <= last < first + MAX_MAPS:
                raise ValueError(f"map {part!r}: expected up to {MAX_MAPS} seeds, FIRST-LAST")
            names += [(f"{kind}:{seed}", weight) for seed in range(first, last + 1)]
    if len(names) > MAX_MAPS:
        raise ValueError(f"map {word[:80]!r}: {len(names)} maps, expected at most {MAX_MAPS}")
    return names


def split_names(word: str | Path) -> list[str]:
    """The maps that a word stands for, each by a word of its own; see `weighted_names`."""
    return [name for name, _ in weighted_names(word)]


def load_map(
    name_or_path: str | Path,
    *,
    robot_radius: float = DEFAULT_ROBOT_RADIUS,
    allow_outside: bool = False,
) -> OccupancyMap:
    """Load and check a map, or several side by side.

    Args:
      name_or_path: "maze" or another map of the project; a path ending in .yaml, .yml or (MovingAI,
        1 m a cell) .map; "maze:7", the procedural map of a kind and a seed; or several of these,
        "maze,maze:0-14", each with a weight perhaps, "maze*8,maze:0-14".
      robot_radius: m, >= 0; free space and reachability are judged for a robot of this size.
      allow_outside: see `load_map_file`.

    Returns:
      The map, points in the grid frame.

    Raises:
      ValueError: one line naming the file, the field, the offending value and what was expected.

    Warns:
      UserWarning: a large area whose grey looks like unknown reads as free.
    """
    weighed = weighted_names(name_or_path)
    names = [name for name, _ in weighed]
    if len(names) == 1:
        return _load_one(names[0], robot_radius, allow_outside)
    if "" in names:
        raise ValueError(f"map {str(name_or_path)!r}: a name between two commas is missing")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"map {str(name_or_path)!r}: {name} comes twice, expected each once")
    maps = [_load_one(name, robot_radius, allow_outside) for name in names]
    joined = side_by_side(maps, str(name_or_path), [weight for _, weight in weighed])
    validate(joined, robot_radius)
    return joined


def _is_file(word: str) -> bool:
    try:
        return Path(word).is_file()
    except OSError:  # Too long for a name, say.
        return False


def _load_one(name: str, robot_radius: float, allow_outside: bool) -> OccupancyMap:
    found = _PROCEDURAL.fullmatch(name)
    if found is None:
        return load_map_file(name, robot_radius=robot_radius, allow_outside=allow_outside)
    made = dataclasses.replace(generate(found.group(1), int(found.group(2))), name=name)
    validate(made, robot_radius)
    return made
