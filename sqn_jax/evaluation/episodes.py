"""Greedy episodes of a trained policy, without exploration and without auto-reset.

Episodes are driven in lanes, `LANES` at a time whatever is asked for: an episode then comes out
the same bit for bit whether it is driven alone or beside others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.agent.networks import Params, QNetwork, make_network
from sqn_jax.config import Algorithm, NetworkConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams, EnvState, Observation, navigation
from sqn_jax.training.rollout import (
    EpisodeSummary,
    Fleet,
    Trace,
    draw_chance,
    noise_keys,
    start_fleet,
    summarize,
    unroll,
)

LANES = 100
"""Episodes that are driven side by side."""


def episode_keys(key: Array, num_episodes: int) -> Array:
    """One key [E] for each episode; the first ones are the same however many are asked for."""
    return jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(num_episodes))


def start_episode(key: Array, network: QNetwork, env_params: EnvParams) -> tuple[Array, Fleet]:
    """Start, goal and first observation of the episode of a key, as a fleet of one robot.

    Returns:
        The key to drive it with, and the robot.
    """
    start_key, drive_key = jax.random.split(key)
    return drive_key, start_fleet(jax.random.split(start_key, 1), network, env_params)


def run_episodes(
    keys: Array,
    params: Params,
    env_params: EnvParams,
    *,
    algo: Algorithm,
    network_config: NetworkConfig,
    goal_radii: Sequence[float] = (),
    on_batch: Callable[[int], object] | None = None,
) -> tuple[list[EpisodeSummary], Trace]:
    """Drive greedy episodes of one policy.

    Starts, goals and noise come from the keys alone: every policy that is given the same keys and
    the same world meets the same tasks.

    Args:
        keys: [E] from `episode_keys`; independent of any training key.
        params: parameters of one network, without a seed axis.
        env_params: the world, with the noise it was made with.
        algo: which network the parameters belong to.
        network_config: its sizes.
        goal_radii: m, what counts as reaching the goal; by default only `env_params.goal_radius`.
        on_batch: called after each batch with the number of episodes it held.

    Returns:
        For each radius one number an episode [E], and the traces of all episodes; NumPy arrays.
    """
    radii = jnp.asarray(goal_radii or [env_params.goal_radius], jnp.float32)
    batches = []
    for first in range(0, len(keys), LANES):
        batch = keys[first : first + LANES]
        lanes = batch[jnp.arange(LANES) % len(batch)]
        driven = _drive(lanes, params, env_params, radii, algo=algo, network_config=network_config)
        batches.append(_episodes(jax.device_get(driven), slice(len(batch))))
        if on_batch is not None:
            on_batch(len(batch))
    summary, trace = jax.tree.map(
        lambda axis, *parts: np.concatenate(parts, axis), _EPISODE_AXES, *batches
    )
    return [jax.tree.map(lambda x, i=i: x[i], summary) for i in range(len(radii))], trace


def _axes(kind: Any, but: str = "") -> Any:
    """1 in every field of a struct, 0 in the one named."""
    return kind(**{field.name: int(field.name != but) for field in dataclasses.fields(kind)})


_EPISODE_AXES = (_axes(EpisodeSummary), _axes(Trace, but="goals"))
"""Where the axis of episodes stands: summaries are [radii, E], traces [T, E, ...], goals [E]."""


@partial(jax.jit, static_argnames=("algo", "network_config"))
def _drive(
    keys: Array,
    params: Params,
    env_params: EnvParams,
    goal_radii: Array,
    *,
    algo: Algorithm,
    network_config: NetworkConfig,
) -> tuple[EpisodeSummary, Trace]:
    """One batch."""
    network = make_network(algo, network_config, NUM_ACTIONS)

    def one(key: Array) -> tuple[EpisodeSummary, Trace]:
        drive_key, fleet = start_episode(key, network, env_params)
        greedy = jnp.zeros(1)
        chance = draw_chance(drive_key, env_params.max_steps, 1)
        trace = unroll(chance, network, params, fleet, greedy, env_params)[2]
        summaries = jax.vmap(partial(summarize, trace))(goal_radii)
        return _episodes((summaries, trace), 0)

    return jax.vmap(one, out_axes=_EPISODE_AXES)(keys)


def _episodes(batch: tuple[EpisodeSummary, Trace], chosen: Any) -> tuple[EpisodeSummary, Trace]:
    """The chosen ones of a batch."""
    return jax.tree.map(lambda axis, x: x[(slice(None),) * axis + (chosen,)], _EPISODE_AXES, batch)


@jax.jit
def start_by_hand(keys: Array, env_params: EnvParams) -> tuple[Array, Observation, EnvState]:
    """Start the episodes of `run_episodes`, for a navigator that is no network.

    Args:
        keys: [E] from `episode_keys`.
        env_params: the world.

    Returns:
        The keys [T, E] for `step_by_hand`, first observations and states [E, ...].
    """

    def one(key: Array) -> tuple[Array, Observation, EnvState]:
        start_key, drive_key = jax.random.split(key)
        start = navigation.reset(jax.random.split(start_key, 1)[0], env_params)
        noise_key = jax.random.split(drive_key)[1]
        return noise_keys(noise_key, env_params.max_steps, 1)[:, 0], *start

    return jax.vmap(one, out_axes=(1, 0, 0))(keys)


@jax.jit
def step_by_hand(
    keys: Array, state: EnvState, actions: Array, env_params: EnvParams
) -> tuple[Observation, EnvState, Array, Array, Array, navigation.Info]:
    """Advance all robots by actions [E] chosen outside, with the noise of `run_episodes`."""
    step = jax.vmap(navigation.step, in_axes=(0, 0, 0, None))
    return step(keys, state, actions, env_params)
