"""What learning changes, and one gradient step; shared by both methods."""

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
from sqn_jax.agent.networks import GATE_BALANCE, HasObservation, Params, initial_carry
from sqn_jax.agent.program import Program
from sqn_jax.agent.replay import ReplayState
from sqn_jax.agent.shards import mean
from sqn_jax.config import LearnerConfig, TrainConfig


@struct.dataclass
class LearnerState:
    """What learning changes."""

    params: Params
    """Online parameters."""
    target_params: Params
    """Slowly following copy: r2d2 learns toward it, pqn only evaluates it. None without one."""
    opt_state: Any
    """Adam's moments and counter."""
    memory: Any
    """`ReplayState` of whole episodes for r2d2; None for pqn."""
    round: Array
    """int32: rounds of the run that are done."""
    num_updates: Array
    """int32, those left out included."""
    num_skipped: Array
    """int32: updates left out because their loss or gradient was not finite."""


def progress(state: LearnerState, program: Program) -> Array:
    """How much of the run is done, 0..1."""
    return state.round / program.config.num_rounds


def current_discount(state: LearnerState, program: Program) -> Array | float:
    """The discount of this round."""
    return discount_schedule(progress(state, program), program.config.learner)


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


def policy_params(state: LearnerState, config: TrainConfig) -> Params:
    """The parameters to evaluate and to ship: the averaged ones where there are any."""
    return state.target_params if config.averages_params else state.params


def init_learner(
    key: Array, obs: HasObservation, program: Program, memory: ReplayState | None = None
) -> LearnerState:
    """Fresh parameters for observations like `obs` [T, B, ...]; the key is consumed."""
    config = program.config
    params = program.network.init(key, obs, initial_carry(config.network, obs.ranges.shape[1]))
    has_target = config.method == "r2d2" or config.averages_params
    return LearnerState(
        params=params,
        target_params=jax.tree.map(jnp.copy, params) if has_target else None,
        opt_state=program.optimizer.init(params),
        memory=memory,
        round=jnp.int32(0),
        num_updates=jnp.int32(0),
        num_skipped=jnp.int32(0),
    )


def gradient_step(
    state: LearnerState,
    loss_function: Callable[[Params], tuple[Array, LossOutput]],
    program: Program,
) -> tuple[LearnerState, LossOutput, dict[str, Array]]:
    """One step of the optimizer down a loss of the online parameters.

    A step whose loss or gradient is not finite is left out and counted: one overflow, in one of
    thousands of minibatches, would else end in parameters that are no numbers. On several devices,
    down the mean of their losses: each takes the same step.

    Returns:
        The new state, the loss's by-products, and scalars worth logging.
    """
    (loss, output), gradient = jax.value_and_grad(loss_function, has_aux=True)(state.params)
    metrics = {
        "loss": loss,
        "mean_q": output.mean_q,
        "gate_entropy": output.gate_entropy,
        "skill_distance": output.skill_distance,
    }
    gradient, metrics, load = mean((gradient, metrics, output.skill_load), program.axis_name)
    updates, opt_state = program.optimizer.update(gradient, state.opt_state, state.params)
    norm = optax.tree.norm(gradient)
    is_finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(norm)
    new_params = optax.apply_updates(state.params, updates)
    new_params = balanced(new_params, load, program.config.network.gate_balance_rate)
    params, opt_state = jax.tree.map(
        partial(jnp.where, is_finite),
        (new_params, opt_state),
        (state.params, state.opt_state),
    )
    new_state = dataclasses.replace(
        state,
        params=params,
        opt_state=opt_state,
        num_updates=state.num_updates + 1,
        num_skipped=state.num_skipped + ~is_finite,
    )
    return new_state, output, metrics | {"gradient_norm": norm}


def balanced(params: Params, load: Array, rate: float) -> Params:
    """Move the bias on the logits of the skill decision against the load of the skills.

    By `rate` up where a skill has less than its equal part, and down where it has more, beside the
    gradient and without a term in the loss (Wang et al. 2024, "Auxiliary-Loss-Free Load Balancing
    Strategy for Mixture-of-Experts"). Parameters without such a bias are returned as they are.

    Args:
        params: of any network.
        load: [K] mean weight of each skill in the last minibatch.
        rate: at least 0.
    """
    modules = params["params"]
    if GATE_BALANCE not in modules:
        return params
    balance = modules[GATE_BALANCE] + rate * jnp.sign(1 / load.shape[0] - load)
    return {**params, "params": {**modules, GATE_BALANCE: balance}}


def average_params(state: LearnerState, fraction: float) -> LearnerState:
    """Let the copy follow as the average over about the last `fraction` of all updates.

    Polynomial-decay averaging: update t moves it by 1 / (1 + fraction t), so the average covers
    the same fraction however long the run is. The latest parameters of fresh-data Q-learning swing
    from update to update; their average is the better greedy policy by far.
    """
    step = 1.0 / (1.0 + fraction * (state.num_updates - 1))
    average = jax.tree.map(lambda a, x: a + step * (x - a), state.target_params, state.params)
    return dataclasses.replace(state, target_params=average)


def update_target(state: LearnerState, rate: float) -> LearnerState:
    """Polyak averaging: target <- (1 - rate) target + rate online."""
    target = optax.incremental_update(state.params, state.target_params, rate)
    return dataclasses.replace(state, target_params=target)
