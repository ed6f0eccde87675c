"""Recorded episodes stepped through again by hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from rooms import random_params, small_room, write_empty_room

from sqn_jax.agent import initial_carry, make_network
from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams, coverage, step
from sqn_jax.evaluation.compare import Learnt, Settings, World, evaluate_agents, load_maps
from sqn_jax.evaluation.episodes import episode_keys, run_episodes
from sqn_jax.evaluation.recording import Episode, Recording, on_host, record, record_episodes
from sqn_jax.maps import OccupancyMap
from sqn_jax.policies.run_policies import Policy

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


@pytest.fixture(scope="module")
def episodes(recording: Recording, room: EnvParams) -> list[Episode]:
    occupied = np.zeros((30, 40), dtype=bool)
    there = OccupancyMap("room", occupied, 0.1, np.zeros((0, 2)), np.zeros((0, 2)))
    world = World(there, room, "random pairs", (0.0, 0.0))
    return on_host(recording, world, agent="sqn")


def test_an_episode_on_the_host_is_what_was_recorded(
    episodes: list[Episode], recording: Recording, room: EnvParams
) -> None:
    for index, episode in enumerate(episodes):
        np.testing.assert_array_equal(episode.poses, recording.states.pose[index])
        np.testing.assert_allclose(episode.reward_parts.sum(axis=1), episode.rewards, atol=1e-5)
        np.testing.assert_allclose(episode.reward_parts[:, 2], -0.2, rtol=1e-6)
        away = np.hypot(*(episode.poses[1:, :2] - episode.goal).T)
        np.testing.assert_allclose(episode.goal_distances, away, atol=1e-5)
        inside = np.flatnonzero(away < room.goal_radius)
        assert episode.success == (inside.size > 0)
        assert episode.time_steps == (inside[0] + 1 if inside.size else LENGTH)
        hidden = ~episode.reachable
        np.testing.assert_array_equal(episode.reward_parts[hidden, 0], 0.0)
        assert (episode.reward_parts[~hidden, 0] > 0).all()


def test_beams_end_where_their_readings_say(episodes: list[Episode]) -> None:
    episode = episodes[0]
    ends = episode.beam_ends(4)
    x, y, heading = episode.poses[4]
    for beam in (0, 35, 70):
        angle = heading + np.deg2rad(-175 + 5 * beam)
        reach = float(episode.ranges[4, beam])
        expected = (x + reach * np.cos(angle), y + reach * np.sin(angle))
        np.testing.assert_allclose(ends[beam], expected, atol=1e-4)


def test_the_seen_area_as_points_and_as_a_picture(episodes: list[Episode]) -> None:
    """Pixel by pixel: the nearest of all points of the lattice decides."""
    episode = episodes[2]
    points = episode.lattice.points().reshape(-1, 2)
    for index in (0, LENGTH):
        seen = episode.covered_points(index)
        area = float(coverage.area(jnp.asarray(episode.covered[index]), episode.lattice.cell))
        np.testing.assert_allclose(len(seen) * episode.lattice.cell**2, area, rtol=1e-5)
        mask = episode.covered_mask(index, (15, 20))
        known = {tuple(point) for point in seen}
        for row in range(15):
            for column in range(20):
                place = np.array([(column + 0.5) * 4.0 / 20, (row + 0.5) * 3.0 / 15])
                nearest = points[np.hypot(*(points - place).T).argmin()]
                assert mask[row, column] == (tuple(nearest) in known)
    assert mask.any()
    assert not mask.all()


def test_recorded_tasks_are_those_of_the_evaluation_under_the_same_seed(tmp_path: Path) -> None:
    path = write_empty_room(tmp_path)
    config = TrainConfig(algo="sqn", network=CONFIG, env=EnvConfig(near_goal_fraction=0.5))
    policy = Policy("made up", config, (random_params(NETWORK, small_room(LENGTH)),))
    settings = Settings((str(path),), ("random pairs",), 2, 1, 77, max_steps=6)
    traces = []
    agents = [Learnt("sqn", (policy,))]
    evaluate_agents(
        agents,
        load_maps(agents, settings),
        settings,
        on_driven=lambda agent, world, index, driven: traces.append(driven[1]),
    )
    found = record(policy, str(path), tasks="random pairs", episodes=2, seed=77, max_steps=6)
    assert [episode.num_steps for episode in found] == [6, 6]
    for index, episode in enumerate(found):
        assert episode.occupancy_map.name == "room"
        np.testing.assert_allclose(episode.goal, traces[0].goals[index])
        np.testing.assert_allclose(episode.poses, traces[0].poses[:, index], atol=1e-4)


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
