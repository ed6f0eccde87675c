"""What robots are told of their last step, against their actions and where they came from."""

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
from rooms import random_params, small_room

from sqn_jax.agent import Trajectory, make_network
from sqn_jax.config import NetworkConfig, RandomizationConfig, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import EnvParams, Observation, reset_to
from sqn_jax.env.navigation import BACKWARD, FORWARD, LEFT, RIGHT, STAND
from sqn_jax.env.randomize import randomized, robot_axes
from sqn_jax.evaluation import episodes
from sqn_jax.training import loop
from sqn_jax.training.motion import MotionObservation, next_observation
from sqn_jax.training.rollout import (
    ActorState,
    before_first_action,
    random_draws,
    restart_at_goal,
    start_actors,
    step_actors,
    unroll,
)
from sqn_jax.training.state import params_shapes

LENGTH, ROBOTS = 16, 32
NETWORK = make_network("sqn", NetworkConfig(hidden_size=8, motion_inputs=True), 5)
ARRIVED = np.arange(ROBOTS) % 3 == 1


@pytest.fixture(autouse=True, scope="module")
def quick_compilation() -> Iterator[None]:
    with compiling_quickly():
        yield


@pytest.fixture(scope="module")
def room() -> EnvParams:
    """Its velocity noise lets a robot that stands or turns against a wall be refused, too."""
    return small_room(2 * LENGTH, velocity_noise=0.2)


@dataclasses.dataclass
class Run:
    """Two windows of robots of which some are given new tasks in between."""

    actors: list[ActorState]
    """Before the first window, after it, after the new tasks, after the second window."""
    windows: list[Trajectory]


@pytest.fixture(scope="module")
def run(room: EnvParams) -> Run:
    params = random_params(NETWORK, room)

    @jax.jit
    def two_windows(key: jax.Array) -> Any:
        start_key, restart_key, *keys = jax.random.split(key, 4)
        act = partial(
            unroll, params=params, epsilon=jnp.full(ROBOTS, 0.7), env_params=room, network=NETWORK
        )
        first = start_actors(jax.random.split(start_key, ROBOTS), room, NETWORK)
        middle, window = act(random_draws(keys[0], LENGTH, ROBOTS), actors=first)
        here = middle.env_state.pose[:, :2] + jnp.where(jnp.asarray(ARRIVED), 0.0, 9.0)[:, None]
        arrived = dataclasses.replace(middle.env_state, goal=here)
        middle = dataclasses.replace(middle, env_state=arrived)
        restart_keys = jax.random.split(restart_key, ROBOTS)
        again, _ = restart_at_goal(restart_keys, middle, room, NETWORK)
        last, second = act(random_draws(keys[1], LENGTH, ROBOTS), actors=again)
        return [first, middle, again, last], [window, second]

    return Run(*jax.device_get(two_windows(jax.random.key(1))))


def expected_motion(window: Trajectory) -> np.ndarray:
    """Motion [T, N, 6] after each step, from the actions and from where the robots were."""
    moved = np.hypot(*np.diff(window.poses[..., :2], axis=0).transpose(2, 0, 1)) > 1e-6
    found = np.zeros((*window.actions.shape, 6))
    for t, n in np.ndindex(window.actions.shape):
        action = window.actions[t, n]
        found[t, n, action] = 1
        found[t, n, 5] = action in (1, 2) and not moved[t, n]
    return found


def test_motion_is_the_last_action_and_whether_a_commanded_move_was_refused(run: Run) -> None:
    (first, middle, again, last), (one, two) = run.actors, run.windows
    assert not first.obs.motion.any(), "nothing lies before the first action"
    motion = np.concatenate([one.obs.motion[1:], two.obs.motion[1:]])
    expected = np.concatenate([expected_motion(one), expected_motion(two)])
    np.testing.assert_array_equal(motion, expected)
    # Among them: every action, refused moves ahead and back, and others that are refused to no one.
    assert (expected[..., :5].sum(axis=(0, 1)) > 0).all()
    for action in (1, 2):
        assert 0 < (expected[..., 5] * expected[..., action]).sum() < expected[..., action].sum()
    collisions = np.concatenate([one.info["collision"], two.info["collision"]])
    assert (collisions & (expected[..., 5] == 0)).any(), "noise alone has been refused"
    for window, before, after in ((one, first, middle), (two, again, last)):
        np.testing.assert_array_equal(window.obs.motion[0], before.obs.motion)
        np.testing.assert_array_equal(window.obs.motion[-1], after.obs.motion)


def test_a_new_task_begins_without_a_last_action_and_the_others_keep_theirs(run: Run) -> None:
    _, middle, again, _ = run.actors
    assert (middle.obs.motion[:, :5].sum(axis=1) == 1).all()
    assert not again.obs.motion[ARRIVED].any()
    np.testing.assert_array_equal(again.obs.motion[~ARRIVED], middle.obs.motion[~ARRIVED])


