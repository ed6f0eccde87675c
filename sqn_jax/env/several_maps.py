"""Several worlds in one program: maps of any sizes, of which each robot has its own.

`join_maps` puts the tables of several maps one after the other, `select_maps` picks for each robot
the map that it moves on. Coordinates stay those of each map, so a robot takes the same steps, bit
for bit, whichever other maps there are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.env.coverage import Lattice
from sqn_jax.env.params import EnvParams, on_device
from sqn_jax.env.raycast import RayGrid

_OF_A_MAP = ("first_entry", "resolution", "width")
"""The fields of a `RayGrid` that each map has of its own."""


def join_maps(
    worlds: Sequence[EnvParams], *, tile_m: tuple[float, float], max_steps: int
) -> EnvParams:
    """Put the tables of M maps one after the other.

    Args:
        worlds: from `make_env`, of single maps, for the same robot.
        tile_m: width and height, m, of an area that every map fits into. The covered area is
            counted on a lattice of this size.
        max_steps: steps per episode.

    Returns:
        Parameters whose `sight` and `body` have an axis [M]; `select_maps` makes one of robots of
        it. Tasks cannot be drawn from them: episodes start with `reset_to`. The tables are padded
        to a power of two, so that maps of other sizes mostly share the compiled program.
    """
    first = worlds[0]
    config = first.config
    return dataclasses.replace(
        without_spawn_points(first),
        sight=_join([world.sight for world in worlds]),
        body=_join([world.body for world in worlds]),
        lattice=Lattice.over(tile_m[1], tile_m[0], config.coverage_cell, config.max_range),
        max_steps=max_steps,
    )


def without_spawn_points(env_params: EnvParams) -> EnvParams:
    """The same world without the places that tasks are drawn from, whose shapes differ.

    Episodes that start with `reset_to` share their compiled program then.
    """

    def one_entry(array: Array) -> Array:
        return on_device(np.zeros((1,) * array.ndim), array.dtype)

    return dataclasses.replace(
        env_params,
        spawn_positions=one_entry(env_params.spawn_positions),
        spawn_counts=one_entry(env_params.spawn_counts),
        start_points=one_entry(env_params.start_points),
        spawn_groups=one_entry(env_params.spawn_groups),
        spawn_neighbors=one_entry(env_params.spawn_neighbors),
    )


def _join(grids: Sequence[RayGrid]) -> RayGrid:
    entries = [np.asarray(grid.far_sides) for grid in grids]
    ends = np.cumsum([len(array) for array in entries])
    joined = np.zeros(1 << int(ends[-1] - 1).bit_length(), np.int16)
    np.concatenate(entries, out=joined[: ends[-1]])
    return dataclasses.replace(
        grids[0],
        far_sides=on_device(joined, np.int16),
        first_entry=on_device(np.append(0, ends[:-1]), np.int32),
        resolution=jnp.stack([grid.resolution for grid in grids]),
        width=jnp.stack([grid.width for grid in grids]),
    )


def select_maps(env_params: EnvParams, maps: Array) -> EnvParams:
    """For each of N robots the map that it moves on, by its number [N] in `join_maps`."""

    def select(grid: RayGrid) -> RayGrid:
        chosen = {name: getattr(grid, name)[maps] for name in _OF_A_MAP}
        return dataclasses.replace(grid, **chosen)

    return dataclasses.replace(
        env_params, sight=select(env_params.sight), body=select(env_params.body)
    )


def own_map_axes(axes: Any) -> Any:
    """The axes of a `RayGrid` for `jax.vmap` over robots that have maps of their own."""
    return dataclasses.replace(axes, **dict.fromkeys(_OF_A_MAP, 0))
