"""Recurrent PQN: many robots, fresh steps, Q(lambda) targets; no replay, no target network.

Follows "Simplifying Deep Temporal Difference Learning" (Gallici et al. 2024). The robots drive a
window of an episode, the network is updated on it, and they drive on with the new network; the
recurrent state is handed from window to window. Layer normalisation takes the place of the target
network.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from sqn_jax.agent.learner import LearnerState, average_params, gradient_step
from sqn_jax.agent.loss import pqn_loss
from sqn_jax.agent.networks import QNetwork
from sqn_jax.agent.trajectory import Trajectory, over_robots
from sqn_jax.config import TrainConfig


def learn(
    key: Array,
    state: LearnerState,
    memory: None,
    trajectory: Trajectory,
    network: QNetwork,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    discount: Array | float | None = None,
    axis_name: str | None = None,
) -> tuple[LearnerState, None, dict[str, Array]]:
    """Go through a window of all robots in minibatches, each robot equally often.

    Robot n is in minibatch n mod M, so that each minibatch spans the exploration ladder. Robots
    are independent of each other: there is nothing to shuffle, and the key is not needed. With the
    name of an axis of devices, each has its share of the robots and of each minibatch.
    """
    del key
    num_batches = config.num_envs // config.learner.batch_size
    batches = split_robots(trajectory, num_batches)
    update = partial(
        _update,
        network=network,
        optimizer=optimizer,
        config=config,
        discount=discount,
        axis_name=axis_name,
    )

    def one_pass(state: LearnerState, _: None) -> tuple[LearnerState, dict[str, Array]]:
        return jax.lax.scan(update, state, batches)

    state, metrics = jax.lax.scan(one_pass, state, None, length=config.learner.num_passes)
    return state, memory, jax.tree.map(jnp.mean, metrics)


def split_robots(trajectory: Trajectory, num_batches: int) -> Trajectory:
    """N robots to M minibatches: [T, N, ...] becomes [M, T, N / M, ...], [N, H] [M, N / M, H]."""

    def split(array: Array, axis: int) -> Array:
        shape = array.shape
        grouped = array.reshape(*shape[:axis], -1, num_batches, *shape[axis + 1 :])
        return jnp.moveaxis(grouped, axis + 1, 0)

    return over_robots(split, trajectory.for_learning())


def _update(
    state: LearnerState,
    trajectory: Trajectory,
    *,
    network: QNetwork,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    discount: Array | float | None,
    axis_name: str | None,
) -> tuple[LearnerState, dict[str, Array]]:
    def loss_function(params: Any) -> Any:
        return pqn_loss(params, network, trajectory, config.learner, discount)

    state, _, metrics = gradient_step(state, optimizer, loss_function, axis_name)
    if state.target_params is not None:
        state = average_params(state, config.learner.average_share)
    return state, metrics
