"""Maps, on the host: occupancy grids, their files and their distance fields."""

from sqn_jax.maps.check import describe, step_warning
from sqn_jax.maps.distance import goal_distance, goal_fields, obstacle_distance
from sqn_jax.maps.load import load_map
from sqn_jax.maps.occupancy import (
    MAX_CELLS,
    MAX_CELLS_TOGETHER,
    OccupancyMap,
    cells_to_points,
    connected_components,
    points_to_cells,
    reachable_cells,
    sample_spawn_points,
    traversable,
    validate,
)
from sqn_jax.maps.ros import known_maps, save_map

__all__ = [
    "MAX_CELLS",
    "MAX_CELLS_TOGETHER",
    "OccupancyMap",
    "cells_to_points",
    "connected_components",
    "describe",
    "goal_distance",
    "goal_fields",
    "known_maps",
    "load_map",
    "obstacle_distance",
    "points_to_cells",
    "reachable_cells",
    "sample_spawn_points",
    "save_map",
    "step_warning",
    "traversable",
    "validate",
]
