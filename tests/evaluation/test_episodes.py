"""Evaluation of a fixed policy: the same bits alone or in company, the same tasks for everyone."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import random_params, small_room

from sqn_jax.agent import make_network
from sqn_jax.config import Algorithm, EnvConfig, NetworkConfig
from sqn_jax.env import EnvParams, make_env, step
from sqn_jax.env.prepare import with_noise
from sqn_jax.evaluation import episodes
from sqn_jax.training.rollout import EpisodeSummary, Trace, summarize

LENGTH = 25
NETWORK = NetworkConfig(hidden_size=16)


@pytest.fixture(scope="module")
def room() -> EnvParams:
    """Under noise on command and readings."""
    return small_room(LENGTH, velocity_noise=0.2, range_noise=0.3)


def drive(
    keys: jax.Array, env_params: EnvParams, algo: Algorithm = "sqn", seed: int = 0, **how: Any
) -> tuple[list[EpisodeSummary], Trace]:
    params = random_params(make_network(algo, NETWORK, 5), env_params, seed)
    return episodes.run_episodes(keys, params, env_params, algo=algo, network_config=NETWORK, **how)


@pytest.mark.parametrize("algo", ["sqn", "dqn"])
def test_an_episode_is_the_same_bit_for_bit_alone_and_beside_others(
    algo: Algorithm, room: EnvParams
) -> None:
    keys = episodes.episode_keys(jax.random.key(1), 9)
    together, trace = drive(keys, room, algo)
    assert len(np.unique(trace.poses[-1, :, 0])) == 9, "they are to go different ways"
    for index in range(9):
        alone, own_trace = drive(keys[index : index + 1], room, algo)
        mine = jax.tree.map(lambda x, i=index: x[i : i + 1], together)
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(mine), strict=True):
            np.testing.assert_array_equal(one, other)
        for name in ("poses", "rewards", "goal_distances", "skill_q_values"):
            whole = getattr(trace, name)[:, index : index + 1]
            np.testing.assert_array_equal(getattr(own_trace, name), whole)


def test_more_episodes_than_lanes_go_in_batches_and_keep_their_order(
    room: EnvParams, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = episodes.episode_keys(jax.random.key(2), 7)
    whole, trace = drive(keys, room)
    monkeypatch.setattr(episodes, "LANES", 3)
    counts: list[int] = []
    parts, part_trace = drive(keys, room, on_batch=counts.append)
    assert counts == [3, 3, 1]
    np.testing.assert_array_equal(part_trace.goals, trace.goals)
    np.testing.assert_array_equal(part_trace.poses[0], trace.poses[0])
    np.testing.assert_array_equal(parts[0].time_steps, whole[0].time_steps)


def test_the_first_episodes_are_the_same_however_many_follow() -> None:
    few, many = (episodes.episode_keys(jax.random.key(3), count) for count in (4, 11))
    np.testing.assert_array_equal(jax.random.key_data(few), jax.random.key_data(many)[:4])
    assert len(np.unique(jax.random.key_data(many), axis=0)) == 11


def test_every_policy_meets_the_same_tasks(room: EnvParams) -> None:
    keys = episodes.episode_keys(jax.random.key(4), 6)
    traces = [
        drive(keys, room, algo, seed)[1] for algo, seed in (("sqn", 0), ("sqn", 1), ("dqn", 0))
    ]
    for trace in traces[1:]:
        np.testing.assert_array_equal(trace.goals, traces[0].goals)
        np.testing.assert_array_equal(trace.poses[0], traces[0].poses[0])
        assert (trace.poses[-1] != traces[0].poses[-1]).any()


def test_both_goal_radii_are_judged_from_the_same_episodes(room: EnvParams) -> None:
    keys = episodes.episode_keys(jax.random.key(5), 40)
    (own, near, far), trace = drive(keys, room, goal_radii=(0.3, 1.0, 3.0))
    for summary, radius in ((near, 1.0), (far, 3.0)):
        inside = trace.goal_distances < radius
        np.testing.assert_array_equal(summary.success, inside.any(axis=0))
        for episode in range(40):
            first = np.flatnonzero(inside[:, episode])
            expected = first[0] + 1 if first.size else LENGTH
            assert summary.time_steps[episode] == expected
    assert near.success.sum() < far.success.sum()
    default = drive(keys, room)[0]
    np.testing.assert_array_equal(default[0].time_steps, own.time_steps)


def test_a_robot_stepped_by_hand_meets_the_tasks_and_the_noise_of_the_policies(
    room: EnvParams,
) -> None:
    keys = episodes.episode_keys(jax.random.key(6), 5)
    _, trace = drive(keys, room)
    step_keys, _, state = episodes.start_by_hand(keys, room)
    np.testing.assert_array_equal(state.pose, trace.poses[0])
    np.testing.assert_array_equal(state.goal, trace.goals)
    actions = _actions_of(trace)
    for t in range(LENGTH):
        _, state, reward, *_ = episodes.step_by_hand(step_keys[t], state, actions[t], room)
        np.testing.assert_allclose(reward, trace.rewards[t], atol=1e-4)
    np.testing.assert_allclose(state.pose, trace.poses[-1], atol=1e-4)


def _actions_of(trace: Trace) -> np.ndarray:
    """The greedy actions, from the skills' values and weights (paper eq. 6)."""
    q_values = (trace.skill_weights[..., None] * trace.skill_q_values).sum(axis=2)
    return q_values.argmax(axis=-1)


@pytest.mark.parametrize("unit", ["relative", "absolute"])
def test_noise_set_afterwards_is_the_noise_of_a_world_made_with_it(unit: Any) -> None:
    config = EnvConfig(velocity_noise_unit=unit, range_noise_unit=unit, max_steps=5)
    made = make_env("maze", dataclasses.replace(config, velocity_noise=0.3, range_noise=0.4))
    quiet = make_env("maze", config)
    later = with_noise(quiet, 0.3, 0.4)
    key = jax.random.key(8)
    keys = episodes.episode_keys(key, 20)
    worlds = [episodes.start_by_hand(keys, world) for world in (made, later, quiet)]
    actions = jnp.arange(20) % 5
    step_all = jax.jit(jax.vmap(step, in_axes=(0, 0, 0, None)))
    stepped = [
        step_all(step_keys[0], state, actions, world)
        for (step_keys, _, state), world in zip(worlds, (made, later, quiet), strict=True)
    ]
    for one, other in zip(jax.tree.leaves(stepped[0]), jax.tree.leaves(stepped[1]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    assert (np.asarray(stepped[0][0].ranges) != np.asarray(stepped[2][0].ranges)).any()
    assert (np.asarray(stepped[0][1].pose) != np.asarray(stepped[2][1].pose)).any()


def test_noise_levels_share_one_program() -> None:
    quiet = make_env("maze", EnvConfig(max_steps=5))
    low, high = with_noise(quiet, 0.1, 0.0), with_noise(quiet, 0.3, 0.0)
    assert jax.tree.structure(low) == jax.tree.structure(high)
    assert with_noise(low, 0.0, 0.0).config == quiet.config
    for levels in ((-0.1, 0.0), (0.0, float("nan"))):
        with pytest.raises(ValueError, match="noise"):
            with_noise(quiet, *levels)


def test_the_summary_is_that_of_the_trace(room: EnvParams) -> None:
    (summary,), trace = drive(episodes.episode_keys(jax.random.key(9), 8), room)
    again = summarize(trace, room.goal_radius)
    for one, other in zip(jax.tree.leaves(summary), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
