"""What a run keeps to: equal for equal settings, so that nothing is compiled twice."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from small_problems import NUM_ACTIONS

from sqn_jax.agent.program import Program
from sqn_jax.config import ReplayConfig
from sqn_jax.config.presets import PRESETS

SMOKE = PRESETS["smoke"]


def test_programs_of_equal_settings_are_equal_and_traced_once() -> None:
    one, other = (Program(dataclasses.replace(SMOKE), 60, NUM_ACTIONS) for _ in range(2))
    assert one.network is one.network
    assert one.optimizer is one.optimizer
    assert one == other
    assert hash(one) == hash(other)
    assert one != dataclasses.replace(one, max_steps=30)
    assert one != dataclasses.replace(one, config=dataclasses.replace(SMOKE, seed=1))
    traces = []

    def traced(x: jax.Array, program: Program) -> jax.Array:
        traces.append(program.optimizer)
        return x + program.max_steps

    compiled = jax.jit(traced, static_argnames="program")
    np.testing.assert_array_equal([compiled(1, one), compiled(1, other)], [61, 61])
    assert len(traces) == 1


def test_a_changed_copy_makes_its_own_network_and_optimizer() -> None:
    one = Program(SMOKE, 60, NUM_ACTIONS)
    network, optimizer = one.network, one.optimizer
    wide = dataclasses.replace(SMOKE.network, hidden_size=7)
    other = dataclasses.replace(one, config=dataclasses.replace(SMOKE, network=wide))
    assert other.network.config.hidden_size == 7
    assert other.network != network
    assert other.optimizer is not optimizer


def test_windows_and_updates_by_hand() -> None:
    # Windows of 30 steps; 16 robots in minibatches of 8.
    learner = dataclasses.replace(SMOKE.learner, num_passes=3)
    config = dataclasses.replace(SMOKE, learner=learner, total_episodes=5 * 16)
    pqn = Program(config, 90, NUM_ACTIONS)
    assert (pqn.window_length, pqn.num_windows, pqn.num_minibatches) == (30, 3, 2)
    assert pqn.updates_per_round == 3 * 2 * 3
    # Whole chunks of 2 rounds.
    assert pqn.total_updates == 6 * 18
    settings = {"method": "r2d2", "updates_per_round": 7, "replay": ReplayConfig(32, 16)}
    r2d2 = Program(dataclasses.replace(config, **settings), 90, NUM_ACTIONS)
    assert (r2d2.window_length, r2d2.num_windows, r2d2.updates_per_round) == (90, 1, 7)
    assert r2d2.total_updates == 6 * 7


def test_a_window_that_does_not_divide_the_episode_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^learner.window_length is 30, expected a divisor .* 59"):
        Program(SMOKE, 59, NUM_ACTIONS)


@pytest.mark.parametrize(
    ("changes", "max_steps", "message"),
    [
        ({}, 45, "learner.window_length is 30, expected a divisor of the episode's 45 steps"),
        (
            {"method": "r2d2"},
            5,
            "learner.burn_in_length is 5, expected less than the episode's 5 steps",
        ),
        (
            {"total_episodes": 10**9, "learner": dataclasses.replace(SMOKE.learner, num_passes=9)},
            60,
            "total_episodes is 1000000000, expected fewer than 2147483648 updates, at 36 a round",
        ),
        (
            {"learner": dataclasses.replace(SMOKE.learner, discount_start=1.0)},
            60,
            "learner.discount_start is 1.0, expected below 1",
        ),
    ],
)
def test_what_no_program_can_be_made_of_is_refused(
    changes: dict[str, Any], max_steps: int, message: str
) -> None:
    config = dataclasses.replace(SMOKE, **changes)
    with pytest.raises(ValueError, match="expected") as caught:
        Program(config, max_steps, NUM_ACTIONS)
    assert str(caught.value) == message
    if config.method == "r2d2":  # One step is left to learn from.
        assert Program(config, max_steps + 1, NUM_ACTIONS).num_windows == 1
