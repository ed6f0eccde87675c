"""Updates that are no numbers: left out, counted, and without effect on the others."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import (
    HIDDEN,
    NUM_ACTIONS,
    of_robots,
    random_episodes,
    random_params,
    small_network,
)

from sqn_jax.agent import pqn, r2d2, replay
from sqn_jax.agent.learner import LearnerState
from sqn_jax.agent.program import Program
from sqn_jax.config import LearnerConfig, NetworkConfig, ReplayConfig, TrainConfig

NETWORK = small_network("r2d2")
LENGTH = 5


def config_for(num_envs: int, method: Any = "pqn") -> TrainConfig:
    return TrainConfig(
        algo="r2d2",
        method=method,
        total_episodes=60,
        num_envs=num_envs,
        updates_per_round=4,
        network=NetworkConfig(hidden_size=HIDDEN),
        replay=ReplayConfig(capacity=12, min_episodes=num_envs),
        learner=LearnerConfig(
            batch_size=2, learning_rate=0.01, burn_in_length=1, average_share=0.5
        ),
    )


def learnt(method: Any, config: TrainConfig, episodes: Any) -> LearnerState:
    program = Program(config, LENGTH, NUM_ACTIONS)
    rng = np.random.default_rng(5)
    params = random_params(NETWORK, rng)
    state = LearnerState(
        params=params,
        target_params=random_params(NETWORK, rng),
        opt_state=program.optimizer.init(params),
        memory=r2d2.init_memory(episodes, program) if method is r2d2 else None,
        round=jnp.int32(0),
        num_updates=jnp.int32(0),
        num_skipped=jnp.int32(0),
    )
    learn = jax.jit(partial(method.learn, program=program))
    state, _ = learn(jax.random.key(0), state, episodes)
    return state


def assert_same(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_a_minibatch_with_a_bad_reward_is_as_if_it_had_not_been_there(bad: float) -> None:
    """1e30 is a number, but its square is none in single precision."""
    episodes = random_episodes(np.random.default_rng(6), LENGTH, 6)
    # Robots 0 and 3, 1 and 4, 2 and 5 share a minibatch: the second is the bad one.
    rewards = episodes.rewards.at[2, 4].set(bad)
    state = learnt(pqn, config_for(6), dataclasses.replace(episodes, rewards=rewards))
    without = of_robots(episodes, np.array([0, 2, 3, 5]))
    expected = learnt(pqn, config_for(4), without)
    assert_same(state.params, expected.params)
    assert_same(state.opt_state, expected.opt_state)
    assert int(state.num_skipped) == 1
    assert int(expected.num_skipped) == 0
    assert int(state.num_updates) == 3
    for leaf in jax.tree.leaves(state):
        assert np.isfinite(leaf).all()


def test_a_bad_episode_in_the_replay_spoils_neither_parameters_nor_priorities() -> None:
    config = config_for(6, "r2d2")
    episodes = random_episodes(np.random.default_rng(7), LENGTH, 6)
    rewards = episodes.rewards.at[2, 4].set(np.nan)
    bad = dataclasses.replace(episodes, rewards=rewards)
    state = learnt(r2d2, config, bad)
    memory = state.memory
    assert 0 < int(state.num_skipped) <= int(state.num_updates) == 4
    state = dataclasses.replace(state, memory=None)
    for leaf in jax.tree.leaves((state, memory.priorities, memory.max_priority)):
        assert np.isfinite(leaf).all()


def test_a_priority_that_is_no_number_leaves_the_one_before() -> None:
    memory = replay.init({"x": jax.ShapeDtypeStruct((), jnp.float32)}, 4, 4)
    memory = replay.add(memory, {"x": jnp.arange(4.0)})
    memory = replay.update_priorities(memory, jnp.arange(4), jnp.array([1.0, 2.0, 3.0, 4.0]))
    new = jnp.array([jnp.nan, jnp.inf, 5.0])
    memory = replay.update_priorities(memory, jnp.array([0, 1, 2]), new)
    np.testing.assert_array_equal(memory.priorities, [1, 2, 5, 4])
    assert float(memory.max_priority) == 5
