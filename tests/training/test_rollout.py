"""Rollouts repeated step by step by hand, and what is said of them recounted in loops."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from jax import Array
from rooms import random_params, small_room
from scipy import stats

from sqn_jax.agent import make_network
from sqn_jax.config import NetworkConfig
from sqn_jax.env import EnvParams, step, true_ranges
from sqn_jax.training.rollout import (
    Fleet,
    Trace,
    draw_chance,
    join_windows,
    restart_at_goal,
    start_fleet,
    summarize,
    unroll,
)

LENGTH, ROBOTS, ACTIONS = 14, 3, 5
NETWORK = make_network("sqn", NetworkConfig(hidden_size=8), ACTIONS)


@partial(jax.jit, static_argnames=("network", "num_steps"))
def drive(
    key: Array,
    network: Any,
    params: Any,
    fleet: Fleet,
    epsilon: Array,
    env_params: EnvParams,
    *,
    num_steps: int,
) -> Any:
    """An unroll with all its chance from one key."""
    chance = draw_chance(key, num_steps, epsilon.shape[0])
    return unroll(chance, network, params, fleet, epsilon, env_params)


@partial(jax.jit, static_argnames=("num_envs", "network"))
def start(key: Array, num_envs: int, network: Any, env_params: EnvParams) -> Fleet:
    """A fleet from one key."""
    return start_fleet(jax.random.split(key, num_envs), network, env_params)


step_all = jax.jit(jax.vmap(step, in_axes=(0, 0, 0, None)))


@pytest.fixture(autouse=True, scope="module")
def quick_compilation() -> Iterator[None]:
    """Compiling these programs takes longer than running them a few times."""
    with compiling_quickly():
        yield


@pytest.fixture(scope="module")
def room() -> EnvParams:
    return small_room(LENGTH)


@pytest.fixture(scope="module")
def params(room: EnvParams) -> Any:
    return random_params(NETWORK, room)


@pytest.fixture(scope="module")
def fleet(room: EnvParams) -> Fleet:
    return start(jax.random.key(1), ROBOTS, NETWORK, room)


@pytest.fixture(scope="module")
def half_random(room: EnvParams, params: Any, fleet: Fleet) -> Any:
    """Last fleet, episodes and trace of robots that act at random half of the time."""
    epsilon = jnp.array([0.5] * ROBOTS)
    return drive(jax.random.key(8), NETWORK, params, fleet, epsilon, room, num_steps=LENGTH)


def test_robots_start_apart_from_each_other_in_free_space_without_a_memory(fleet: Fleet) -> None:
    poses, goals = np.asarray(fleet.state.pose), np.asarray(fleet.state.goal)
    assert len({tuple(row) for row in poses.round(4)}) == ROBOTS
    assert len(set(poses[:, 2].round(4))) == ROBOTS
    corners = np.array([[0.65, 0.65], [3.35, 0.65], [0.65, 2.35], [3.35, 2.35]])
    for place in np.concatenate([poses[:, :2], goals]):
        assert np.hypot(*(corners - place).T).min() <= 0.5 + 1e-3
    assert not np.asarray(fleet.state.step).any()
    assert fleet.carry.shape == (ROBOTS, 8)
    assert not np.asarray(fleet.carry).any()


def test_episodes_and_traces_have_the_promised_shapes(half_random: Any) -> None:
    last, episodes, trace = half_random
    assert episodes.obs.ranges.shape == (LENGTH + 1, ROBOTS, 71)
    assert episodes.obs.goal.shape == (LENGTH + 1, ROBOTS, 2)
    for array, dtype in (
        (episodes.actions, jnp.int32),
        (episodes.rewards, jnp.float32),
        (episodes.terminated, jnp.bool_),
        (trace.rewards, jnp.float32),
        (trace.goal_distances, jnp.float32),
        (trace.covered_areas, jnp.float32),
        (trace.collisions, jnp.bool_),
    ):
        assert array.shape == (LENGTH, ROBOTS)
        assert array.dtype == dtype
    assert episodes.carry.shape == (ROBOTS, 8)
    assert trace.poses.shape == (LENGTH + 1, ROBOTS, 3)
    assert trace.goals.shape == (ROBOTS, 2)
    assert trace.skill_weights.shape == (LENGTH, ROBOTS, 2)
    assert trace.skill_q_values.shape == (LENGTH, ROBOTS, 2, ACTIONS)
    assert np.asarray(last.state.step).tolist() == [LENGTH] * ROBOTS
    assert not np.asarray(episodes.terminated).any(), "a time limit is no end"


def test_taking_the_actions_again_step_by_step_gives_the_same_episode(
    room: EnvParams, fleet: Fleet, half_random: Any
) -> None:
    last, episodes, trace = half_random
    obs, state = fleet.obs, fleet.state
    np.testing.assert_array_equal(trace.goals, state.goal)
    keys = jax.random.split(jax.random.key(3), ROBOTS)
    collisions, areas = 0, 0.0
    for t in range(LENGTH):
        np.testing.assert_allclose(episodes.obs.ranges[t], obs.ranges, atol=1e-5)
        np.testing.assert_allclose(episodes.obs.goal[t], obs.goal, atol=1e-5)
        np.testing.assert_allclose(trace.poses[t], state.pose, atol=1e-5)
        obs, state, reward, _, truncated, info = step_all(keys, state, episodes.actions[t], room)
        np.testing.assert_allclose(episodes.rewards[t], reward, atol=1e-5)
        np.testing.assert_allclose(trace.rewards[t], reward, atol=1e-5)
        np.testing.assert_allclose(trace.goal_distances[t], info["goal_distance"], atol=1e-5)
        np.testing.assert_array_equal(trace.collisions[t], info["collision"])
        np.testing.assert_allclose(trace.covered_areas[t], info["covered_area"], atol=1e-5)
        assert np.asarray(truncated).tolist() == [t == LENGTH - 1] * ROBOTS
        collisions += int(info["collision"].sum())
        areas += float(info["covered_area"].sum())
    np.testing.assert_allclose(episodes.obs.ranges[LENGTH], obs.ranges, atol=1e-5)
    np.testing.assert_allclose(last.obs.goal, obs.goal, atol=1e-5)
    np.testing.assert_allclose(trace.poses[LENGTH], state.pose, atol=1e-5)
    np.testing.assert_allclose(last.state.pose, state.pose, atol=1e-5)
    # The episode is worth repeating: it has walls, turns and new places in it.
    assert collisions > 0
    assert areas > 0
    assert len(np.unique(episodes.actions)) == ACTIONS


def test_the_network_says_of_the_whole_sequence_what_it_said_on_the_way(
    params: Any, half_random: Any
) -> None:
    """So its recurrent state was carried from step to step, from that in the episodes on."""
    last, episodes, trace = half_random
    obs = jax.tree.map(lambda x: x[:-1], episodes.obs)
    carry, output = NETWORK.apply(params, obs, episodes.carry)
    np.testing.assert_allclose(trace.skill_weights, output.skill_weights, atol=1e-5)
    np.testing.assert_allclose(trace.skill_q_values, output.skill_q_values, atol=1e-4)
    np.testing.assert_allclose(last.carry, carry, atol=1e-5)


def test_with_epsilon_zero_every_action_is_the_best_one(
    room: EnvParams, params: Any, fleet: Fleet
) -> None:
    epsilon = jnp.array([0.0, 0.0, 1.0])
    episodes, trace = drive(
        jax.random.key(4), NETWORK, params, fleet, epsilon, room, num_steps=LENGTH
    )[1:]
    q_values = np.einsum("tnk,tnka->tna", trace.skill_weights, trace.skill_q_values)
    best = q_values.argmax(axis=-1) == np.asarray(episodes.actions)
    assert best[:, :2].all()
    assert not best[:, 2].all()


def test_random_actions_are_even_and_independent_over_steps_and_robots(
    room: EnvParams, params: Any, fleet: Fleet
) -> None:
    drawn = []
    for seed in range(30):
        key, ones = jax.random.key(100 + seed), jnp.ones(ROBOTS)
        episodes = drive(key, NETWORK, params, fleet, ones, room, num_steps=LENGTH)[1]
        drawn.append(np.asarray(episodes.actions))
    actions = np.array(drawn)
    assert stats.chisquare(np.bincount(actions.ravel(), minlength=ACTIONS)).pvalue > 0.001
    for one, other in (
        (actions[:, :-1], actions[:, 1:]),
        (actions[:, :, 0], actions[:, :, 1]),
        (actions[:-1], actions[1:]),
    ):
        pairs = np.bincount((ACTIONS * one + other).ravel(), minlength=ACTIONS**2)
        assert stats.chisquare(pairs).pvalue > 0.001


def test_two_windows_joined_are_the_episode_in_one_go(
    room: EnvParams, params: Any, fleet: Fleet
) -> None:
    epsilon, half = jnp.zeros(ROBOTS), LENGTH // 2
    last, episodes, whole = drive(
        jax.random.key(5), NETWORK, params, fleet, epsilon, room, num_steps=LENGTH
    )
    middle, first_part, first = drive(
        jax.random.key(6), NETWORK, params, fleet, epsilon, room, num_steps=half
    )
    end, second_part, second = drive(
        jax.random.key(7), NETWORK, params, middle, epsilon, room, num_steps=half
    )
    np.testing.assert_array_equal(first_part.carry, fleet.carry)
    np.testing.assert_array_equal(second_part.carry, middle.carry)
    assert np.asarray(middle.carry).any()
    np.testing.assert_allclose(end.carry, last.carry, atol=1e-4)
    np.testing.assert_array_equal(
        np.concatenate([first_part.actions, second_part.actions]), episodes.actions
    )
    joined = join_windows(jax.tree.map(lambda *x: jnp.stack(x), first, second))
    for field in dataclasses.fields(Trace):
        np.testing.assert_allclose(
            getattr(joined, field.name), getattr(whole, field.name), atol=1e-3, err_msg=field.name
        )


def test_reading_noise_is_drawn_anew_for_every_step_and_robot(fleet: Fleet, params: Any) -> None:
    """Robots with a network of zeros stand still: what changes in their readings is noise."""
    noisy = small_room(LENGTH, range_noise=0.2)
    still = jax.tree.map(jnp.zeros_like, params)
    epsilon = jnp.zeros(ROBOTS)
    episodes, trace = drive(
        jax.random.key(8), NETWORK, still, fleet, epsilon, noisy, num_steps=LENGTH
    )[1:]
    np.testing.assert_allclose(trace.poses[0], trace.poses[-1], atol=1e-6)
    # The start of this fleet was seen without noise. All readings are below 5 m.
    noise = np.asarray(episodes.obs.ranges[1:]) / np.asarray(fleet.obs.ranges) - 1
    assert 0.15 < np.abs(noise).max() <= 0.2 + 1e-5
    flat = noise.reshape(LENGTH * ROBOTS, -1)
    correlations = np.corrcoef(flat)
    np.fill_diagonal(correlations, 0.0)
    assert np.abs(correlations).max() < 0.6


def random_trace(rng: np.random.Generator, length: int, robots: int) -> Trace:
    def floats(*shape: int) -> Array:
        return jnp.asarray(rng.random(shape), jnp.float32)

    return Trace(
        poses=floats(length + 1, robots, 3),
        goals=floats(robots, 2),
        rewards=floats(length, robots),
        goal_distances=floats(length, robots),
        collisions=floats(length, robots) < 0.5,
        covered_areas=floats(length, robots),
        skill_weights=floats(length, robots, 2),
        skill_q_values=floats(length, robots, 2, ACTIONS),
    )


def test_summaries_are_those_counted_in_a_loop() -> None:
    length, robots, radius = 9, 40, 0.1
    trace = random_trace(np.random.default_rng(1), length, robots)
    summary = summarize(trace, jnp.float32(radius))
    first_entries = []
    for n in range(robots):
        entered = [t for t in range(length) if trace.goal_distances[t, n] < radius]
        steps = entered[0] + 1 if entered else length
        first_entries.append(steps if entered else None)
        path = sum(
            float(np.hypot(*np.asarray(trace.poses[t + 1, n, :2] - trace.poses[t, n, :2])))
            for t in range(steps)
        )
        assert bool(summary.success[n]) == bool(entered)
        assert int(summary.time_steps[n]) == steps
        assert int(summary.collisions[n]) == sum(bool(x) for x in trace.collisions[:, n])
        np.testing.assert_allclose(summary.path_length[n], path, rtol=1e-5)
        np.testing.assert_allclose(
            summary.mean_reward[n], np.mean(np.asarray(trace.rewards)[:, n]), rtol=1e-5
        )
        np.testing.assert_allclose(
            summary.covered_area[n], np.sum(np.asarray(trace.covered_areas)[:, n]), rtol=1e-5
        )
    # Among them: reached with the first step, with the last, in between, and not at all.
    assert {1, length, None} <= set(first_entries)


def test_robots_at_their_goal_begin_anew_and_the_others_go_on(room: EnvParams) -> None:
    fleet = start(jax.random.key(21), 40, NETWORK, room)
    rng = np.random.default_rng(22)
    away = rng.uniform(0.0, 0.6, 40) * np.where(rng.random(40) < 0.5, 1, -1)
    goals = np.asarray(fleet.state.pose[:, :2]) + np.stack([away, np.zeros(40)], axis=1)
    state = dataclasses.replace(
        fleet.state, goal=jnp.asarray(goals, jnp.float32), step=jnp.full(40, 9)
    )
    carry = jnp.asarray(rng.normal(size=fleet.carry.shape), jnp.float32)
    driven = dataclasses.replace(fleet, state=state, carry=carry)
    after, restarted = jax.jit(restart_at_goal, static_argnames="network")(
        jax.random.split(jax.random.key(23), 40), driven, NETWORK, room
    )
    expected = np.abs(away) < 0.3
    assert 5 < expected.sum() < 35
    np.testing.assert_array_equal(restarted, expected)
    for new, old in zip(jax.tree.leaves(after), jax.tree.leaves(driven), strict=True):
        np.testing.assert_array_equal(np.asarray(new)[~expected], np.asarray(old)[~expected])
    assert (np.asarray(after.state.step)[expected] == 0).all()
    assert (np.asarray(after.carry)[expected] == 0).all()
    headings = np.asarray(after.state.pose)[expected, 2]
    assert (headings != np.asarray(driven.state.pose)[expected, 2]).all()
    assert len(np.unique(headings)) == len(headings), "each begins in its own way"
    # What they see is what is seen from where they are now.
    seen = jax.vmap(lambda pose: true_ranges(pose, room))(after.state.pose)
    limit = room.config.max_range
    np.testing.assert_allclose(
        np.asarray(after.obs.ranges)[expected], np.asarray(seen)[expected] / limit, atol=1e-5
    )
