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

from sqn_jax.agent import Trajectory, make_network
from sqn_jax.agent.trajectory import over_robots
from sqn_jax.config import NetworkConfig
from sqn_jax.env import EnvParams, step, true_ranges
from sqn_jax.training.rollout import (
    ActorState,
    episode_metrics,
    join_windows,
    random_draws,
    restart_at_goal,
    start_actors,
    unroll,
)

LENGTH, ROBOTS, ACTIONS = 14, 3, 5
NETWORK = make_network("sqn", NetworkConfig(hidden_size=8), ACTIONS)


@partial(jax.jit, static_argnames=("network", "num_steps"))
def act(
    key: Array,
    params: Any,
    actors: ActorState,
    epsilon: Array,
    env_params: EnvParams,
    network: Any,
    *,
    num_steps: int,
) -> tuple[ActorState, Trajectory]:
    """An unroll with all its randomness from one key."""
    draws = random_draws(key, num_steps, epsilon.shape[0])
    return unroll(draws, params, actors, epsilon, env_params, network)


@partial(jax.jit, static_argnames=("num_envs", "network"))
def start(key: Array, num_envs: int, env_params: EnvParams, network: Any) -> ActorState:
    """Robots from one key."""
    return start_actors(jax.random.split(key, num_envs), env_params, network)


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
def actors(room: EnvParams) -> ActorState:
    return start(jax.random.key(1), ROBOTS, room, NETWORK)


@pytest.fixture(scope="module")
def half_random(room: EnvParams, params: Any, actors: ActorState) -> Any:
    """Last state and trajectory of robots that act at random half of the time."""
    epsilon = jnp.array([0.5] * ROBOTS)
    return act(jax.random.key(8), params, actors, epsilon, room, NETWORK, num_steps=LENGTH)


def test_robots_start_apart_from_each_other_in_free_space_without_a_memory(
    actors: ActorState,
) -> None:
    poses, goals = np.asarray(actors.env_state.pose), np.asarray(actors.env_state.goal)
    assert len({tuple(row) for row in poses.round(4)}) == ROBOTS
    assert len(set(poses[:, 2].round(4))) == ROBOTS
    corners = np.array([[0.65, 0.65], [3.35, 0.65], [0.65, 2.35], [3.35, 2.35]])
    for place in np.concatenate([poses[:, :2], goals]):
        assert np.hypot(*(corners - place).T).min() <= 0.5 + 1e-3
    assert not np.asarray(actors.env_state.step).any()
    assert actors.carry.shape == (ROBOTS, 8)
    assert not np.asarray(actors.carry).any()


def test_trajectories_have_the_promised_shapes(half_random: Any) -> None:
    last, trajectory = half_random
    assert trajectory.obs.ranges.shape == (LENGTH + 1, ROBOTS, 71)
    assert trajectory.obs.goal.shape == (LENGTH + 1, ROBOTS, 2)
    for array, dtype in (
        (trajectory.actions, jnp.int32),
        (trajectory.rewards, jnp.float32),
        (trajectory.terminated, jnp.bool_),
        (trajectory.info["goal_distance"], jnp.float32),
        (trajectory.info["covered_area"], jnp.float32),
        (trajectory.info["collision"], jnp.bool_),
    ):
        assert array.shape == (LENGTH, ROBOTS)
        assert array.dtype == dtype
    assert trajectory.carry.shape == (ROBOTS, 8)
    assert trajectory.poses.shape == (LENGTH + 1, ROBOTS, 3)
    assert trajectory.goals.shape == (ROBOTS, 2)
    assert trajectory.output.skill_weights.shape == (LENGTH, ROBOTS, 2)
    assert trajectory.output.skill_q_values.shape == (LENGTH, ROBOTS, 2, ACTIONS)
    assert np.asarray(last.env_state.step).tolist() == [LENGTH] * ROBOTS
    assert not np.asarray(trajectory.terminated).any(), "a time limit is no end"


def test_taking_the_actions_again_step_by_step_gives_the_same_episode(
    room: EnvParams, actors: ActorState, half_random: Any
) -> None:
    last, trajectory = half_random
    obs, state = actors.obs, actors.env_state
    np.testing.assert_array_equal(trajectory.goals, state.goal)
    keys = jax.random.split(jax.random.key(3), ROBOTS)
    collisions, areas = 0, 0.0
    for t in range(LENGTH):
        np.testing.assert_allclose(trajectory.obs.ranges[t], obs.ranges, atol=1e-5)
        np.testing.assert_allclose(trajectory.obs.goal[t], obs.goal, atol=1e-5)
        np.testing.assert_allclose(trajectory.poses[t], state.pose, atol=1e-5)
        obs, state, reward, _, truncated, info = step_all(keys, state, trajectory.actions[t], room)
        np.testing.assert_allclose(trajectory.rewards[t], reward, atol=1e-5)
        np.testing.assert_allclose(
            trajectory.info["goal_distance"][t], info["goal_distance"], atol=1e-5
        )
        np.testing.assert_array_equal(trajectory.info["collision"][t], info["collision"])
        np.testing.assert_allclose(
            trajectory.info["covered_area"][t], info["covered_area"], atol=1e-5
        )
        assert np.asarray(truncated).tolist() == [t == LENGTH - 1] * ROBOTS
        collisions += int(info["collision"].sum())
        areas += float(info["covered_area"].sum())
    np.testing.assert_allclose(trajectory.obs.ranges[LENGTH], obs.ranges, atol=1e-5)
    np.testing.assert_allclose(last.obs.goal, obs.goal, atol=1e-5)
    np.testing.assert_allclose(trajectory.poses[LENGTH], state.pose, atol=1e-5)
    np.testing.assert_allclose(last.env_state.pose, state.pose, atol=1e-5)
    # The episode is worth repeating: it has walls, turns and new places in it.
    assert collisions > 0
    assert areas > 0
    assert len(np.unique(trajectory.actions)) == ACTIONS


