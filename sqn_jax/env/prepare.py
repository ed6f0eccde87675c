"""From a map on the host to `EnvParams` on the device: the one place where env meets maps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.config import EnvConfig
from sqn_jax.env.arithmetic import LARGEST_INTEGER, require_single_precision
from sqn_jax.env.coverage import Lattice
from sqn_jax.env.free_space import table
from sqn_jax.env.params import EnvParams, on_device
from sqn_jax.env.raycast import RayGrid
from sqn_jax.maps import (
    MAX_CELLS,
    MAX_CELLS_TOGETHER,
    OccupancyMap,
    cells_to_points,
    connected_components,
    load_map,
    points_to_cells,
    traversable,
    validate,
)

NUM_NEIGHBORS = 4
"""Spawn points that count as near a spawn point."""

MAX_LATTICE_POINTS = 2**22
"""Points on which the covered area is counted; every robot holds a bit of each."""

MAX_SPAWN_PLACES = 2**25
"""Places to start from, of all spawn points together."""

BODY_SECTORS = 8
"""Directions in the table for collisions; a step is short, so a coarse table does."""


def make_env(
    name: str | Path | OccupancyMap,
    config: EnvConfig | None = None,
    *,
    spawn: Literal["training", "evaluation"] = "training",
) -> EnvParams:
    """Load a map and prepare it for the simulator.

    Args:
        name: a map of the project ("maze"), the path of a ROS map_server YAML file, or a map.
        config: the robot, sensors and reward; the paper's by default.
        spawn: draw starts and goals near the map's spawn points, or at its evaluation points.

    Returns:
        The parameters that `reset` and `step` take.

    Raises:
        ValueError: the map is unusable; the message names the file and what was expected. Or JAX
            is set to double precision.

    Example:
        >>> params = make_env("maze")
        >>> params.max_steps
        400
    """
    require_single_precision()
    config = EnvConfig() if config is None else config
    if spawn not in ("training", "evaluation"):
        raise ValueError(f"spawn is {spawn!r}, expected training or evaluation")
    if isinstance(name, OccupancyMap):
        occupancy_map = name
        validate(occupancy_map, config.robot_radius)
    else:
        occupancy_map = load_map(name, robot_radius=config.robot_radius)
    _require_size(occupancy_map, config)
    body_free = traversable(occupancy_map.occupied, occupancy_map.resolution, config.robot_radius)
    positions, counts = _spawn_positions(occupancy_map, body_free, spawn)
    longest_move = (config.forward_speed * (1 + 4 * config.velocity_noise)) * config.time_step
    width_m, height_m = occupancy_map.tile_m
    middles = positions.mean(axis=1)
    parts = occupancy_map.part_of(middles)
    groups = _groups(parts)
    weights = np.array(occupancy_map.weights or (1,))
    return EnvParams(
        sight=_ray_grid(
            occupancy_map.occupied, occupancy_map.resolution, config.ray_sectors, config.max_range
        ),
        body=_ray_grid(~body_free, occupancy_map.resolution, BODY_SECTORS, max(longest_move, 1.0)),
        spawn_positions=on_device(positions, np.float32),
        spawn_counts=on_device(counts, np.int32),
        start_points=on_device(np.repeat(np.arange(len(parts)), weights[parts]), np.int32),
        spawn_groups=on_device(groups, np.int32),
        spawn_neighbors=on_device(_nearest(middles, groups), np.int32),
        near_goal_fraction=on_device(config.near_goal_fraction, np.float32),
        commands=on_device(commands_of(config), np.float32),
        time_step=on_device(config.time_step, np.float32),
        goal_radius=on_device(config.goal_radius, np.float32),
        velocity_noise=_velocity_noise(config),
        range_noise=on_device(config.range_noise, np.float32),
        reward_weights=on_device(reward_weights_of(config), np.float32),
        mirrored=None,
        config=config,
        max_steps=config.max_steps or occupancy_map.max_steps,
        lattice=Lattice.over(height_m, width_m, config.coverage_cell, config.max_range),
        tile=None if occupancy_map.tiles == (1, 1) else (width_m, height_m),
    )


def reward_weights_of(config: EnvConfig) -> NDArray[np.float32]:
    """[4] weights of navigation, exploration, time and collision."""
    of_paper = [config.reward_navigation, config.reward_exploration, config.reward_time]
    return np.array([*of_paper, config.reward_collision], np.float32)


def commands_of(config: EnvConfig) -> NDArray[np.float32]:
    """[5, 2] forward speed m/s and turn rate rad/s of each action of `env.ACTION_NAMES`."""
    commands = [
        [0.0, 0.0],
        [config.forward_speed, 0.0],
        [-config.backward_speed, 0.0],
        [0.0, config.turn_rate],
        [0.0, -config.turn_rate],
    ]
    return np.array(commands, np.float32)


def _require_size(occupancy_map: OccupancyMap, config: EnvConfig) -> None:
    """Refuse maps that would take minutes and gigabytes to prepare."""
    name, (height, width) = occupancy_map.name, occupancy_map.shape
    most = MAX_CELLS_TOGETHER if occupancy_map.parts else MAX_CELLS
    if height * width > most:
        instead = "fewer maps" if occupancy_map.parts else "coarser ones"
        raise ValueError(
            f"map {name}: {width} x {height} cells, expected at most {most:,}: {instead}"
        )
    width_m, height_m = occupancy_map.tile_m
    points = (width_m + 1) * (height_m + 1) / config.coverage_cell**2
    if points > MAX_LATTICE_POINTS:
        raise ValueError(
            f"map {name}: {width_m:,.0f} x {height_m:,.0f} m with env.coverage_cell "
            f"{config.coverage_cell:g} m are {points:,.0f} points to count the covered area on, "
            f"expected at most {MAX_LATTICE_POINTS:,}: a smaller map or a larger env.coverage_cell"
        )
    lattice = Lattice.over(height_m, width_m, config.coverage_cell, config.max_range)
    if 32 * math.prod(lattice.shape) > 8 * MAX_LATTICE_POINTS:
        raise ValueError(
            f"env.max_range is {config.max_range:g} m with env.coverage_cell "
            f"{config.coverage_cell:g} m, expected at most that of the map {name}, "
            f"{math.hypot(width_m, height_m):,.0f} m"
        )
    reach = occupancy_map.spawn_radius / occupancy_map.resolution + 1
    places = len(occupancy_map.spawn_points) * min(math.pi * reach**2, height * width)
    if places > MAX_SPAWN_PLACES:
        raise ValueError(
            f"map {name}: {len(occupancy_map.spawn_points)} spawn points with spawn_radius "
            f"{occupancy_map.spawn_radius:g} m are {places:,.0f} places to start from, expected at "
            f"most {MAX_SPAWN_PLACES:,}: fewer points or a smaller radius"
        )


def with_noise(params: EnvParams, velocity_noise: float, range_noise: float) -> EnvParams:
    """The same world under other noise, in the units its config names.

    The levels are traced: all levels above 0 share one compiled program.

    Args:
        params: from `make_env`.
        velocity_noise: as `EnvConfig.velocity_noise`.
        range_noise: as `EnvConfig.range_noise`.

    Raises:
        ValueError: a level is negative or not finite.
    """
    env_config = dataclasses.replace(
        params.config, velocity_noise=velocity_noise, range_noise=range_noise
    )
    compiled_in = dataclasses.replace(
        env_config, velocity_noise=float(velocity_noise > 0), range_noise=float(range_noise > 0)
    )
    return dataclasses.replace(
        params,
        velocity_noise=_velocity_noise(env_config),
        range_noise=on_device(range_noise, np.float32),
        config=compiled_in,
    )


def _velocity_noise(config: EnvConfig) -> Array:
    speed = np.array([config.forward_speed, config.turn_rate], np.float32)
    unit = speed if config.velocity_noise_unit == "relative" else np.ones(2, np.float32)
    return on_device(config.velocity_noise * unit, np.float32)


def _ray_grid(
    blocked: NDArray[np.bool_], resolution: float, sectors: int, reach_m: float
) -> RayGrid:
    # A rectangle is up to a cell longer; a signed byte holds 127.
    reach = min(math.ceil(reach_m / resolution), 126)
    height, width = blocked.shape
    if sectors * height * width >= 2**31 or 128 * width > LARGEST_INTEGER:
        raise ValueError(
            f"the map has {height} x {width} cells, expected fewer than {2**31 // sectors:,} "
            f"with env.ray_sectors {sectors}"
        )
    return RayGrid(
        far_sides=_table(blocked.tobytes(), blocked.shape, sectors, reach),
        first_entry=on_device(0, np.int32),
        resolution=on_device(resolution, np.float32),
        width=on_device(width, np.int32),
        sectors=sectors,
    )


TableSource = Callable[[NDArray[np.bool_], int, int], NDArray[np.int16]]
"""From blocked cells [H, W], sectors and reach to `free_space.table`."""

_table_source: list[TableSource] = [table]


@contextmanager
def tables_from(source: TableSource) -> Iterator[None]:
    """Take the tables of maps from here within this context; they must be those of `table`."""
    _table_source.append(source)
    try:
        yield
    finally:
        _table_source.pop()


@lru_cache(maxsize=2)
def _table(blocked: bytes, shape: tuple[int, int], sectors: int, reach: int) -> Array:
    """The table of a `RayGrid`; those of the last map are kept, for its other kinds of tasks."""
    sides = _table_source[-1](np.frombuffer(blocked, np.bool_).reshape(shape), sectors, reach)
    return on_device(np.moveaxis(sides, 0, -1).reshape(-1), np.int16)


def _groups(parts: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each point, given by its part [S], the first of its part and how many these are, [S, 2].

    Points of a part stand one after the other.
    """
    _, firsts, own, counts = np.unique(
        parts, return_index=True, return_inverse=True, return_counts=True
    )
    return np.stack([firsts[own], counts[own]], axis=1)


