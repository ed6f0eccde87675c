"""Recurrent PQN: many robots, fresh steps, Q(lambda) targets; no replay, no target network.

Follows "Simplifying Deep Temporal Difference Learning" (Gallici et al. 2024). The robots act for
a window of an episode, the network is updated on it, and they go on with the new network; the
recurrent state is handed from window to window. Layer normalization takes the place of the target
network.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from sqn_jax.agent.learner import LearnerState, average_params, current_discount, gradient_step
from sqn_jax.agent.loss import LossOutput, pqn_loss
from sqn_jax.agent.networks import Params
from sqn_jax.agent.program import Program
from sqn_jax.agent.trajectory import Trajectory, over_robots


def learn(
    key: Array, state: LearnerState, trajectory: Trajectory, program: Program
) -> tuple[LearnerState, dict[str, Array]]:
    """Go through a window of all robots in minibatches, each robot equally often.

    Robot n is in minibatch n mod M, so that each minibatch spans the exploration ladder. Robots
    are independent of each other: there is nothing to shuffle, and the key is not needed. On
    several devices each has its shard of the robots and of each minibatch.
    """
    del key
    minibatches = split_robots(trajectory, program.num_minibatches)

    def one_pass(state: LearnerState, _: None) -> tuple[LearnerState, dict[str, Array]]:
        return jax.lax.scan(lambda state, part: update(state, part, program), state, minibatches)

    num_passes = program.config.learner.num_passes
    state, metrics = jax.lax.scan(one_pass, state, None, length=num_passes)
    return state, jax.tree.map(jnp.mean, metrics)


def update(
    state: LearnerState, trajectory: Trajectory, program: Program
) -> tuple[LearnerState, dict[str, Array]]:
    """Learn from one minibatch [T (+ 1), B, ...]."""
    discount = current_discount(state, program)

    def loss_function(params: Params) -> tuple[Array, LossOutput]:
        return pqn_loss(params, trajectory, discount, program)

    state, _, metrics = gradient_step(state, loss_function, program)
    if state.target_params is not None:
        state = average_params(state, program.config.learner.average_share)
    return state, metrics


def split_robots(trajectory: Trajectory, num_batches: int) -> Trajectory:
    """N robots to M minibatches: [T, N, ...] becomes [M, T, N / M, ...], [N, H] [M, N / M, H]."""

    def split(array: Array, axis: int) -> Array:
        shape = array.shape
        grouped = array.reshape(*shape[:axis], -1, num_batches, *shape[axis + 1 :])
        return jnp.moveaxis(grouped, axis + 1, 0)

    return over_robots(split, trajectory.for_learning())
