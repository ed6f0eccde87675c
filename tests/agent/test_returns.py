"""Targets against loops over every step, known values, and identities."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning_oracle import inverse_rescale as bisected
from learning_oracle import lambda_return, n_step_return
from learning_oracle import rescale as squash

from sqn_jax.agent.returns import inverse_rescale, lambda_targets, n_step_targets, rescale

DISCOUNT = 0.9
n_step_jit = jax.jit(n_step_targets, static_argnames="n_step")
lambda_jit = jax.jit(lambda_targets)


def sequence(length: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rewards, discounts (none of them 0) and values of one sequence."""
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=length),
        rng.uniform(0.5, 1.0, length),
        rng.normal(size=length + 1),
    )


def single(*arrays: np.ndarray) -> list[jax.Array]:
    return [jnp.asarray(array, jnp.float32) for array in arrays]


def test_rescaling_takes_known_values() -> None:
    # sqrt(3 + 1) - 1 = 1, sqrt(99 + 1) - 1 = 9, and a thousandth of the argument on top.
    given = jnp.array([0.0, 3.0, -3.0, 99.0, -99.0])
    np.testing.assert_allclose(rescale(given), [0, 1.003, -1.003, 9.099, -9.099], rtol=1e-6)


def test_rescaling_and_its_inverse_agree_with_a_bisection_over_eight_decades() -> None:
    size = np.logspace(-4, 4, 60)
    values = np.concatenate([-size[::-1], [0.0], size])
    squashed = np.array([squash(value) for value in values])
    # Single precision holds h only to 1e-7 near 0, where sqrt(x + 1) - 1 cancels.
    np.testing.assert_allclose(
        rescale(jnp.asarray(values, jnp.float32)), squashed, rtol=2e-6, atol=2e-7
    )
    recovered = inverse_rescale(jnp.asarray(squashed, jnp.float32))
    exact = np.array([bisected(value) for value in squashed])
    np.testing.assert_allclose(exact, values, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(recovered, exact, rtol=5e-6, atol=5e-7)


def test_rescaling_back_and_forth_changes_nothing() -> None:
    values = jnp.asarray(np.linspace(-300, 300, 101), jnp.float32)
    np.testing.assert_allclose(inverse_rescale(rescale(values)), values, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(rescale(inverse_rescale(values)), values, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("length", [1, 3, 10])
@pytest.mark.parametrize("n_step", [1, 2, 3, 5, 10, 13])
def test_n_step_targets_equal_a_loop_over_every_step(length: int, n_step: int) -> None:
    arrays = sequence(length)
    expected = [n_step_return(*arrays, t, n_step) for t in range(length)]
    np.testing.assert_allclose(
        n_step_jit(*single(*arrays), n_step=n_step), expected, rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("length", [1, 3, 10])
@pytest.mark.parametrize("trace_decay", [0.0, 0.3, 0.8, 1.0])
def test_lambda_targets_equal_the_forward_view(length: int, trace_decay: float) -> None:
    arrays = sequence(length, seed=1)
    expected = [lambda_return(*arrays, t, trace_decay) for t in range(length)]
    np.testing.assert_allclose(
        lambda_jit(*single(*arrays), trace_decay=trace_decay), expected, rtol=1e-5, atol=1e-6
    )


def test_a_small_case_worked_out_by_hand() -> None:
    rewards, discounts = jnp.array([1.0, 2.0, 4.0]), jnp.full(3, 0.5)
    values = jnp.array([1000.0, 8.0, 16.0, 32.0])
    # One step: 1 + 8/2, 2 + 16/2, 4 + 32/2. The value before the first step is in no target.
    assert n_step_jit(rewards, discounts, values, n_step=1).tolist() == [5, 10, 20]
    # Two: 1 + 2/2 + 16/4, 2 + 4/2 + 32/4, and one step at the end.
    assert n_step_jit(rewards, discounts, values, n_step=2).tolist() == [6, 12, 20]
    # All: 1 + 2/2 + 4/4 + 32/8.
    assert n_step_jit(rewards, discounts, values, n_step=3).tolist() == [7, 12, 20]
    # Half and half: 2 + (16 + 20)/4 = 11, 1 + (8 + 11)/4 = 5.75.
    assert lambda_jit(rewards, discounts, values, trace_decay=0.5).tolist() == [5.75, 11, 20]


def test_lambda_0_is_one_step_and_lambda_1_and_n_of_the_whole_length_are_monte_carlo() -> None:
    rewards, discounts, values = single(*sequence(6, seed=2))
    one_step = rewards + discounts * values[1:]
    np.testing.assert_allclose(
        lambda_jit(rewards, discounts, values, trace_decay=0.0), one_step, rtol=1e-6
    )
    np.testing.assert_allclose(
        n_step_jit(rewards, discounts, values, n_step=1), one_step, rtol=1e-6
    )
    monte_carlo, following = np.zeros(6), float(values[6])
    for t in reversed(range(6)):
        following = float(rewards[t]) + float(discounts[t]) * following
        monte_carlo[t] = following
    np.testing.assert_allclose(
        lambda_jit(rewards, discounts, values, trace_decay=1.0), monte_carlo, rtol=1e-5
    )
    np.testing.assert_allclose(
        n_step_jit(rewards, discounts, values, n_step=6), monte_carlo, rtol=1e-5
    )


@pytest.mark.parametrize("method", ["n_step", "lambda"])
def test_a_true_end_hides_what_follows_and_a_time_limit_does_not(method: str) -> None:
    rewards, discounts, values = sequence(6, seed=3)

    def targets(discounts: np.ndarray, rewards: np.ndarray, values: np.ndarray) -> np.ndarray:
        arrays = single(rewards, discounts, values)
        if method == "n_step":
            return np.asarray(n_step_jit(*arrays, n_step=4))
        return np.asarray(lambda_jit(*arrays, trace_decay=0.7))

    ended = discounts.copy()
    ended[2] = 0.0
    other_rewards, other_values = rewards.copy(), values.copy()
    other_rewards[3:] += 5
    other_values[3:] += 5
    before, after = (
        targets(ended, rewards, values),
        targets(ended, other_rewards, other_values),
    )
    np.testing.assert_array_equal(before[:3], after[:3])
    assert np.abs(before[3:] - after[3:]).min() > 0.1
    np.testing.assert_allclose(before[2], rewards[2], rtol=1e-6)
    # Without an end the last value is in the targets near the time limit.
    last = values.copy()
    last[6] += 1
    gained = targets(discounts, rewards, last) - targets(discounts, rewards, values)
    np.testing.assert_allclose(gained[5], discounts[5], rtol=1e-4)


def test_a_batch_is_refused_and_so_are_values_without_the_last_one() -> None:
    rewards, discounts, values = single(*sequence(4))
    with pytest.raises(AssertionError):
        n_step_targets(rewards[None], discounts[None], values[None], n_step=1)
    with pytest.raises(AssertionError):
        n_step_targets(rewards, discounts, values[:-1], n_step=1)
    with pytest.raises(AssertionError):
        lambda_targets(rewards, discounts, values[:-1], trace_decay=0.5)
