"""Epsilon-greedy action selection with the paper's linear schedule (section IV-C)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from sqn_jax.config import ExplorationConfig


def epsilon_schedule(progress: Array, config: ExplorationConfig) -> Array:
    """Probability of a random action, falling linearly; `progress` is 0..1 of the run."""
    fraction = jnp.clip(progress / config.decay_fraction, 0.0, 1.0)
    return config.epsilon_start + fraction * (config.epsilon_end - config.epsilon_start)


def epsilon_per_robot(progress: Array, num_envs: int, config: ExplorationConfig) -> Array:
    """Epsilon of each of N parallel robots, [N].

    With the ladder they are spread evenly from 0 to twice the schedule's value (capped at 1), so
    that their mean is the schedule's and no two robots explore alike.
    """
    epsilon = epsilon_schedule(progress, config)
    if not config.ladder:
        return jnp.full(num_envs, epsilon)
    return jnp.minimum(jnp.linspace(0.0, 2.0, num_envs) * epsilon, 1.0)


def draw_exploration(key: Array, shape: tuple[int, ...], num_actions: int) -> tuple[Array, Array]:
    """Draw all the random numbers that `epsilon_greedy` needs, for many steps at once.

    On the CPU a few random numbers cost as much as many thousand: drawn step by step they would
    take longer than the network.

    Args:
        key: consumed.
        shape: e.g. T steps of N robots.
        num_actions: A.

    Returns:
        Uniform draws in 0..1 and actions in 0..A - 1, int32, of the given shape, all independent.
    """
    uniform_key, action_key = jax.random.split(key)
    uniform = jax.random.uniform(uniform_key, shape)
    return uniform, jax.random.randint(action_key, shape, 0, num_actions)


def epsilon_greedy(q_values: Array, epsilon: Array, uniform: Array, random_actions: Array) -> Array:
    """Choose the best of A actions, or with probability `epsilon` any of them.

    Args:
        q_values: [N, A].
        epsilon: [N].
        uniform: [N] from `draw_exploration`.
        random_actions: [N] from `draw_exploration`.

    Returns:
        [N] int32 actions.
    """
    best = jnp.argmax(q_values, axis=-1).astype(jnp.int32)
    return jnp.where(uniform < epsilon, random_actions, best)
