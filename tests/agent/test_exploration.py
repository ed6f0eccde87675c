"""The schedule and the ladder by hand, and how often which action is chosen."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from sqn_jax.agent.exploration import (
    draw_exploration,
    epsilon_greedy,
    epsilon_per_robot,
    epsilon_schedule,
)
from sqn_jax.config import ExplorationConfig

PAPER = ExplorationConfig(epsilon_start=0.4, epsilon_end=0.1)


@jax.jit
def greedy(key: jax.Array, q_values: jax.Array, epsilon: jax.Array) -> jax.Array:
    return epsilon_greedy(q_values, epsilon, *draw_exploration(key, epsilon.shape, 4))


@pytest.mark.parametrize(
    ("progress", "expected"), [(0.0, 0.4), (0.5, 0.25), (0.9, 0.13), (1.0, 0.1), (1.5, 0.1)]
)
def test_epsilon_falls_along_a_line_and_then_stays(progress: float, expected: float) -> None:
    np.testing.assert_allclose(epsilon_schedule(jnp.float32(progress), PAPER), expected, rtol=1e-6)


def test_a_shorter_decay_ends_sooner() -> None:
    config = ExplorationConfig(epsilon_start=0.4, epsilon_end=0.1, decay_fraction=0.5)
    epsilons = [float(epsilon_schedule(jnp.float32(p), config)) for p in (0.0, 0.25, 0.5, 0.8)]
    np.testing.assert_allclose(epsilons, [0.4, 0.25, 0.1, 0.1], rtol=1e-6)


def test_without_a_ladder_all_robots_explore_alike() -> None:
    np.testing.assert_allclose(epsilon_per_robot(jnp.float32(0.5), 3, PAPER), [0.25] * 3, rtol=1e-6)


def test_the_ladder_spreads_the_robots_from_zero_to_twice_the_schedule() -> None:
    config = ExplorationConfig(epsilon_start=0.4, epsilon_end=0.1, ladder=True)
    np.testing.assert_allclose(
        epsilon_per_robot(jnp.float32(0.0), 5, config), [0, 0.2, 0.4, 0.6, 0.8], rtol=1e-6
    )
    np.testing.assert_allclose(
        epsilon_per_robot(jnp.float32(1.0), 5, config), [0, 0.05, 0.1, 0.15, 0.2], rtol=1e-6
    )


def test_the_ladder_has_no_rung_above_one() -> None:
    config = ExplorationConfig(epsilon_start=0.8, epsilon_end=0.1, ladder=True)
    np.testing.assert_allclose(
        epsilon_per_robot(jnp.float32(0.0), 5, config), [0, 0.4, 0.8, 1, 1], rtol=1e-6
    )


def test_each_robot_takes_a_random_action_as_often_as_its_epsilon_says() -> None:
    """The best action is also among the random ones: it is chosen 1 - epsilon + epsilon / A."""
    draws, num_actions = 20_000, 4
    epsilons = [0.0, 0.1, 0.5, 1.0]
    best = [2, 0, 3, 1]
    # Robots of one kind stand side by side; all are drawn in one call.
    q_values = jnp.repeat(jax.nn.one_hot(jnp.array(best), num_actions), draws, axis=0)
    actions = greedy(jax.random.key(1), q_values, jnp.repeat(jnp.array(epsilons), draws))
    assert actions.dtype == jnp.int32
    for index, epsilon in enumerate(epsilons):
        counts = np.bincount(actions[index * draws : (index + 1) * draws], minlength=num_actions)
        expected = np.full(num_actions, epsilon / num_actions)
        expected[best[index]] += 1 - epsilon
        if epsilon == 0:
            assert counts[best[index]] == draws
        else:
            assert stats.chisquare(counts, draws * expected).pvalue > 0.001


def test_whether_to_explore_says_nothing_about_the_action_then_taken() -> None:
    """With one number for both draws, low epsilons would only ever explore the first actions."""
    draws = 20_000
    q_values = jnp.tile(jnp.array([[0.0, 0.0, 0.0, 1.0]]), (draws, 1))
    actions = np.asarray(greedy(jax.random.key(2), q_values, jnp.full(draws, 0.2)))
    others = np.bincount(actions, minlength=4)[:3]
    assert stats.chisquare(others).pvalue > 0.001