def test_the_network_says_of_the_whole_sequence_what_it_said_on_the_way(
    params: Any, half_random: Any
) -> None:
    """So its recurrent state was carried from step to step, from that in the episodes on."""
    last, trajectory = half_random
    obs = jax.tree.map(lambda x: x[:-1], trajectory.obs)
    carry, output = NETWORK.apply(params, obs, trajectory.carry)
    np.testing.assert_allclose(trajectory.output.skill_weights, output.skill_weights, atol=1e-5)
    np.testing.assert_allclose(trajectory.output.skill_q_values, output.skill_q_values, atol=1e-4)
    np.testing.assert_allclose(last.carry, carry, atol=1e-5)


def test_with_epsilon_zero_every_action_is_the_best_one(
    room: EnvParams, params: Any, actors: ActorState
) -> None:
    epsilon = jnp.array([0.0, 0.0, 1.0])
    _, trajectory = act(jax.random.key(4), params, actors, epsilon, room, NETWORK, num_steps=LENGTH)
    output = trajectory.output
    q_values = np.einsum("tnk,tnka->tna", output.skill_weights, output.skill_q_values)
    np.testing.assert_allclose(output.q_values, q_values, atol=1e-4)
    best = q_values.argmax(axis=-1) == np.asarray(trajectory.actions)
    assert best[:, :2].all()
    assert not best[:, 2].all()


def test_random_actions_are_even_and_independent_over_steps_and_robots(
    room: EnvParams, params: Any, actors: ActorState
) -> None:
    drawn = []
    for seed in range(30):
        key, ones = jax.random.key(100 + seed), jnp.ones(ROBOTS)
        _, trajectory = act(key, params, actors, ones, room, NETWORK, num_steps=LENGTH)
        drawn.append(np.asarray(trajectory.actions))
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
    room: EnvParams, params: Any, actors: ActorState
) -> None:
    epsilon, half = jnp.zeros(ROBOTS), LENGTH // 2
    last, whole = act(jax.random.key(5), params, actors, epsilon, room, NETWORK, num_steps=LENGTH)
    middle, first = act(jax.random.key(6), params, actors, epsilon, room, NETWORK, num_steps=half)
    end, second = act(jax.random.key(7), params, middle, epsilon, room, NETWORK, num_steps=half)
    np.testing.assert_array_equal(first.carry, actors.carry)
    np.testing.assert_array_equal(second.carry, middle.carry)
    assert np.asarray(middle.carry).any()
    np.testing.assert_allclose(end.carry, last.carry, atol=1e-4)
    np.testing.assert_array_equal(np.concatenate([first.actions, second.actions]), whole.actions)
    joined = join_windows(jax.tree.map(lambda *x: jnp.stack(x), first, second))
    fields = ("rewards", "poses", "goals", "info", "output")
    expected = whole.only(*fields)
    assert jax.tree.structure(joined) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(joined), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-3)


def test_reading_noise_is_drawn_anew_for_every_step_and_robot(
    actors: ActorState, params: Any
) -> None:
    """Robots with a network of zeros stand still: what changes in their readings is noise."""
    noisy = small_room(LENGTH, range_noise=0.2)
    still = jax.tree.map(jnp.zeros_like, params)
    epsilon = jnp.zeros(ROBOTS)
    _, trajectory = act(jax.random.key(8), still, actors, epsilon, noisy, NETWORK, num_steps=LENGTH)
    np.testing.assert_allclose(trajectory.poses[0], trajectory.poses[-1], atol=1e-6)
    # The start of this actors was seen without noise. All readings are below 5 m.
    noise = np.asarray(trajectory.obs.ranges[1:]) / np.asarray(actors.obs.ranges) - 1
    assert 0.15 < np.abs(noise).max() <= 0.2 + 1e-5
    flat = noise.reshape(LENGTH * ROBOTS, -1)
    correlations = np.corrcoef(flat)
    np.fill_diagonal(correlations, 0.0)
    assert np.abs(correlations).max() < 0.6