def _nearest(points: NDArray[np.float64], groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each point [S, 2] the indices of the nearest others of its group [S, NUM_NEIGHBORS].

    Fewer, where a group has no more points.
    """
    count = min(NUM_NEIGHBORS, groups[:, 1].min() - 1)
    neighbors = np.empty((len(points), count), np.int64)
    for index, (point, (first, size)) in enumerate(zip(points, groups, strict=True)):
        distances = np.hypot(*(points[first : first + size] - point).T)
        distances[index - first] = np.inf
        neighbors[index] = first + np.argsort(distances, kind="stable")[:count]
    return neighbors


def _spawn_positions(
    occupancy_map: OccupancyMap, body_free: NDArray[np.bool_], spawn: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Places around each point, [S, M, 2] m and how many are real, [S].

    Places are centers of traversable cells within the spawn radius that lie in the connected
    component of the point's own cell; at evaluation points only the point itself, or the center
    of its cell where single precision on the device would put it across a border into an obstacle.
    """
    resolution = occupancy_map.resolution
    labels, _ = connected_components(body_free)
    if spawn == "evaluation":
        marked = occupancy_map.evaluation_points
        on_device = marked.astype(np.float32) / np.float32(resolution)
        columns, rows = np.floor(on_device).astype(int).T
        own_centers = cells_to_points(points_to_cells(marked, resolution), resolution)
        free = body_free[rows, columns]
        return np.where(free[:, None], marked, own_centers)[:, None], np.ones(len(marked), np.int64)
    groups = []
    reach = math.ceil(occupancy_map.spawn_radius / resolution)
    for point in occupancy_map.spawn_points:
        row, column = points_to_cells(point, resolution)
        corner = np.maximum([row - reach, column - reach], 0)
        around = labels[corner[0] : row + reach + 1, corner[1] : column + reach + 1]
        centers = cells_to_points(np.argwhere(around == labels[row, column]) + corner, resolution)
        group = centers[np.hypot(*(centers - point).T) <= occupancy_map.spawn_radius]
        own_cell = cells_to_points([row, column], resolution)[None]
        groups.append(group if len(group) else own_cell)
    counts = np.array([len(group) for group in groups])
    positions = np.stack([np.resize(group, (counts.max(), 2)) for group in groups])
    return positions, counts
