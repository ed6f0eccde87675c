"""Whole calls of both learn functions against updates made by hand."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning_oracle import adam_step
from small_problems import (
    HIDDEN,
    NUM_ACTIONS,
    of_robots,
    random_episodes,
    random_params,
    small_network,
)

from sqn_jax.agent import Trajectory, pqn, r2d2, replay
from sqn_jax.agent.learner import LearnerState, discount_schedule
from sqn_jax.agent.loss import pqn_loss, r2d2_loss
from sqn_jax.agent.program import Program, make_optimizer
from sqn_jax.config import LearnerConfig, NetworkConfig, ReplayConfig, TrainConfig

LENGTH = 5
MAX_NORM = 1.2
NETWORK = small_network("r2d2")
METRICS = {"loss", "gradient_norm", "mean_q", "gate_entropy", "skill_distance"}


def config_for(method: str, **changes: Any) -> TrainConfig:
    """Two rounds of six robots."""
    learner = {
        "batch_size": 2,
        "learning_rate": 0.01,
        "learning_rate_schedule": "linear",
        "max_grad_norm": MAX_NORM,
        "burn_in_length": 1,
        "n_step": 2,
        "target_update_rate": 0.1,
        **changes.pop("learner", {}),
    }
    settings: dict[str, Any] = {
        "algo": "r2d2",
        "method": method,
        "total_episodes": 12,
        "num_envs": 6,
        "updates_per_round": 6,
        "network": NetworkConfig(hidden_size=HIDDEN),
        "replay": ReplayConfig(capacity=12, min_episodes=6),
        **changes,
    }
    return TrainConfig(**settings, learner=LearnerConfig(**learner))


HALFWAY = {"discount_start": 0.36, "discount": 0.75}
"""After one of two rounds the discount is 1 - sqrt(0.64 x 0.25) = 0.6."""


def program_for(config: TrainConfig) -> Program:
    return Program(config, LENGTH, NUM_ACTIONS)


def fresh_state(
    config: TrainConfig, seed: int, *, use_target: bool, memory: Any = None, rounds: int = 0
) -> LearnerState:
    rng = np.random.default_rng(seed)
    params = random_params(NETWORK, rng)
    return LearnerState(
        params=params,
        target_params=random_params(NETWORK, rng) if use_target else None,
        opt_state=program_for(config).optimizer.init(params),
        memory=memory,
        round=jnp.int32(rounds),
        num_updates=jnp.int32(0),
        num_skipped=jnp.int32(0),
    )


def learn_with(method: Any, config: TrainConfig) -> Any:
    """The learn function of a method with everything static bound, compiled."""
    return jax.jit(partial(method.learn, program=program_for(config)))


class HandMadeAdam:
    """The optimizer of a config in NumPy: linear decay over its updates, clipping, Adam."""

    def __init__(self, config: TrainConfig, params: Any, total_updates: int) -> None:
        self.config, self.total_updates = config.learner, total_updates
        leaves, self.tree = jax.tree.flatten(params)
        self.leaves = [np.asarray(leaf, np.float64) for leaf in leaves]
        self.moments = [(np.zeros_like(leaf), np.zeros_like(leaf)) for leaf in self.leaves]
        self.count = 0
        self.norms: list[float] = []

    @property
    def params(self) -> Any:
        leaves = [jnp.asarray(leaf, jnp.float32) for leaf in self.leaves]
        return jax.tree.unflatten(self.tree, leaves)

    def update(self, gradient: Any) -> None:
        gradients = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(gradient)]
        self.norms.append(np.sqrt(sum((leaf**2).sum() for leaf in gradients)))
        rate = self.config.learning_rate
        if self.config.learning_rate_schedule == "linear":
            rate *= 1 - self.count / self.total_updates
        self.count += 1
        self.leaves, self.moments = adam_step(
            self.leaves,
            gradients,
            self.moments,
            self.count,
            learning_rate=rate,
            epsilon=self.config.adam_epsilon,
            max_norm=self.config.max_grad_norm,
        )


def assert_same_params(ours: Any, by_hand: Any, rate: float) -> None:
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(by_hand), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-3 * rate)


def test_pqn_takes_every_minibatch_of_every_pass_as_done_by_hand() -> None:
    config = config_for("pqn", learner={"num_passes": 2, **HALFWAY})
    state = fresh_state(config, 30, use_target=False, rounds=1)
    episodes = random_episodes(np.random.default_rng(31), LENGTH, 6)
    new_state, metrics = learn_with(pqn, config)(jax.random.key(0), state, episodes)
    program = program_for(config)
    slope = jax.jit(
        jax.value_and_grad(lambda params, part: pqn_loss(params, part, 0.6, program)[0])
    )
    # Two rounds of two passes through three minibatches.
    adam, losses = HandMadeAdam(config, state.params, total_updates=12), []
    # Six robots in minibatches of two: robots 0 and 3, 1 and 4, 2 and 5; then once more.
    for first in (0, 1, 2, 0, 1, 2):
        robots = np.array([first, first + 3])
        loss, gradient = slope(adam.params, of_robots(episodes, robots))
        losses.append(float(loss))
        adam.update(gradient)
    assert min(adam.norms) < MAX_NORM < max(adam.norms), "clipping is to be seen on and off"
    assert_same_params(new_state.params, adam.params, 0.01)
    assert new_state.memory is None
    assert new_state.target_params is None
    assert int(new_state.num_updates) == 6
    assert set(metrics) == METRICS
    np.testing.assert_allclose(metrics["loss"], np.mean(losses), rtol=1e-4)
    np.testing.assert_allclose(metrics["gradient_norm"], np.mean(adam.norms), rtol=1e-4)


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_pqn_hands_out_the_average_of_its_latest_parameters(share: float) -> None:
    config = config_for("pqn", learner={"num_passes": 2, "average_share": share})
    state = fresh_state(config, 34, use_target=True)
    episodes = random_episodes(np.random.default_rng(35), LENGTH, 6)
    learn = learn_with(pqn, config)
    averaged = learn(jax.random.key(0), state, episodes)[0]
    # The average must not steer the learning; without it the same parameters come out.
    plain = dataclasses.replace(state, target_params=None)
    alone = learn_with(pqn, config_for("pqn", learner={"num_passes": 2}))
    assert_same_params(averaged.params, alone(jax.random.key(0), plain, episodes)[0].params, 0.01)
    program, discount = program_for(config), config.learner.discount
    slope = jax.jit(jax.grad(lambda params, part: pqn_loss(params, part, discount, program)[0]))
    adam = HandMadeAdam(config, state.params, total_updates=12)
    history = []
    for first in (0, 1, 2, 0, 1, 2):
        adam.update(slope(adam.params, of_robots(episodes, np.array([first, first + 3]))))
        history.append(jax.tree.map(np.asarray, adam.params))
    # Weight of each update in closed form: with a share of 1 all count alike, with less the latest
    # more. Update t enters with 1 / (1 + share (t - 1)) and is thinned by all that come after.
    steps = np.array([1 / (1 + share * t) for t in range(6)])
    weights = [steps[t] * np.prod(1 - steps[t + 1 :]) for t in range(6)]
    assert sum(weights) == pytest.approx(1)
    if share == 1:
        np.testing.assert_allclose(weights, 1 / 6)
    by_hand = jax.tree.map(lambda *x: sum(w * y for w, y in zip(weights, x, strict=True)), *history)
    assert_same_params(averaged.target_params, by_hand, 0.01)


@pytest.mark.parametrize(("num_passes", "batch_size"), [(1, 2), (2, 3), (1, 6), (1, 1)])
def test_pqn_sees_every_episode_equally_often(
    monkeypatch: pytest.MonkeyPatch, num_passes: int, batch_size: int
) -> None:
    config = config_for("pqn", learner={"batch_size": batch_size, "num_passes": num_passes})
    state = fresh_state(config, 32, use_target=False)
    episodes = random_episodes(np.random.default_rng(33), LENGTH, 6)
    seen: list[list[int]] = []

    def note_robots(params: Any, part: Trajectory, *_: Any) -> None:
        assert part.obs.ranges.shape[:2] == (LENGTH + 1, batch_size)
        # Rewards are random, so that they tell which robot's they are.
        same = np.asarray(part.rewards[:, :, None] == episodes.rewards[:, None]).all(axis=0)
        robots = [int(np.argmax(row)) for row in same]
        np.testing.assert_array_equal(part.carry, episodes.carry[np.array(robots)])
        seen.append(robots)

    def no_step(state: Any, loss_function: Any, program: Any) -> Any:
        loss_function(state.params)
        return state, None, {"loss": jnp.float32(0)}

    monkeypatch.setattr(pqn, "pqn_loss", note_robots)
    monkeypatch.setattr(pqn, "gradient_step", no_step)
    with jax.disable_jit():
        pqn.learn(jax.random.key(0), state, episodes, program_for(config))
    assert len(seen) == num_passes * 6 // batch_size
    times = np.bincount(np.concatenate(seen), minlength=6)
    assert times.tolist() == [num_passes] * 6
    assert all(len(set(robots)) == batch_size for robots in seen)


def test_two_r2d2_updates_are_those_made_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which episodes are drawn is laid down here; all that follows from them is recomputed."""
    drawn, weights = np.array([4, 1, 4]), np.array([0.5, 1.0, 0.5])
    asked: list[dict[str, Any]] = []

    def fixed_sample(key: Any, memory: Any, batch_size: int, **settings: Any) -> Any:
        asked.append({"batch_size": batch_size, **settings})
        items = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[drawn], memory.storage)
        return items, jnp.asarray(drawn), jnp.asarray(weights, jnp.float32)

    monkeypatch.setattr(r2d2.replay, "sample", fixed_sample)
    config = config_for("r2d2", updates_per_round=2, learner={"batch_size": 3, **HALFWAY})
    program = program_for(config)
    episodes = random_episodes(np.random.default_rng(35), LENGTH, 6, terminated=0.1)
    memory = r2d2.init_memory(episodes, program)
    state = fresh_state(config, 34, use_target=True, memory=memory, rounds=1)
    new_state, metrics = learn_with(r2d2, config)(jax.random.key(0), state, episodes)
    exponents = {"priority_exponent": 0.9, "importance_exponent": 0.6}
    assert asked[0] == {"batch_size": 3, **exponents, "axis_name": None}

    # As stored: coarser observations, and an episode begins without a memory.
    coarse = episodes.replace(
        obs=episodes.obs.replace(
            ranges=jnp.round(episodes.obs.ranges * 255) / 255,
            goal=jnp.round(episodes.obs.goal * 65535) / 65535,
        ),
        carry=jnp.zeros_like(episodes.carry),
    )
    part = of_robots(coarse, drawn)
    slope = jax.jit(
        jax.value_and_grad(
            lambda params, target: r2d2_loss(
                params, target, part, jnp.asarray(weights, jnp.float32), 0.6, program
            ),
            has_aux=True,
        )
    )
    adam, target = HandMadeAdam(config, state.params, total_updates=4), state.target_params
    priorities, losses = np.where(np.arange(12) < 6, 1.0, 0.0), []
    for _ in range(2):
        (loss, output), gradient = slope(adam.params, target)
        losses.append(float(loss))
        adam.update(gradient)
        target = jax.tree.map(
            lambda old, new: jnp.float32(0.9) * old + jnp.float32(0.1) * new, target, adam.params
        )
        errors = np.abs(np.asarray(output.td_errors))
        for column, place in enumerate(drawn):
            mixed = 0.9 * errors[:, column].max() + 0.1 * errors[:, column].mean()
            priorities[place] = mixed
    assert_same_params(new_state.params, adam.params, 0.01)
    assert_same_params(new_state.target_params, target, 0.01)
    np.testing.assert_allclose(new_state.memory.priorities, priorities, rtol=2e-3)
    assert int(new_state.memory.size) == 6
    assert int(new_state.num_updates) == 2
    assert set(metrics) == METRICS
    np.testing.assert_allclose(metrics["loss"], np.mean(losses), rtol=1e-4)


