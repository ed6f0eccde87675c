"""Parameters, optimiser and one gradient step, shared by both methods."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from sqn_jax.agent.loss import LossOutput
from sqn_jax.agent.networks import Params, QNetwork, initial_carry
from sqn_jax.agent.shares import mean
from sqn_jax.config import LearnerConfig


@struct.dataclass
class LearnerState:
    """What learning changes."""

    params: Params
    """Online parameters."""
    target_params: Params
    """Slowly following copy: r2d2 learns towards it, pqn only hands it out. None without one."""
    opt_state: Any
    """Adam's moments and counter."""
    num_updates: Array
    """int32, those left out included."""
    num_skipped: Array
    """int32: updates left out because their loss or gradient was not finite."""


def discount_schedule(progress: Array, config: LearnerConfig) -> Array | float:
    """The discount at a point of the run, `progress` in 0..1.

    With `discount_start` the horizon 1 / (1 - gamma) grows geometrically from its to that of
    `discount`: values of a short horizon are learned in a few hundred updates, and those of a
    longer one start from them (Francois-Lavet et al. 2015, "How to Discount Deep Reinforcement
    Learning").
    """
    if config.discount_start == 0:
        return config.discount
    start, end = 1 - config.discount_start, 1 - config.discount
    return 1 - start * (end / start) ** jnp.clip(progress, 0.0, 1.0)


def make_optimizer(config: LearnerConfig, total_updates: int) -> optax.GradientTransformation:
    """Adam with gradients clipped by their global norm and the configured schedule."""
    learning_rate: float | optax.Schedule = config.learning_rate
    if config.learning_rate_schedule == "linear":
        learning_rate = optax.linear_schedule(config.learning_rate, 0.0, total_updates)
    return optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.adam(learning_rate, eps=config.adam_epsilon),
    )


def init_learner(
    key: Array,
    network: QNetwork,
    optimizer: optax.GradientTransformation,
    obs: Any,
    *,
    use_target: bool,
) -> LearnerState:
    """Fresh parameters for observations like `obs` [T, B, ...]; the key is consumed."""
    batch_size = jax.tree.leaves(obs)[0].shape[1]
    params = network.init(key, obs, initial_carry(network.config, batch_size))
    return LearnerState(
        params=params,
        target_params=jax.tree.map(jnp.copy, params) if use_target else None,
        opt_state=optimizer.init(params),
        num_updates=jnp.int32(0),
        num_skipped=jnp.int32(0),
    )


def gradient_step(
    state: LearnerState,
    optimizer: optax.GradientTransformation,
    loss_function: Callable[[Params], tuple[Array, LossOutput]],
    axis_name: str | None = None,
) -> tuple[LearnerState, LossOutput, dict[str, Array]]:
    """One step of the optimiser down a loss of the online parameters.

    A step whose loss or gradient is not finite is left out and counted: one overflow, in one of
    thousands of minibatches, would else end in parameters that are no numbers. With the name of an
    axis of devices, down the mean of their losses: each takes the same step.

    Returns:
        The new state, the loss's by-products, and scalars worth logging.
    """
    (loss, output), gradient = jax.value_and_grad(loss_function, has_aux=True)(state.params)
    told = {
        "loss": loss,
        "mean_q": output.mean_q,
        "gate_entropy": output.gate_entropy,
        "skill_distance": output.skill_distance,
    }
    gradient, told = mean((gradient, told), axis_name)
    updates, opt_state = optimizer.update(gradient, state.opt_state, state.params)
    norm = optax.tree.norm(gradient)
    is_finite = jnp.isfinite(told["loss"]) & jnp.isfinite(norm)
    params, opt_state = jax.tree.map(
        partial(jnp.where, is_finite),
        (optax.apply_updates(state.params, updates), opt_state),
        (state.params, state.opt_state),
    )
    new_state = dataclasses.replace(
        state,
        params=params,
        opt_state=opt_state,
        num_updates=state.num_updates + 1,
        num_skipped=state.num_skipped + ~is_finite,
    )
    return new_state, output, told | {"gradient_norm": norm}


def average_params(state: LearnerState, share: float) -> LearnerState:
    """Let the copy follow as the average over about the last `share` of all updates.

    Polynomial-decay averaging: update t moves it by 1 / (1 + share t), so that the average covers
    the same share however long the run is. The latest parameters of fresh-data Q-learning swing
    from update to update; their average is the better greedy policy by far.
    """
    step = 1.0 / (1.0 + share * (state.num_updates - 1))
    average = jax.tree.map(lambda a, x: a + step * (x - a), state.target_params, state.params)
    return dataclasses.replace(state, target_params=average)


def update_target(state: LearnerState, rate: float) -> LearnerState:
    """Polyak averaging: target <- (1 - rate) target + rate online."""
    target = optax.incremental_update(state.params, state.target_params, rate)
    return dataclasses.replace(state, target_params=target)