def random_trajectory(rng: np.random.Generator, length: int, robots: int) -> Trajectory:
    def floats(*shape: int) -> Array:
        return jnp.asarray(rng.random(shape), jnp.float32)

    poses, rewards = floats(length + 1, robots, 3), floats(length, robots)
    info = {"goal_distance": floats(length, robots), "collision": floats(length, robots) < 0.5}
    info["covered_area"] = floats(length, robots)
    return Trajectory(poses=poses, rewards=rewards, info=info)


def test_metrics_are_those_counted_in_a_loop() -> None:
    length, robots, radius = 9, 40, 0.1
    trajectory = jax.device_get(random_trajectory(np.random.default_rng(2), length, robots))
    metrics = episode_metrics(trajectory, jnp.float32(radius))
    info, poses = trajectory.info, np.asarray(trajectory.poses)
    first_entries = []
    for n in range(robots):
        entered = [t for t in range(length) if info["goal_distance"][t, n] < radius]
        steps = entered[0] + 1 if entered else length
        first_entries.append(steps if entered else None)
        path = sum(float(np.hypot(*(poses[t + 1, n, :2] - poses[t, n, :2]))) for t in range(steps))
        assert bool(metrics.success[n]) == bool(entered)
        assert int(metrics.time_steps[n]) == steps
        assert int(metrics.collisions[n]) == sum(bool(x) for x in info["collision"][:, n])
        np.testing.assert_allclose(metrics.path_length[n], path, rtol=1e-5)
        np.testing.assert_allclose(
            metrics.mean_reward[n], np.mean(np.asarray(trajectory.rewards)[:, n]), rtol=1e-5
        )
        np.testing.assert_allclose(
            metrics.covered_area[n], np.sum(np.asarray(info["covered_area"])[:, n]), rtol=1e-5
        )
    # Among them: reached with the first step, with the last, in between, and not at all.
    assert {1, length, None} <= set(first_entries)


def test_parts_of_a_trajectory_are_cut_out_along_the_right_axes() -> None:
    """Robot n, step t: every number says where it belongs."""
    length, robots = 4, 3
    steps = 10.0 * np.arange(length)[:, None] + np.arange(robots)
    moments = 10.0 * np.arange(length + 1)[:, None] + np.arange(robots)
    whole = Trajectory(
        obs=moments,
        actions=steps,
        rewards=steps,
        terminated=steps,
        carry=np.arange(robots),
        poses=moments,
        goals=np.arange(robots),
        info={"collision": steps},
        output=steps,
        covered=moments,
    )
    begun = whole.first_steps(2)
    for tree, rows in ((begun.info["collision"], 2), (begun.poses, 3), (begun.covered, 3)):
        np.testing.assert_array_equal(tree, moments[:rows])
    np.testing.assert_array_equal(begun.goals, [0, 1, 2])
    one, two = whole.of_robots(1), whole.of_robots(slice(1, None))
    np.testing.assert_array_equal(one.obs, moments[:, 1])
    np.testing.assert_array_equal(two.info["collision"], steps[:, 1:])
    assert one.goals == one.carry == 1
    np.testing.assert_array_equal(two.carry, [1, 2])
    learning = whole.for_learning()
    assert learning.poses is learning.goals is learning.info is learning.output is None
    assert learning.obs is whole.obs
    joined = over_robots(lambda *x, axis: np.concatenate(x, axis), whole.of_robots(slice(1)), two)
    for ours, theirs in zip(jax.tree.leaves(joined), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_robots_at_their_goal_begin_anew_and_the_others_go_on(room: EnvParams) -> None:
    actors = start(jax.random.key(21), 40, room, NETWORK)
    rng = np.random.default_rng(22)
    away = rng.uniform(0.0, 0.6, 40) * np.where(rng.random(40) < 0.5, 1, -1)
    goals = np.asarray(actors.env_state.pose[:, :2]) + np.stack([away, np.zeros(40)], axis=1)
    state = dataclasses.replace(
        actors.env_state, goal=jnp.asarray(goals, jnp.float32), step=jnp.full(40, 9)
    )
    carry = jnp.asarray(rng.normal(size=actors.carry.shape), jnp.float32)
    before = dataclasses.replace(actors, env_state=state, carry=carry)
    after, restarted = jax.jit(restart_at_goal, static_argnames="network")(
        jax.random.split(jax.random.key(23), 40), before, room, NETWORK
    )
    expected = np.abs(away) < 0.3
    assert 5 < expected.sum() < 35
    np.testing.assert_array_equal(restarted, expected)
    for new, old in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(np.asarray(new)[~expected], np.asarray(old)[~expected])
    assert (np.asarray(after.env_state.step)[expected] == 0).all()
    assert (np.asarray(after.carry)[expected] == 0).all()
    headings = np.asarray(after.env_state.pose)[expected, 2]
    assert (headings != np.asarray(before.env_state.pose)[expected, 2]).all()
    assert len(np.unique(headings)) == len(headings), "each begins in its own way"
    # What they see is what is seen from where they are now.
    seen = jax.vmap(lambda pose: true_ranges(pose, room))(after.env_state.pose)
    limit = room.config.max_range
    np.testing.assert_allclose(
        np.asarray(after.obs.ranges)[expected], np.asarray(seen)[expected] / limit, atol=1e-5
    )