def test_r2d2_only_stores_until_there_are_enough_episodes() -> None:
    config = config_for("r2d2", replay=ReplayConfig(capacity=12, min_episodes=7))
    episodes = random_episodes(np.random.default_rng(37), LENGTH, 6)
    memory = r2d2.init_memory(episodes, program_for(config))
    state = fresh_state(config, 36, use_target=True, memory=memory)
    learn = learn_with(r2d2, config)
    waiting, metrics = learn(jax.random.key(0), state, episodes)
    assert int(waiting.memory.size) == 6
    as_before = dataclasses.replace(waiting, memory=memory)
    for before, after in zip(jax.tree.leaves(state), jax.tree.leaves(as_before), strict=True):
        np.testing.assert_array_equal(before, after)
    assert set(metrics) == METRICS
    assert all(np.isnan(value) for value in metrics.values())
    learning, metrics = learn(jax.random.key(1), waiting, episodes)
    assert int(learning.memory.size) == 12
    assert int(learning.num_updates) == 6
    assert all(np.isfinite(value) for value in metrics.values())


def test_r2d2_draws_anew_for_each_update_and_uniformly_if_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Updates of two out of twelve: were the key used again, two priorities at most would move."""
    asked: list[dict[str, Any]] = []
    true_sample = replay.sample

    def noting_sample(*args: Any, **settings: Any) -> Any:
        asked.append(settings)
        return true_sample(*args, **settings)

    monkeypatch.setattr(r2d2.replay, "sample", noting_sample)
    config = config_for("r2d2", replay=ReplayConfig(capacity=12, min_episodes=6, prioritized=False))
    episodes = random_episodes(np.random.default_rng(39), LENGTH, 6)
    memory = r2d2.init_memory(episodes, program_for(config))
    memory = replay.add(memory, r2d2.pack(episodes))
    state = fresh_state(config, 38, use_target=True, memory=memory)
    after = learn_with(r2d2, config)(jax.random.key(2), state, episodes)[0].memory
    uniform = {"priority_exponent": 0.0, "importance_exponent": 0.0, "axis_name": None}
    assert asked
    assert all(settings == uniform for settings in asked)
    before = replay.add(memory, r2d2.pack(episodes)).priorities
    assert 4 <= (np.asarray(after.priorities) != np.asarray(before)).sum() <= 12


def test_the_horizon_grows_by_equal_factors_or_stays() -> None:
    # Horizons 1 / (1 - gamma) from 10 steps to 100, over the square root of 1000 in the middle.
    growing = LearnerConfig(discount_start=0.9, discount=0.99)
    for progress, horizon in ((0.0, 10.0), (0.5, 1000**0.5), (1.0, 100.0), (1.2, 100.0)):
        discount = float(discount_schedule(jnp.float32(progress), growing))
        np.testing.assert_allclose(1 / (1 - discount), horizon, rtol=1e-4)
    constant = LearnerConfig(discount=0.99)
    assert discount_schedule(jnp.float32(0.0), constant) == 0.99


def test_the_learning_rate_falls_to_zero_over_the_run_or_stays() -> None:
    params = {"w": jnp.zeros(1)}
    falling = [0.01, 0.0075, 0.005, 0.0025, 0]
    for schedule, expected in (("linear", falling), ("constant", [0.01] * 5)):
        config = LearnerConfig(learning_rate=0.01, learning_rate_schedule=schedule)
        optimizer = make_optimizer(config, total_updates=4)
        opt_state = optimizer.init(params)
        steps = []
        for _ in range(5):
            # A constant gradient far above epsilon: Adam moves by the learning rate itself.
            updates, opt_state = optimizer.update({"w": jnp.ones(1)}, opt_state, params)
            steps.append(-float(updates["w"][0]))
        np.testing.assert_allclose(steps, expected, rtol=1e-4, atol=1e-9)
