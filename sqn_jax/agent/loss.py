"""TD errors of a batch of whole episodes: the R2D2 loss and the recurrent PQN loss."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.networks import Params, QNetwork, QOutput
from sqn_jax.agent.program import Program
from sqn_jax.agent.returns import inverse_rescale, lambda_targets, n_step_targets, rescale
from sqn_jax.agent.shards import mean
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.config import LearnerConfig


@struct.dataclass
class LossOutput:
    """What a loss knows besides its value."""

    td_errors: Array
    """[T', B] target minus prediction, for the T' steps that are learned from."""
    mean_q: Array
    """Mean value of the taken actions, as the network predicts it."""
    gate_entropy: Array
    """Mean entropy of the skill decision, nat; log K if it never prefers a skill."""
    skill_distance: Array
    """Mean absolute difference between the skills' Q-values and their mean."""
    skill_load: Array
    """[K] mean weight of each skill."""


def r2d2_loss(
    params: Params,
    target_params: Params,
    trajectory: Trajectory,
    weights: Array,
    discount: Array | float,
    program: Program,
) -> tuple[Array, LossOutput]:
    """Mean squared TD error after burn-in, against n-step double-Q targets (R2D2, section 2.3).

    The first `burn_in_length` steps only bring the recurrent state up to date: with the online
    parameters for the online values, with the target parameters for the target values, on the
    same observations, and without a gradient.

    Args:
        params: online parameters.
        target_params: target parameters.
        trajectory: [T (+ 1), B, ...].
        weights: [B] importance-sampling weights.
        discount: gamma, that of the moment.
        program: its network and its learner's settings.

    Returns:
        The loss and its by-products.
    """
    config = program.config.learner
    burn_in = config.burn_in_length
    online = _outputs_after_burn_in(params, trajectory, burn_in, program.network)
    target = _outputs_after_burn_in(target_params, trajectory, burn_in, program.network)
    chooser = online if config.double_q else target
    best_action = jnp.argmax(chooser.q_values, axis=-1)
    bootstrap = jax.lax.stop_gradient(_pick(target.q_values, best_action))
    learned = dataclasses.replace(
        trajectory,
        actions=trajectory.actions[burn_in:],
        rewards=trajectory.rewards[burn_in:],
        terminated=trajectory.terminated[burn_in:],
    )
    returns = partial(n_step_targets, n_step=config.n_step)
    targets = _targets(learned, bootstrap, discount, returns, config)
    return _loss(online, targets, learned.actions, weights, program)


def pqn_loss(
    params: Params, trajectory: Trajectory, discount: Array | float, program: Program
) -> tuple[Array, LossOutput]:
    """Mean squared TD error against Q(lambda) targets from the network itself (PQN).

    The steps are fresh, so the recurrent state they were taken with serves as the first one;
    there is no burn-in, no replay and no target network. Arguments as for `r2d2_loss`.
    """
    config = program.config.learner
    online = _outputs_after_burn_in(params, trajectory, 0, program.network)
    bootstrap = jax.lax.stop_gradient(online.q_values.max(axis=-1))
    returns = partial(lambda_targets, trace_decay=config.trace_decay)
    targets = _targets(trajectory, bootstrap, discount, returns, config)
    weights = jnp.ones(trajectory.rewards.shape[1])
    return _loss(online, targets, trajectory.actions, weights, program)


def _outputs_after_burn_in(
    params: Params, trajectory: Trajectory, burn_in_length: int, network: QNetwork
) -> QOutput:
    """Outputs for the observations from `burn_in_length` on, warmed up on those before."""
    carry = trajectory.carry
    if burn_in_length > 0:
        warm_up = jax.tree.map(lambda x: x[:burn_in_length], trajectory.obs)
        carry, _ = network.apply(params, warm_up, carry)
        carry = jax.lax.stop_gradient(carry)
    learned = jax.tree.map(lambda x: x[burn_in_length:], trajectory.obs)
    return cast(QOutput, network.apply(params, learned, carry)[1])


def _targets(
    trajectory: Trajectory,
    bootstrap: Array,
    discount: Array | float,
    returns: Callable[[Array, Array, Array], Array],
    config: LearnerConfig,
) -> Array:
    """Targets [T', B] of steps with bootstrap values [T' + 1, B], by `returns` of each sequence."""
    discounts = discount * (1.0 - trajectory.terminated.astype(jnp.float32))
    if config.value_rescaling:
        bootstrap = inverse_rescale(bootstrap)
    targets = jax.vmap(returns, in_axes=1, out_axes=1)(trajectory.rewards, discounts, bootstrap)
    return rescale(targets) if config.value_rescaling else targets


def _loss(
    online: QOutput, targets: Array, actions: Array, weights: Array, program: Program
) -> tuple[Array, LossOutput]:
    """Compare the values of the actions taken [T', B] with their targets [T', B].

    With advantage learning (Bellemare et al. 2016) an action's target is lowered by a
    fraction alpha of what the action is worth less than the best one: the gap between them grows
    by 1 / (1 - alpha), and the best action stays the best.

    With `skill_loss` "each" it is not the mixture that is compared but each skill, its squared
    error weighted by its skill weight (Jacobs et al. 1991, eq. 1.2). Skills whose mixture is
    compared make up for each other's errors; those compared one by one compete for the steps.
    """
    config = program.config.learner
    predictions = _pick(online.q_values[:-1], actions)
    if config.advantage_learning > 0:
        targets -= config.advantage_learning * (online.q_values[:-1].max(axis=-1) - predictions)
    targets = jax.lax.stop_gradient(targets)
    td_errors = targets - predictions
    squared_errors = td_errors**2
    if config.skill_loss == "each":
        of_skills = targets[..., None] - _pick(online.skill_q_values[:-1], actions[..., None])
        squared_errors = (online.skill_weights[:-1] * of_skills**2).sum(axis=-1)
    loss = 0.5 * (weights[None] * squared_errors).mean()
    entropy, load = gate_entropy(online.skill_weights).mean(), online.skill_weights.mean((0, 1))
    if config.gate_entropy_weight > 0:
        spread = load_entropy(load, program.axis_name)
        loss += config.gate_entropy_weight * (entropy - spread)
    return loss, LossOutput(
        td_errors=jax.lax.stop_gradient(td_errors),
        mean_q=predictions.mean(),
        gate_entropy=entropy,
        skill_distance=skill_distance(online.skill_q_values).mean(),
        skill_load=load,
    )


def gate_entropy(skill_weights: Array) -> Array:
    """Entropy of skill decisions [..., K], nat; 0 if one skill has all the weight."""
    return -(skill_weights * jnp.log(jnp.maximum(skill_weights, 1e-12))).sum(axis=-1)


def load_entropy(load: Array, axis_name: str | None) -> Array:
    """Entropy of the mean weights [K] of the skills, nat; log K if all are used alike.

    On several devices each is given those of its shard; the mean of the results is the entropy of
    the mean over all, and so are the gradients. The gradient of -sum m log m is -log m, up to a
    constant that a sum of weights of 1 takes out: what stands in the logarithm needs none.
    """
    of_all = jax.lax.stop_gradient(mean(load, axis_name))
    return -(load * jnp.log(jnp.maximum(of_all, 1e-12))).sum()


def skill_distance(skill_q_values: Array) -> Array:
    """How far the skills' Q-values [..., K, A] are apart: mean absolute deviation over skills."""
    center = skill_q_values.mean(axis=-2, keepdims=True)
    return jnp.abs(skill_q_values - center).mean(axis=(-2, -1))


def _pick(q_values: Array, actions: Array) -> Array:
    """Values [...] of actions [...] out of [..., A]; the adjoint of a gather would be slow."""
    chosen = jax.nn.one_hot(actions, q_values.shape[-1], dtype=q_values.dtype)
    return (q_values * chosen).sum(axis=-1)