def test_the_network_acts_by_the_motion_that_learning_is_given(room: EnvParams, run: Run) -> None:
    params, window = random_params(NETWORK, room), run.windows[1]
    obs = jax.tree.map(lambda x: x[:-1], window.obs)
    output = NETWORK.apply(params, obs, window.carry)[1]
    np.testing.assert_allclose(window.output.q_values, output.q_values, atol=1e-3)
    blind = dataclasses.replace(obs, motion=jnp.zeros_like(obs.motion))
    other = NETWORK.apply(params, blind, window.carry)[1]
    assert np.abs(other.q_values - output.q_values).max() > 0.1


def test_a_mirrored_robot_is_told_of_its_own_left_and_right() -> None:
    """The room is its own mirror image: there a robot sees what its image sees in the common one,
    and both are told the same of the same actions."""
    room = small_room(LENGTH)
    worlds = randomized(room, RandomizationConfig(mirror=True), 2)
    np.testing.assert_array_equal(worlds.mirrored, [False, True])
    poses = jnp.array([[0.85, 0.95, 0.4], [4.0 - 0.85, 0.95, np.pi - 0.4]])
    goals = jnp.array([[3.0, 2.3], [1.0, 2.3]])
    start = jax.jit(jax.vmap(reset_to, in_axes=(0, 0, 0, robot_axes(worlds))))
    keys = jax.random.split(jax.random.key(0), 2)
    actors = before_first_action(*start(keys, poses, goals, worlds), NETWORK)
    step = jax.jit(step_actors)
    for action in (LEFT, FORWARD, RIGHT, RIGHT, BACKWARD, BACKWARD, BACKWARD, STAND):
        actors, _ = step(keys, actors, jnp.full(2, action), worlds)
        for leaf in jax.tree.leaves(actors.obs):
            np.testing.assert_allclose(leaf[0], leaf[1], atol=1e-4)
        assert isinstance(actors.obs, MotionObservation)
        assert actors.obs.motion[1, :5].argmax() == action
    turns = np.asarray(actors.env_state.pose)[:, 2]
    assert abs(np.sin(turns[0] - (np.pi - turns[1]))) < 1e-4


def test_one_robot_is_told_as_many_are() -> None:
    seen = MotionObservation(jnp.zeros(71), jnp.zeros(2), jnp.zeros(6))
    for action, collision, expected in (
        (FORWARD, True, [0, 1, 0, 0, 0, 1]),
        (BACKWARD, False, [0, 0, 1, 0, 0, 0]),
        (RIGHT, True, [0, 0, 0, 0, 1, 0]),
    ):
        after = next_observation(seen, seen, jnp.int32(action), jnp.bool_(collision))
        assert isinstance(after, MotionObservation)
        np.testing.assert_array_equal(after.motion, expected)
    plain = Observation(seen.ranges, seen.goal)
    assert next_observation(plain, plain, jnp.int32(1), jnp.bool_(True)) is plain


@pytest.mark.parametrize("method", ["pqn", "r2d2"])
def test_training_and_evaluation_take_motion_from_end_to_end(method: str) -> None:
    """By shapes alone: the parameters are those of the config, and all programs accept them."""
    smoke = dataclasses.replace(PRESETS["smoke"], method=method)
    config = dataclasses.replace(
        smoke, network=dataclasses.replace(smoke.network, motion_inputs=True)
    )
    room = small_room(60, max_steps=60)
    program = loop.make_program(room, config)
    runner = loop.runner_shapes(program)
    after, _ = jax.eval_shape(partial(loop.train_chunk, program=program), runner, room)
    assert jax.tree.structure(after) == jax.tree.structure(runner)
    params = params_shapes(config)
    assert jax.tree.map(lambda x: x.shape, params) == jax.tree.map(
        lambda x: x.shape, runner.learner.params
    )
    kernel = params["params"]["perception"]["input_kernel"]
    assert kernel.shape == (2 * 128 + 6, 3 * 128)
    stacked = jax.tree.map(lambda x: jax.ShapeDtypeStruct((1, *x.shape), x.dtype), params)
    keys = episodes.episode_keys(jax.random.key(1), 3)
    batch = partial(episodes._run_batch, network=program.network, epsilon=0.0, maps=None)
    ((trajectory, _),) = jax.eval_shape(
        lambda keys, starts, goals, params: batch(keys, starts, goals, params=params, world=room),
        keys,
        jnp.zeros((3, 3)),
        jnp.zeros((3, 2)),
        stacked,
    )
    assert trajectory.obs.motion.shape == (61, 3, 6)
    assert not TrainConfig().network.motion_inputs
