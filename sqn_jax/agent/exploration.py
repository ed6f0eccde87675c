"""Epsilon-greedy action selection with the paper's linear schedule (section IV-D)."""

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


def epsilon_greedy(key: Array, q_values: Array, epsilon: Array) -> Array:
    """Choose the best of A actions, or with probability `epsilon` any of them.

    Args:
        key: consumed.
        q_values: [N, A].
        epsilon: [N].

    Returns:
        [N] int32 actions.
    """
    explore_key, action_key = jax.random.split(key)
    num_robots, num_actions = q_values.shape
    explore = jax.random.uniform(explore_key, (num_robots,)) < epsilon
    random_action = jax.random.randint(action_key, (num_robots,), 0, num_actions)
    return jnp.where(explore, random_action, jnp.argmax(q_values, axis=-1)).astype(jnp.int32)
