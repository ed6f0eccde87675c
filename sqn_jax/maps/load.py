"""Maps by their names: the project's own, files, procedural ones, and several side by side."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from sqn_jax.config.map_names import MapFile, MapName, MapSet, ProceduralMap, parse
from sqn_jax.maps.atlas import side_by_side
from sqn_jax.maps.generate import generate
from sqn_jax.maps.occupancy import OccupancyMap, validate
from sqn_jax.maps.ros import DEFAULT_ROBOT_RADIUS, load_map_file


def load_map(
    name: MapSet | MapName | str | Path,
    *,
    robot_radius: float = DEFAULT_ROBOT_RADIUS,
    allow_outside: bool = False,
) -> OccupancyMap:
    """Load and check a map, or several side by side.

    Args:
        name: "maze" or another map of the project; a path ending in .yaml, .yml or (MovingAI, 1 m a
            cell unless it says "room.map@0.5") .map; "maze:7", the procedural map of a kind and a
            seed; or several of these, "maze,maze:0-14", each with a weight perhaps,
            "maze*8,maze:0-14". Text or what `config.map_names.parse` makes of it; a `Path` is a
            file.
        robot_radius: m, >= 0; free space and reachability are judged for a robot of this size.
        allow_outside: see `load_map_file`.

    Returns:
        The map, points in the grid frame.

    Raises:
        ValueError: one line naming the file, the field, the offending value and what was expected.

    Warns:
        UserWarning: see `load_map_file`.
    """
    if isinstance(name, str | Path):
        name = parse(name)
    elif not isinstance(name, MapSet):
        name = MapSet((name,), (1,))
    maps = [_load_one(part, robot_radius, allow_outside) for part in name.names]
    if len(maps) == 1:
        return maps[0]
    joined = side_by_side(maps, str(name), name.weights)
    validate(joined, robot_radius)
    return joined


def _load_one(name: MapName, robot_radius: float, allow_outside: bool) -> OccupancyMap:
    if isinstance(name, ProceduralMap):
        made = dataclasses.replace(generate(name.kind, name.seed), name=str(name))
        validate(made, robot_radius)
        return made
    source = Path(name.path) if isinstance(name, MapFile) else name.name
    return load_map_file(
        source,
        robot_radius=robot_radius,
        allow_outside=allow_outside,
        resolution=name.resolution if isinstance(name, MapFile) else None,
    )
