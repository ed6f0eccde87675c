"""Targets for one sequence of T steps: n-step double Q and Q(lambda), with value rescaling.

Time runs over `rewards[t]`, `discounts[t]` (gamma, or 0 where the episode truly ended) and
`values[t]`, the value of the observation BEFORE step t; `values[T]` belongs to the observation
after the last step, so that a time limit is bootstrapped through and never looks like an end.
The caller vmaps over sequences.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from jax import Array

RESCALING_EPSILON = 1e-3


def rescale(value: Array) -> Array:
    """The invertible squashing h(x) = sign(x) (sqrt(|x| + 1) - 1) + eps x (R2D2, eq. 1)."""
    return jnp.sign(value) * (jnp.sqrt(jnp.abs(value) + 1) - 1) + RESCALING_EPSILON * value


def inverse_rescale(value: Array) -> Array:
    """The inverse of `rescale` (Pohlen et al. 2018, proposition A.2)."""
    eps = RESCALING_EPSILON
    root = jnp.sqrt(1 + 4 * eps * (jnp.abs(value) + 1 + eps))
    # (root - 1) / (2 eps) without the cancellation that costs single precision three digits.
    ratio = 2 * (jnp.abs(value) + 1 + eps) / (root + 1)
    return jnp.sign(value) * (ratio * ratio - 1)


def n_step_targets(rewards: Array, discounts: Array, values: Array, *, n_step: int) -> Array:
    """Discounted sum of up to n rewards plus the discounted value reached.

    G_t = r_t + g_t r_{t+1} + ... + (g_t ... g_{t+n-1}) V_{t+n}; near the end of the sequence the
    sum is shorter and bootstraps from V_T (n = T from t = 0 is the Monte Carlo return plus V_T).

    Args:
        rewards: [T].
        discounts: [T] gamma after each step, 0 after a true end.
        values: [T + 1] bootstrap values.
        n_step: at least 1.

    Returns:
        [T] targets.
    """
    chex.assert_rank([rewards, discounts, values], 1)
    chex.assert_equal_shape([rewards, discounts, values[1:]])
    length = rewards.shape[0]
    # Beyond the end a step earns nothing and is not discounted: the value V_T stays what it is.
    rewards = jnp.concatenate([rewards, jnp.zeros(n_step - 1)])
    discounts = jnp.concatenate([discounts, jnp.ones(n_step - 1)])
    values = jnp.concatenate([values[1:], jnp.full(n_step - 1, values[-1])])
    targets = values[n_step - 1 : n_step - 1 + length]
    for offset in reversed(range(n_step)):
        steps = slice(offset, offset + length)
        targets = rewards[steps] + discounts[steps] * targets
    return targets


def lambda_targets(rewards: Array, discounts: Array, values: Array, *, trace_decay: float) -> Array:
    """Q(lambda) returns without cutting (Peng and Williams 1996; PQN, Gallici et al. 2024).

    G_t = r_t + g_t [(1 - lambda) V_{t+1} + lambda G_{t+1}] with G_T = V_T. lambda = 0 is one-step
    Q-learning, lambda = 1 the Monte Carlo return bootstrapped at the end.

    Args:
        rewards: [T].
        discounts: [T] gamma after each step, 0 after a true end.
        values: [T + 1] greedy values.
        trace_decay: lambda in 0..1.

    Returns:
        [T] targets.
    """
    chex.assert_rank([rewards, discounts, values], 1)
    chex.assert_equal_shape([rewards, discounts, values[1:]])

    def backward(later: Array, step: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, discount, value = step
        target = reward + discount * ((1 - trace_decay) * value + trace_decay * later)
        return target, target

    _, targets = jax.lax.scan(backward, values[-1], (rewards, discounts, values[1:]), reverse=True)
    return targets
