"""Evaluation of a fixed policy: the same bits alone or in company, the same tasks for everyone."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import random_params, small_room

from sqn_jax.agent import Trajectory, make_network
from sqn_jax.config import Algorithm, EnvConfig, NetworkConfig
from sqn_jax.env import EnvParams, make_env, step
from sqn_jax.env.prepare import with_noise
from sqn_jax.evaluation import episodes
from sqn_jax.training.rollout import EpisodeMetrics, episode_metrics

LENGTH = 25
NETWORK = NetworkConfig(hidden_size=16)


@pytest.fixture(scope="module")
def room() -> EnvParams:
    """Under noise on command and readings."""
    return small_room(LENGTH, velocity_noise=0.2, range_noise=0.3)


FIELDS = ("obs", "actions", "rewards", "poses", "goals", "info", "output")


def run(
    keys: jax.Array,
    env_params: EnvParams,
    algo: Algorithm = "sqn",
    seed: int = 0,
    fields: tuple[str, ...] = FIELDS,
    **how: Any,
) -> tuple[list[EpisodeMetrics], Trajectory]:
    network = make_network(algo, NETWORK, 5)
    params = random_params(network, env_params, seed)
    return episodes.run_episodes(keys, params, env_params, network, fields=fields, **how)


def assert_same_bits(one: Any, other: Any) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for ours, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("algo", ["sqn", "dqn"])
def test_an_episode_is_the_same_bit_for_bit_alone_and_beside_others(
    algo: Algorithm, room: EnvParams
) -> None:
    keys = episodes.episode_keys(jax.random.key(1), 9)
    together, trajectory = run(keys, room, algo)
    assert len(np.unique(trajectory.poses[-1, :, 0])) == 9, "they are to go different ways"
    for index in range(9):
        alone, own = run(keys[index : index + 1], room, algo)
        mine = slice(index, index + 1)
        assert_same_bits(alone, jax.tree.map(lambda x, mine=mine: x[mine], together))
        assert_same_bits(own, trajectory.of_robots(mine))


def test_only_the_fields_that_were_asked_for_are_brought_to_the_host(room: EnvParams) -> None:
    keys = episodes.episode_keys(jax.random.key(1), 3)
    metrics, everything = run(keys, room)
    same, few = run(keys, room, fields=("poses", "info"))
    assert_same_bits(same, metrics)
    assert_same_bits(few, everything.only("poses", "info"))


def test_more_episodes_than_a_batch_holds_go_in_several_and_keep_their_order(
    room: EnvParams, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = episodes.episode_keys(jax.random.key(2), 7)
    whole, trajectory = run(keys, room)
    monkeypatch.setattr(episodes, "BATCH", 3)
    counts: list[int] = []
    parts, of_parts = run(keys, room, on_batch=counts.append)
    assert counts == [3, 3, 1]
    np.testing.assert_array_equal(of_parts.goals, trajectory.goals)
    np.testing.assert_array_equal(of_parts.poses[0], trajectory.poses[0])
    np.testing.assert_array_equal(parts[0].time_steps, whole[0].time_steps)


def test_the_first_episodes_are_the_same_however_many_follow() -> None:
    few, many = (episodes.episode_keys(jax.random.key(3), count) for count in (4, 11))
    np.testing.assert_array_equal(jax.random.key_data(few), jax.random.key_data(many)[:4])
    assert len(np.unique(jax.random.key_data(many), axis=0)) == 11


def test_every_policy_meets_the_same_tasks(room: EnvParams) -> None:
    keys = episodes.episode_keys(jax.random.key(4), 6)
    trajectories = [
        run(keys, room, algo, seed)[1] for algo, seed in (("sqn", 0), ("sqn", 1), ("dqn", 0))
    ]
    for trajectory in trajectories[1:]:
        np.testing.assert_array_equal(trajectory.goals, trajectories[0].goals)
        np.testing.assert_array_equal(trajectory.poses[0], trajectories[0].poses[0])
        assert (trajectory.poses[-1] != trajectories[0].poses[-1]).any()


def test_both_goal_radii_are_judged_from_the_same_episodes(room: EnvParams) -> None:
    keys = episodes.episode_keys(jax.random.key(5), 40)
    (own, near, far), trajectory = run(keys, room, goal_radii=(0.3, 1.0, 3.0))
    for metrics, radius in ((near, 1.0), (far, 3.0)):
        inside = trajectory.info["goal_distance"] < radius
        np.testing.assert_array_equal(metrics.success, inside.any(axis=0))
        for episode in range(40):
            first = np.flatnonzero(inside[:, episode])
            expected = first[0] + 1 if first.size else LENGTH
            assert metrics.time_steps[episode] == expected
    assert near.success.sum() < far.success.sum()
    default = run(keys, room)[0]
    np.testing.assert_array_equal(default[0].time_steps, own.time_steps)


def test_a_robot_stepped_by_hand_meets_the_tasks_and_the_noise_of_the_policies(
    room: EnvParams,
) -> None:
    keys = episodes.episode_keys(jax.random.key(6), 5)
    _, trajectory = run(keys, room)
    step_keys, actors = episodes.start_by_hand(keys, room)
    np.testing.assert_array_equal(actors.env_state.pose, trajectory.poses[0])
    np.testing.assert_array_equal(actors.env_state.goal, trajectory.goals)
    for t in range(LENGTH):
        actions = jnp.asarray(trajectory.actions[t])
        actors, step_taken = episodes.step_by_hand(step_keys[t], actors, actions, room)
        np.testing.assert_allclose(step_taken.rewards, trajectory.rewards[t], atol=1e-4)
    np.testing.assert_allclose(actors.env_state.pose, trajectory.poses[-1], atol=1e-4)


@pytest.mark.parametrize("unit", ["relative", pytest.param("absolute", marks=pytest.mark.long)])
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
        step_all(step_keys[0], actors.env_state, actions, world)
        for (step_keys, actors), world in zip(worlds, (made, later, quiet), strict=True)
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


def test_the_metrics_are_those_of_the_trajectory(room: EnvParams) -> None:
    (metrics,), trajectory = run(episodes.episode_keys(jax.random.key(9), 8), room)
    again = episode_metrics(trajectory, room.goal_radius)
    for one, other in zip(jax.tree.leaves(metrics), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
