"""Domain randomization: a world of its own for each of N robots (future work, section VII)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sqn_jax.config import RandomizationConfig
from sqn_jax.env.params import EnvParams
from sqn_jax.env.several_maps import own_map_axes


def randomized(params: EnvParams, config: RandomizationConfig, num_envs: int) -> EnvParams:
    """The worlds of N robots: their noise and their speeds are spread evenly and independently,
    and half of them are mirrored.

    Robot n always has the same world, whatever the seed.

    Args:
        params: the common world.
        config: how far it is spread.
        num_envs: N.

    Returns:
        Parameters in which each field that differs has a leading axis [N]; see `robot_axes`.
    """
    fractions = _spread(num_envs)
    env_config = params.config
    changes: dict[str, Any] = {}
    if config.velocity_noise > 0:
        speed = np.array([env_config.forward_speed, env_config.turn_rate])
        unit = speed if env_config.velocity_noise_unit == "relative" else np.ones(2)
        changes["velocity_noise"] = jnp.asarray(
            config.velocity_noise * fractions[:, :1] * unit, jnp.float32
        )
        env_config = dataclasses.replace(env_config, velocity_noise=config.velocity_noise)
    if config.range_noise > 0:
        changes["range_noise"] = jnp.asarray(config.range_noise * fractions[:, 1], jnp.float32)
        env_config = dataclasses.replace(env_config, range_noise=config.range_noise)
    if config.speed > 0:
        factors = jnp.asarray(1 + config.speed * (2 * fractions[:, 2] - 1), jnp.float32)
        changes["commands"] = factors[:, None, None] * params.commands[None]
    if config.mirror:
        mirrored = _odd_ones(num_envs)
        turns = jnp.asarray(np.stack([np.ones(num_envs), 1.0 - 2.0 * mirrored], axis=1))
        commands = changes.get("commands", params.commands[None])
        changes["commands"] = commands * turns[:, None].astype(jnp.float32)
        changes["mirrored"] = jnp.asarray(mirrored)
    return dataclasses.replace(params, config=env_config, **changes)


def robots_own(params: EnvParams) -> list[str]:
    """The fields in which each robot has something of its own."""
    common = {"commands": 2, "velocity_noise": 1, "range_noise": 0, "mirrored": 0}
    fields = {name: getattr(params, name) for name in common}
    return [name for name, x in fields.items() if x is not None and jnp.ndim(x) > common[name]]


def robot_axes(params: EnvParams) -> Any:
    """For `jax.vmap` over N robots: axis 0 for what each has of its own, None for the rest."""
    shared = jax.tree.map(lambda _: None, params)
    axes = dataclasses.replace(shared, **dict.fromkeys(robots_own(params), 0))
    if jnp.ndim(params.sight.first_entry) > 0:
        axes = dataclasses.replace(
            axes, sight=own_map_axes(axes.sight), body=own_map_axes(axes.body)
        )
    return axes


def _spread(count: int) -> NDArray[np.float64]:
    """[N, 3] numbers in 0..1, each column evenly spaced and none of them going with another.

    Ranks of the additive recurrence of Roberts' R3 sequence, multiples of powers of 1/g with
    g^4 = g + 1, which fills the cube evenly.
    """
    ratio = 1.22074408460575947536
    sequence = np.arange(count)[:, None] * ratio ** -np.arange(1.0, 4.0) % 1.0
    ranks = sequence.argsort(axis=0).argsort(axis=0)
    return (ranks + 0.5) / count


def _odd_ones(count: int) -> NDArray[np.bool_]:
    """[N] which of the numbers 0..N - 1 have an odd number of ones in binary (Thue and Morse).

    Half of them, and half of those that leave the same rest on division by a power of two: of every
    minibatch, that is.
    """
    return np.bitwise_count(np.arange(count)) % 2 == 1
