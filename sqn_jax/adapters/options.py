"""What the adapters are made from: a map by its name, and settings of the robot by keyword."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sqn_jax.config import EnvConfig
from sqn_jax.config.files import from_dict
from sqn_jax.env import EnvParams, make_env
from sqn_jax.maps import OccupancyMap, load_map

Spawn = Literal["training", "evaluation"]


def make_world(
    map_name: str | Path | OccupancyMap, spawn: Spawn, settings: Mapping[str, Any]
) -> tuple[OccupancyMap, EnvParams]:
    """Load a map and prepare it for the simulator.

    Args:
        map_name: a map of the project, a file, a procedural map, several; or a map.
        spawn: tasks near the map's spawn points, or at its evaluation points.
        settings: fields of `EnvConfig` by their names.

    Raises:
        ValueError: one line that names the setting or the map, and what was expected.
    """
    names = [field.name for field in dataclasses.fields(EnvConfig)]
    for name in settings:
        if name not in names:
            nearest = difflib.get_close_matches(name, names, 1)
            hint = f"{nearest[0]}?" if nearest else f"one of {', '.join(['map', 'spawn', *names])}"
            raise ValueError(f"unknown option {name!r:.80}, expected {hint}")
    numbers = {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in settings.items()
    }
    config = from_dict(numbers, EnvConfig, "env.")
    if not isinstance(map_name, str | Path | OccupancyMap):
        raise ValueError(f"map is {map_name!r:.80}, expected a name, a path or an OccupancyMap")
    if not isinstance(map_name, OccupancyMap):
        map_name = load_map(map_name, robot_radius=config.robot_radius)
    return map_name, make_env(map_name, config, spawn=spawn)


def observation_size(env_params: EnvParams) -> int:
    """Numbers of an observation: one a beam, and two or more about the goal."""
    config = env_params.config
    return config.num_beams + (2 if config.heading_encoding == "linear" else 3)
