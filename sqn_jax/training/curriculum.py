"""Which maps the tasks of a run come from: those on which a policy still has something to learn.

With success p over its last tasks, a map gets a share in proportion to p (1 - p), which is highest
where every other goal is reached and vanishes where all are, or none. This is the sampling for
learnability of Rutherford et al. 2024 ("No Regrets"), there by level, here by map.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.agent.shards import mean
from sqn_jax.config import TrainConfig
from sqn_jax.config.map_names import MAX_MAPS
from sqn_jax.env import EnvParams
from sqn_jax.env.navigation import start_point_of
from sqn_jax.env.randomize import robot_axes

LEAST_SHARE = 0.02
"""Added to p (1 - p), which is at most 0.25, so that no map is ever left out."""

RATE = 0.1
"""How far p moves toward the outcome of a task."""


def initial_success(config: TrainConfig) -> Array | None:
    """[MAX_MAPS] success on each map before any task, 1/2; None where tasks are drawn uniformly."""
    return jnp.full(MAX_MAPS, 0.5) if config.task_sampling == "learnability" else None


def map_of_spawn_points(env_params: EnvParams) -> Array:
    """[S] int32: the number of the map that each spawn point lies on, counted from 0."""
    first = env_params.spawn_groups[:, 0]
    begins = first == np.arange(first.shape[0], dtype=np.int32)
    return (jnp.cumsum(begins, dtype=jnp.int32) - 1)[first]


def by_learnability(env_params: EnvParams, success: Array | None) -> EnvParams:
    """The world whose tasks come from its maps in proportion to p (1 - p) + `LEAST_SHARE`.

    A map's weight and the number of its spawn points count as before: with the same p on all maps
    nothing changes. The shares are exact to one entry of `start_points`.

    Args:
        env_params: the world as it was prepared.
        success: [MAX_MAPS] p of each map in 0..1; None: the world as it is.
    """
    if success is None:
        return env_params
    points = env_params.start_points
    p = success[map_of_spawn_points(env_params)[points]]
    ends = jnp.cumsum(p * (1 - p) + LEAST_SHARE)
    middles = (np.arange(points.shape[0], dtype=np.float32) + 0.5) / points.shape[0]
    drawn = jnp.searchsorted(ends, middles * ends[-1])
    return dataclasses.replace(env_params, start_points=points[drawn])


def with_outcomes(
    success: Array | None,
    keys: Array,
    reached: Array,
    env_params: EnvParams,
    axis_name: str | None,
) -> Array | None:
    """The success on each map after the tasks of a round.

    Args:
        success: [MAX_MAPS] before it, or None.
        keys: [N] those that the robots were reset with.
        reached: [N] bool, whether they arrived.
        env_params: the worlds they were in.
        axis_name: of the devices; each has N robots.
    """
    if success is None:
        return None
    points = jax.vmap(start_point_of, in_axes=(0, robot_axes(env_params)))(keys, env_params)
    maps = map_of_spawn_points(env_params)[points]
    on_map = jax.nn.one_hot(maps, MAX_MAPS)
    tasks, arrivals = mean(
        (on_map.sum(axis=0), jnp.where(reached[:, None], on_map, 0.0).sum(axis=0)), axis_name
    )
    share = arrivals / jnp.maximum(tasks, 1e-6)
    num_devices = 1 if axis_name is None else jax.lax.axis_size(axis_name)
    return success + (1 - (1 - RATE) ** (num_devices * tasks)) * (share - success)
