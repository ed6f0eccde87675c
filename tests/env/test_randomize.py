"""Every robot in a world of its own does what a robot alone with these settings does."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly

from sqn_jax.config import EnvConfig, RandomizationConfig, TrainConfig
from sqn_jax.env import EnvParams, make_env, navigation
from sqn_jax.env.prepare import with_noise
from sqn_jax.env.randomize import randomized, robot_axes, robots_own
from sqn_jax.maps import load_map
from sqn_jax.training.rollout import own_worlds

ALL = RandomizationConfig(velocity_noise=0.3, range_noise=0.6, speed=0.2)
COUNT = 256
"""As the presets have it."""


@pytest.fixture(scope="module")
def maze() -> EnvParams:
    return make_env("maze")


def shares(maze: EnvParams) -> np.ndarray:
    """How far along each robot is in what differs, [N, 3] in 0..1, read back from its world."""
    worlds = randomized(maze, ALL, COUNT)
    speed = np.asarray(worlds.commands[:, 1, 0]) / 2.5
    return np.stack(
        [
            np.asarray(worlds.velocity_noise[:, 0]) / (0.3 * 2.5),
            np.asarray(worlds.range_noise) / 0.6,
            (speed - 0.8) / 0.4,
        ],
        axis=1,
    )


def test_worlds_are_spread_evenly_and_independently(maze: EnvParams) -> None:
    """In each slice of 1/256 there is one of 256 robots; no two of the three go together."""
    found = shares(maze)
    for column in found.T:
        np.testing.assert_allclose(np.sort(column), (np.arange(COUNT) + 0.5) / COUNT, atol=1e-6)
    assert np.abs(np.corrcoef(found.T) - np.eye(3)).max() < 0.1


def test_neither_epsilon_nor_the_minibatch_goes_with_the_noise(maze: EnvParams) -> None:
    """Epsilon grows with the robot's number; robot n is in minibatch n mod M."""
    found = shares(maze)
    number = np.arange(COUNT)
    assert np.abs(np.corrcoef(found.T, number)[3, :3]).max() < 0.1
    for batch in range(16):
        assert np.abs(found[batch::16].mean(axis=0) - 0.5).max() < 0.1


def test_a_robot_among_many_does_what_it_does_alone(maze: EnvParams) -> None:
    worlds = randomized(maze, ALL, COUNT)
    assert robots_own(worlds) == ["commands", "velocity_noise", "range_noise"]
    keys = jax.random.split(jax.random.key(0), COUNT)
    actions = jnp.arange(COUNT) % navigation.NUM_ACTIONS
    with compiling_quickly():
        reset = jax.jit(jax.vmap(navigation.reset, in_axes=(0, robot_axes(worlds))))
        step = jax.jit(jax.vmap(navigation.step, in_axes=(0, 0, 0, robot_axes(worlds))))
        _, states = reset(keys, worlds)
        obs, after, _, _, _, _ = step(keys, states, actions, worlds)
        alone_step = jax.jit(navigation.step)
        for robot, share in list(enumerate(shares(maze)))[:12]:
            speed = 0.8 + 0.4 * share[2]
            # Noise is in units of the nominal speed, whatever the robot's own.
            alone = with_noise(maze, 0.3 * share[0], 0.6 * share[1])
            alone = dataclasses.replace(alone, commands=maze.commands * speed)
            state = jax.tree.map(lambda x, i=robot: x[i], states)
            obs_alone, after_alone, *_ = alone_step(keys[robot], state, actions[robot], alone)
            np.testing.assert_allclose(after.pose[robot], after_alone.pose, atol=1e-5)
            np.testing.assert_allclose(obs.ranges[robot], obs_alone.ranges, atol=2e-4)
    forward = np.asarray(actions) == navigation.FORWARD
    moved = np.hypot(*(np.asarray(after.pose) - np.asarray(states.pose))[forward, :2].T)
    assert len(np.unique(np.round(moved, 3))) > forward.sum() // 2


