"""Recurrent PQN: many robots, fresh whole episodes, Q(lambda) targets; no replay, no target net.

Follows "Simplifying Deep Temporal Difference Learning" (Gallici et al. 2024), with whole episodes
as sequences. Layer normalisation takes the place of the target network.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from sqn_jax.agent.experience import Episodes
from sqn_jax.agent.learner import LearnerState, gradient_step
from sqn_jax.agent.loss import pqn_loss
from sqn_jax.agent.networks import QNetwork
from sqn_jax.config import TrainConfig


def learn(
    key: Array,
    state: LearnerState,
    memory: None,
    episodes: Episodes,
    network: QNetwork,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
) -> tuple[LearnerState, None, dict[str, Array]]:
    """Go through a round of episodes in minibatches, each episode equally often.

    Robot n is in minibatch n mod M, so that each minibatch spans the exploration ladder. Episodes
    of a round are independent of each other: there is nothing to shuffle within a pass, and the
    key is not needed.
    """
    del key
    num_batches = config.num_envs // config.learner.batch_size
    num_passes = config.updates_per_round // num_batches
    batches = jax.tree.map(partial(_split_robots, num_batches=num_batches), episodes)
    update = partial(_update, network=network, optimizer=optimizer, config=config)

    def one_pass(state: LearnerState, _: None) -> tuple[LearnerState, dict[str, Array]]:
        return jax.lax.scan(update, state, batches)

    state, metrics = jax.lax.scan(one_pass, state, None, length=num_passes)
    return state, memory, jax.tree.map(jnp.mean, metrics)


def _split_robots(array: Array, num_batches: int) -> Array:
    """[T, N, ...] to [M, T, N / M, ...]."""
    length, robots, *rest = array.shape
    grouped = array.reshape(length, robots // num_batches, num_batches, *rest)
    return jnp.moveaxis(grouped, 2, 0)


def _update(
    state: LearnerState,
    episodes: Episodes,
    *,
    network: QNetwork,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
) -> tuple[LearnerState, dict[str, Array]]:
    def loss_function(params: Any) -> Any:
        return pqn_loss(params, network, episodes, config.learner)

    state, _, metrics = gradient_step(state, optimizer, loss_function)
    return state, metrics
