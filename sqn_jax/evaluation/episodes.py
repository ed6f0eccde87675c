"""Greedy episodes of a trained policy, without exploration and without auto-reset.

Episodes always run `BATCH` at a time in the same compiled program, whatever is returned of them. So
an episode is the same bit for bit whether it runs alone or beside others, for a score or a picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.agent.networks import Params, QNetwork, initial_carry
from sqn_jax.agent.trajectory import Trajectory, over_robots
from sqn_jax.env import EnvParams
from sqn_jax.training.rollout import (
    ActorState,
    EpisodeMetrics,
    RandomDraws,
    episode_metrics,
    random_draws,
    reset_robots,
    step_actors,
    unroll,
)

BATCH = 100
"""Episodes that run at once."""


def episode_keys(key: Array, num_episodes: int) -> Array:
    """One key for each episode, [E]; key i does not depend on the number of episodes."""
    return jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(num_episodes))


def start_episodes(
    keys: Array, carry: Array, env_params: EnvParams
) -> tuple[RandomDraws, ActorState]:
    """Start the episodes of these keys: the random draws of their steps, and the first state.

    All follows from an episode's own key, so policies that get the same keys and the same world
    have the same tasks and the same noise.

    Args:
        keys: [E] from `episode_keys`.
        carry: [E, H] the initial carry.
        env_params: the world.

    Returns:
        The random draws [T, E], and the actor state with starts, goals and first observations.
    """

    def split(key: Array) -> tuple[Array, RandomDraws]:
        start_key, draws_key = jax.random.split(key)
        draws = random_draws(draws_key, env_params.max_steps, 1)
        return jax.random.split(start_key, 1)[0], jax.tree.map(lambda x: x[:, 0], draws)

    start_keys, draws = jax.vmap(split, out_axes=(0, 1))(keys)
    return draws, ActorState(*reset_robots(start_keys, env_params), carry)


def run_episodes(
    keys: Array,
    params: Params,
    env_params: EnvParams,
    network: QNetwork,
    *,
    goal_radii: Sequence[float] = (),
    fields: Sequence[str] = ("poses", "goals"),
    on_batch: Callable[[int], object] = lambda count: None,
) -> tuple[list[EpisodeMetrics], Trajectory]:
    """Run greedy episodes of one policy.

    Args:
        keys: [E] from `episode_keys`; independent of any training key.
        params: parameters of one network, without a seed axis.
        env_params: the world, with its noise.
        network: the network of these parameters.
        goal_radii: m, within which the goal is reached; default: `env_params.goal_radius` only.
        fields: the fields of `Trajectory` to return; all together take about 0.4 kB per step.
        on_batch: called after each batch with its number of episodes.

    Returns:
        The metrics for each radius, [E] each, and the trajectory with these fields; NumPy arrays.
    """
    radii = goal_radii or [float(env_params.goal_radius)]
    metrics: list[list[EpisodeMetrics]] = []
    trajectories: list[Trajectory] = []
    for first in range(0, len(keys), BATCH):
        batch = keys[first : first + BATCH]
        full = batch[jnp.arange(BATCH) % len(batch)]
        real = slice(len(batch))  # The rest of a batch is padding.
        trajectory = _run_batch(full, params, env_params, network)
        metrics.append(jax.tree.map(lambda x, real=real: x[real], metrics_of(trajectory, radii)))
        trajectories.append(jax.device_get(trajectory.only(*fields)).of_robots(real))
        on_batch(len(batch))

    def join(*parts: NDArray[Any], axis: int = 0) -> NDArray[Any]:
        return np.concatenate(parts, axis)

    joined: list[EpisodeMetrics] = jax.tree.map(join, *metrics)
    return joined, over_robots(join, *trajectories)


@partial(jax.jit, static_argnames="network")
def _run_batch(keys: Array, params: Params, env_params: EnvParams, network: QNetwork) -> Trajectory:
    carry = initial_carry(network.config, len(keys))
    draws, actors = start_episodes(keys, carry, env_params)
    _, trajectory = unroll(draws, params, actors, jnp.zeros(len(keys)), env_params, network)
    return trajectory


def metrics_of(trajectory: Trajectory, goal_radii: Sequence[float]) -> list[EpisodeMetrics]:
    """`episode_metrics` for each radius, m; NumPy arrays [E].

    A program of its own, so that the program of the episodes is the same for all radii.
    """
    needed = trajectory.only("rewards", "poses", "info")
    metrics = [_metrics(needed, jnp.float32(radius)) for radius in goal_radii]
    on_host: list[EpisodeMetrics] = jax.device_get(metrics)
    return on_host


_metrics = jax.jit(episode_metrics)


@jax.jit
def start_by_hand(keys: Array, env_params: EnvParams) -> tuple[Array, ActorState]:
    """Start the episodes of `run_episodes` for an agent that is not a network.

    Args:
        keys: [E] from `episode_keys`.
        env_params: the world.

    Returns:
        The keys [T, E] for `step_by_hand`, and the actor state, whose carry is empty [E, 0].
    """
    draws, actors = start_episodes(keys, jnp.zeros((len(keys), 0)), env_params)
    return draws.step_keys, actors


@jax.jit
def step_by_hand(
    step_keys: Array, actors: ActorState, actions: Array, env_params: EnvParams
) -> tuple[ActorState, Trajectory]:
    """Compiled `rollout.step_actors`: one step with actions [E] chosen on the host."""
    return step_actors(step_keys, actors, actions, env_params)
