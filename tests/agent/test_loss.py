"""Both losses against a slow implementation, their gradients against finite differences of it."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import learning_oracle as oracle
import numpy as np
import pytest
from small_problems import (
    NUM_ACTIONS,
    as_batch,
    in_float64,
    random_episodes,
    random_params,
    small_network,
)

from sqn_jax.agent import Trajectory
from sqn_jax.agent.loss import gate_entropy, pqn_loss, r2d2_loss, skill_distance
from sqn_jax.agent.program import Program
from sqn_jax.config import LearnerConfig, TrainConfig

LENGTH, BATCH = 9, 2
WEIGHTS = np.array([1.0, 0.3])
CONFIG = LearnerConfig(burn_in_length=3, n_step=2, discount=0.9, trace_decay=0.7)
GAPS = dataclasses.replace(CONFIG, advantage_learning=0.5)

r2d2_value = jax.jit(r2d2_loss, static_argnames="program")
pqn_value = jax.jit(pqn_loss, static_argnames="program")
r2d2_slope = jax.jit(
    jax.grad(r2d2_loss, argnums=(0, 1, 2), has_aux=True, allow_int=True), static_argnames="program"
)
pqn_slope = jax.jit(jax.grad(pqn_loss, argnums=0, has_aux=True), static_argnames="program")


@dataclasses.dataclass
class Problem:
    """Random networks and episodes, some of whose steps end truly."""

    algo: Any
    network: Any
    params: Any
    target_params: Any
    episodes: Trajectory

    def program(self, config: LearnerConfig) -> Program:
        settings = TrainConfig(algo=self.algo, network=self.network.config, learner=config)
        return Program(settings, LENGTH, NUM_ACTIONS)

    def r2d2_arguments(self, config: LearnerConfig, discount: Any = None) -> tuple[Any, ...]:
        """Those of `r2d2_loss`; the discount is the configured one if None."""
        discount = config.discount if discount is None else discount
        given = (self.params, self.target_params, self.episodes, jnp.asarray(WEIGHTS, jnp.float32))
        return (*given, discount, self.program(config))

    def pqn_arguments(self, config: LearnerConfig, discount: Any = None) -> tuple[Any, ...]:
        """Those of `pqn_loss`."""
        discount = config.discount if discount is None else discount
        return self.params, self.episodes, discount, self.program(config)


def problem(algo: str, seed: int = 20, **kwargs: Any) -> Problem:
    rng = np.random.default_rng(seed)
    network = small_network(algo, **kwargs)
    return Problem(
        algo,
        network,
        random_params(network, rng),
        random_params(network, rng),
        random_episodes(rng, LENGTH, BATCH, terminated=0.15),
    )


def r2d2(problem: Problem, config: LearnerConfig) -> tuple[float, Any]:
    loss, output = r2d2_value(*problem.r2d2_arguments(config))
    return float(loss), output


def r2d2_by_hand(
    problem: Problem, config: LearnerConfig, algo: str, params: Any = None, frozen: Any = None
) -> tuple[float, np.ndarray]:
    return oracle.r2d2_loss(
        algo,
        in_float64(problem.params) if params is None else params,
        in_float64(problem.target_params),
        as_batch(problem.episodes),
        WEIGHTS,
        frozen_params=frozen,
        burn_in_length=config.burn_in_length,
        n_step=config.n_step,
        discount=config.discount,
        double_q=config.double_q,
        value_rescaling=config.value_rescaling,
        advantage_learning=config.advantage_learning,
    )


def pqn_by_hand(
    problem: Problem, config: LearnerConfig, algo: str, params: Any = None, frozen: Any = None
) -> tuple[float, np.ndarray]:
    return oracle.pqn_loss(
        algo,
        in_float64(problem.params) if params is None else params,
        as_batch(problem.episodes),
        frozen_params=frozen,
        trace_decay=config.trace_decay,
        discount=config.discount,
        value_rescaling=config.value_rescaling,
        advantage_learning=config.advantage_learning,
    )


SWITCHES: list[dict[str, Any]] = [
    {},
    {"double_q": False},
    {"value_rescaling": False},
    {"burn_in_length": 0},
    {"advantage_learning": 0.7},
    {"n_step": 20, "discount": 1.0, "burn_in_length": 1},
]


@pytest.mark.parametrize("changes", SWITCHES, ids=str)
def test_the_r2d2_loss_equals_the_slow_one(changes: dict[str, Any]) -> None:
    given = problem("sqn")
    config = dataclasses.replace(CONFIG, **changes)
    loss, output = r2d2(given, config)
    expected_loss, expected_errors = r2d2_by_hand(given, config, "sqn")
    assert output.td_errors.shape == (LENGTH - config.burn_in_length, BATCH)
    np.testing.assert_allclose(output.td_errors, expected_errors, atol=3e-5)
    np.testing.assert_allclose(loss, expected_loss, rtol=5e-5)
    if changes:
        assert abs(loss - r2d2_by_hand(given, CONFIG, "sqn")[0]) > 1e-3, "the switch does nothing"


@pytest.mark.parametrize("algo", ["r2d2", "dqn"])
def test_the_r2d2_loss_of_the_other_networks_equals_the_slow_one(algo: str) -> None:
    given = problem(algo, layer_norm=True)
    loss, output = r2d2(given, CONFIG)
    expected_loss, expected_errors = r2d2_by_hand(given, CONFIG, algo)
    np.testing.assert_allclose(output.td_errors, expected_errors, atol=3e-5)
    np.testing.assert_allclose(loss, expected_loss, rtol=5e-5)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"value_rescaling": False},
        {"trace_decay": 0.0},
        {"trace_decay": 1.0},
        {"advantage_learning": 0.7},
    ],
    ids=str,
)
def test_the_pqn_loss_equals_the_slow_one(changes: dict[str, Any]) -> None:
    given = problem("sqn", layer_norm=True)
    config = dataclasses.replace(CONFIG, **changes)
    loss, output = pqn_value(*given.pqn_arguments(config))
    expected_loss, expected_errors = pqn_by_hand(given, config, "sqn")
    # Burn-in, n and the importance weights are no matter of this method.
    assert output.td_errors.shape == (LENGTH, BATCH)
    np.testing.assert_allclose(output.td_errors, expected_errors, atol=3e-5)
    np.testing.assert_allclose(loss, expected_loss, rtol=5e-5)


@pytest.mark.parametrize("method", ["r2d2", "pqn"])
def test_a_discount_of_the_moment_takes_the_place_of_the_configured_one(method: str) -> None:
    given, now = problem("sqn"), jnp.float32(0.6)
    config = dataclasses.replace(CONFIG, discount=0.6)
    if method == "r2d2":
        loss, _ = r2d2_value(*given.r2d2_arguments(CONFIG, now))
        expected, _ = r2d2_by_hand(given, config, "sqn")
    else:
        loss, _ = pqn_value(*given.pqn_arguments(CONFIG, now))
        expected, _ = pqn_by_hand(given, config, "sqn")
    np.testing.assert_allclose(loss, expected, rtol=5e-5)


def slope_along(loss: Any, params: Any, direction: Any) -> float:
    """Central difference of a loss along a direction in parameter space."""
    step = 1e-6
    ahead = jax.tree.map(lambda p, d: p + step * d, params, direction)
    behind = jax.tree.map(lambda p, d: p - step * d, params, direction)
    return (loss(ahead) - loss(behind)) / (2 * step)


@pytest.mark.parametrize("config", [CONFIG, GAPS], ids=["plain", "advantage learning"])
@pytest.mark.parametrize("method", ["r2d2", "pqn"])
def test_only_predictions_after_burn_in_carry_a_gradient(
    method: str, config: LearnerConfig
) -> None:
    """The slow loss is differentiated with its targets and its burn-in held fast."""
    given = problem("sqn", seed=21)
    frozen = in_float64(given.params)
    if method == "r2d2":
        (gradient, target_gradient, _), _ = r2d2_slope(*given.r2d2_arguments(config))
        assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(target_gradient))
        by_hand = r2d2_by_hand
    else:
        gradient, _ = pqn_slope(*given.pqn_arguments(config))
        by_hand = pqn_by_hand

    rng = np.random.default_rng(22)
    for module in frozen["params"]:

        def draw(path: Any, leaf: np.ndarray, module: str = module) -> np.ndarray:
            return rng.normal(size=leaf.shape) * (path[1].key == module)

        direction = jax.tree_util.tree_map_with_path(draw, frozen)
        expected = slope_along(
            lambda params: by_hand(given, config, "sqn", params, frozen)[0], frozen, direction
        )
        products = jax.tree.map(lambda g, d: (g * d).sum(), in_float64(gradient), direction)
        np.testing.assert_allclose(
            sum(jax.tree.leaves(products)), expected, rtol=1e-3, atol=2e-5, err_msg=module
        )
        assert abs(expected) > 1e-4, f"nothing flows into {module}"


def test_the_loss_hangs_on_what_was_seen_in_burn_in_but_sends_no_gradient_there() -> None:
    given = problem("sqn")
    burn_in = CONFIG.burn_in_length

    def slope(config: LearnerConfig) -> np.ndarray:
        (_, _, gradient), _ = r2d2_slope(*given.r2d2_arguments(config))
        return np.abs(np.asarray(gradient.obs.ranges)).max(axis=(1, 2))

    assert (slope(CONFIG)[:burn_in] == 0).all()
    assert (slope(CONFIG)[burn_in:-1] > 0).all()
    assert (slope(dataclasses.replace(CONFIG, burn_in_length=0))[:burn_in] > 0).all()

    obs = given.episodes.obs
    shifted = obs.replace(ranges=obs.ranges.at[0].add(0.5))
    elsewhere = dataclasses.replace(given, episodes=given.episodes.replace(obs=shifted))
    assert abs(r2d2(given, CONFIG)[0] - r2d2(elsewhere, CONFIG)[0]) > 1e-4


@pytest.mark.parametrize("method", ["r2d2", "pqn"])
def test_the_recurrent_state_at_the_beginning_counts(method: str) -> None:
    given = problem("sqn", layer_norm=method == "pqn")
    moved = given.episodes.replace(carry=given.episodes.carry + 0.5)
    losses = []
    for episodes in (given.episodes, moved):
        each = dataclasses.replace(given, episodes=episodes)
        if method == "r2d2":
            losses.append(r2d2(each, CONFIG)[0])
        else:
            losses.append(float(pqn_value(*each.pqn_arguments(CONFIG))[0]))
    assert abs(losses[0] - losses[1]) > 1e-4


def test_what_was_done_and_earned_in_burn_in_does_not_matter() -> None:
    given = problem("sqn")
    episodes = given.episodes
    burn_in = CONFIG.burn_in_length
    other = episodes.replace(
        actions=episodes.actions.at[:burn_in].set(2 - episodes.actions[:burn_in]),
        rewards=episodes.rewards.at[:burn_in].add(7.0),
        terminated=episodes.terminated.at[:burn_in].set(True),
    )
    assert r2d2(given, CONFIG)[0] == r2d2(dataclasses.replace(given, episodes=other), CONFIG)[0]


@pytest.mark.parametrize("method", ["r2d2", "pqn"])
def test_the_last_observation_counts_at_a_time_limit_and_not_after_a_true_end(method: str) -> None:
    given = problem("sqn", layer_norm=method == "pqn")

    def last_errors(episodes: Trajectory) -> np.ndarray:
        each = dataclasses.replace(given, episodes=episodes)
        if method == "r2d2":
            output = r2d2(each, CONFIG)[1]
        else:
            output = pqn_value(*each.pqn_arguments(CONFIG))[1]
        return np.asarray(output.td_errors)

    for ended in (False, True):
        flags = jnp.zeros((LENGTH, BATCH), bool).at[-1].set(ended)
        episodes = given.episodes.replace(terminated=flags)
        other = episodes.replace(obs=jax.tree.map(lambda x: x.at[-1].add(1.0), episodes.obs))
        moved = np.abs(last_errors(episodes) - last_errors(other))[-1]
        assert (moved == 0).all() if ended else (moved > 1e-4).all()


def test_scalars_to_log_are_what_they_say() -> None:
    given = problem("sqn")
    _, output = r2d2(given, CONFIG)
    batch, burn_in = as_batch(given.episodes), CONFIG.burn_in_length
    online, carry = oracle.after_burn_in(
        "sqn", in_float64(given.params), in_float64(given.params), batch, burn_in
    )
    taken = [
        online[t, b, batch.actions[burn_in + t, b]]
        for t in range(LENGTH - burn_in)
        for b in range(BATCH)
    ]
    np.testing.assert_allclose(output.mean_q, np.mean(taken), atol=1e-5)
    outputs = oracle.forward(
        "sqn", in_float64(given.params), batch.ranges[burn_in:], batch.goal[burn_in:], carry
    )
    weights = outputs.skill_weights.reshape(-1, 2)
    entropies = [-sum(p * np.log(p) for p in row) for row in weights]
    np.testing.assert_allclose(output.gate_entropy, np.mean(entropies), atol=1e-5)
    # With two skills each is half their difference away from the mean.
    apart = np.abs(outputs.skill_q_values[:, :, 0] - outputs.skill_q_values[:, :, 1]) / 2
    np.testing.assert_allclose(output.skill_distance, apart.mean(), atol=1e-5)


def test_gate_entropy_and_skill_distance_by_hand() -> None:
    decisions = jnp.array([[1.0, 0.0], [0.5, 0.5], [0.25, 0.75]])
    np.testing.assert_allclose(
        gate_entropy(decisions), [0.0, np.log(2), 0.5623351446188083], atol=1e-6
    )
    # Skills 1, 5 and 3, 3: deviations 1, 1, 0 and 1, 1, 0 from the means 2 and 4, and so on.
    q_values = jnp.array([[1.0, 5.0], [3.0, 3.0]])
    assert float(skill_distance(q_values)) == 1.0
