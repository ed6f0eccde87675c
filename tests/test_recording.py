"""Recorded episodes stepped through again by hand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from rooms import random_params, small_room

from sqn_jax.agent import initial_carry, make_network
from sqn_jax.config import NetworkConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams, coverage, step
from sqn_jax.evaluate import episode_keys, run_episodes
from sqn_jax.recording import Recording, record_episodes

LENGTH, EPISODES = 9, 3
CONFIG = NetworkConfig(hidden_size=8)
NETWORK = make_network("sqn", CONFIG, NUM_ACTIONS)


@pytest.fixture(autouse=True, scope="module")
def quick_compilation() -> Iterator[None]:
    with compiling_quickly():
        yield


@pytest.fixture(scope="module")
def room() -> EnvParams:
    return small_room(LENGTH)


@pytest.fixture(scope="module")
def params(room: EnvParams) -> Any:
    return random_params(NETWORK, room)


@pytest.fixture(scope="module")
def recording(room: EnvParams, params: Any) -> Recording:
    keys = episode_keys(jax.random.key(5), EPISODES)
    return record_episodes(keys, params, room, algo="sqn", network_config=CONFIG)


def test_the_episodes_are_those_of_the_evaluation(
    recording: Recording, room: EnvParams, params: Any
) -> None:
    keys = episode_keys(jax.random.key(5), EPISODES)
    _, trace = run_episodes(keys, params, room, algo="sqn", network_config=CONFIG)
    np.testing.assert_allclose(
        np.swapaxes(recording.states.pose, 0, 1), trace.poses, atol=1e-4, err_msg="poses"
    )
    np.testing.assert_allclose(recording.states.goal[:, 0], trace.goals)
    np.testing.assert_allclose(
        np.swapaxes(recording.outputs.skill_weights, 0, 1), trace.skill_weights, atol=1e-4
    )


def test_each_step_is_the_one_that_the_simulator_makes(
    recording: Recording, room: EnvParams
) -> None:
    advance = jax.jit(step)
    for episode in (recording.episode(index) for index in range(EPISODES)):
        for t in range(LENGTH):
            state = jax.tree.map(lambda x, t=t: x[t], episode.states)
            obs, after, reward, *_, info = advance(
                jax.random.key(0), state, episode.actions[t], room
            )
            expected = (
                jax.tree.map(lambda x, t=t: x[t + 1], (episode.observations, episode.states)),
                episode.rewards[t],
                {name: value[t] for name, value in episode.info.items()},
            )
            for ours, theirs in zip(
                jax.tree.leaves(((obs, after), reward, info)),
                jax.tree.leaves(expected),
                strict=True,
            ):
                np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_what_is_covered_grows_by_what_the_steps_say(recording: Recording, room: EnvParams) -> None:
    cell = room.lattice.cell
    for episode in (recording.episode(index) for index in range(EPISODES)):
        areas = [float(coverage.area(covered, cell)) for covered in episode.states.covered]
        np.testing.assert_allclose(np.diff(areas), episode.info["covered_area"], atol=1e-3)


def test_outputs_and_actions_are_the_networks_for_what_it_saw(
    recording: Recording, params: Any
) -> None:
    episode = recording.episode(1)
    seen = jax.tree.map(lambda x: x[:-1, None], episode.observations)
    _, output = NETWORK.apply(params, seen, initial_carry(CONFIG, 1))
    np.testing.assert_allclose(
        output.skill_q_values[:, 0], episode.outputs.skill_q_values, rtol=1e-3, atol=1e-3
    )
    np.testing.assert_array_equal(jnp.argmax(output.q_values[:, 0], axis=-1), episode.actions)