def test_the_mirrored_half_lives_on_the_map_turned_over(maze: EnvParams) -> None:
    """What a mirrored robot sees and gets is what another does on the map turned left for right."""
    drawn = load_map("maze")
    width = drawn.size_m[0]

    def over(points: np.ndarray) -> np.ndarray:
        return points * [-1.0, 1.0] + [width, 0.0]

    turned = make_env(
        dataclasses.replace(
            drawn,
            occupied=drawn.occupied[:, ::-1],
            spawn_points=over(drawn.spawn_points),
            evaluation_points=over(drawn.evaluation_points),
        )
    )
    worlds = randomized(maze, RandomizationConfig(mirror=True), COUNT)
    assert robots_own(worlds) == ["commands", "mirrored"]
    axes = robot_axes(worlds)
    keys = jax.random.split(jax.random.key(3), COUNT)
    pose, goal = jax.vmap(navigation.sample_task, in_axes=(0, axes))(keys, worlds)
    odd = np.array([bin(number).count("1") % 2 == 1 for number in range(COUNT)])
    x, y, heading = np.asarray(pose).T
    there_pose = jnp.asarray(np.stack([width - x, y, np.pi - heading], axis=1))
    there_goal = jnp.asarray(over(np.asarray(goal)), jnp.float32)
    actions = jax.random.randint(keys[0], (20, COUNT), 0, navigation.NUM_ACTIONS)

    def run_robots(params: EnvParams, pose: jax.Array, goal: jax.Array, axes: object) -> Any:
        reset = jax.vmap(navigation.reset_to, in_axes=(0, 0, 0, axes))
        one = jax.vmap(navigation.step, in_axes=(0, 0, 0, axes))

        def step(state: Any, action: jax.Array) -> Any:
            obs, state, _, _, _, info = one(keys, state, action, params)
            return state, (obs.ranges, obs.goal, info["collision"], info["reward_navigation"])

        return jax.lax.scan(step, reset(keys, pose, goal, params)[1], actions)[1]

    with compiling_quickly():
        mirrored = jax.jit(lambda: run_robots(worlds, pose, goal, axes))()
        here = jax.jit(lambda: run_robots(maze, pose, goal, None))()
        there = jax.jit(lambda: run_robots(turned, there_pose, there_goal, None))()
    assert there[2].any()
    for side, other in ((~odd, here), (odd, there)):
        for seen, expected in zip(mirrored, other, strict=True):
            close = np.isclose(np.asarray(seen)[:, side], np.asarray(expected)[:, side], atol=2e-3)
            # A beam that grazes a corner may pass it on one side: rounding differs.
            assert close.mean() > 0.995
    for batch in range(16):
        assert np.asarray(worlds.mirrored)[batch::16].sum() == COUNT / 32


def test_without_randomisation_nothing_is_there(maze: EnvParams) -> None:
    same = randomized(maze, RandomizationConfig(), COUNT)
    assert robots_own(same) == []
    assert same.config == maze.config
    assert jax.tree.leaves(same)[0] is jax.tree.leaves(maze)[0]


def test_each_device_has_its_own_robots_worlds(maze: EnvParams) -> None:
    whole = own_worlds(maze, ALL, COUNT, None)

    def share(_: jax.Array) -> tuple[jax.Array, jax.Array]:
        worlds = own_worlds(maze, ALL, COUNT, "device")
        return worlds.velocity_noise, worlds.commands

    noise, commands = jax.vmap(share, axis_name="device")(jnp.zeros(2))
    np.testing.assert_array_equal(noise.reshape(COUNT, 2), whole.velocity_noise)
    np.testing.assert_array_equal(commands.reshape(COUNT, 5, 2), whole.commands)


def test_an_evaluation_has_none_of_it() -> None:
    """What a policy's robot is configured with is the nominal robot."""
    config = TrainConfig(randomization=ALL)
    assert config.env == EnvConfig()


@pytest.mark.parametrize("name", ["velocity_noise", "range_noise", "speed"])
def test_less_than_nothing_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"randomization\.{name} is -0\.1, expected"):
        RandomizationConfig(**{name: -0.1})
