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
from sqn_jax.env import NUM_ACTIONS, EnvParams, EnvState, coverage, step
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent
from sqn_jax.evaluation.compare import evaluate_agents, load_maps
from sqn_jax.evaluation.episodes import episode_keys
from sqn_jax.evaluation.recording import Episode, record, record_episodes
from sqn_jax.evaluation.settings import Settings, World, task_key
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
def world(room: EnvParams) -> World:
    occupied = np.zeros((30, 40), dtype=bool)
    there = OccupancyMap("room", occupied, 0.1, np.zeros((0, 2)), np.zeros((0, 2)))
    return World(there, room, "random pairs", (0.0, 0.0))


@pytest.fixture(scope="module")
def episodes(world: World, params: Any) -> list[Episode]:
    keys = episode_keys(jax.random.key(5), EPISODES)
    return record_episodes(keys, agent_of(params), 0, world)


def agent_of(*params: Any) -> TrainedAgent:
    config = TrainConfig(algo="sqn", network=CONFIG, num_seeds=len(params))
    return TrainedAgent("sqn", (Policy("made up", config, params),))


def test_each_step_is_the_one_that_the_simulator_makes(
    episodes: list[Episode], room: EnvParams
) -> None:
    advance = jax.jit(step)
    for trajectory in (episode.trajectory for episode in episodes):
        for t in range(LENGTH):
            state = EnvState(
                pose=trajectory.poses[t],
                goal=trajectory.goals,
                covered=trajectory.covered[t],
                step=jnp.int32(t),
            )
            obs, after, reward, *_, info = advance(
                jax.random.key(0), state, trajectory.actions[t], room
            )
            expected = (
                jax.tree.map(lambda x, t=t: x[t + 1], trajectory.obs),
                (trajectory.poses[t + 1], trajectory.covered[t + 1], trajectory.rewards[t]),
                {name: value[t] for name, value in trajectory.info.items()},
            )
            for ours, theirs in zip(
                jax.tree.leaves((obs, (after.pose, after.covered, reward), info)),
                jax.tree.leaves(expected),
                strict=True,
            ):
                np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_what_is_covered_grows_by_what_the_steps_say(
    episodes: list[Episode], room: EnvParams
) -> None:
    cell = room.lattice.cell
    for trajectory in (episode.trajectory for episode in episodes):
        areas = [float(coverage.area(covered, cell)) for covered in trajectory.covered]
        np.testing.assert_allclose(np.diff(areas), trajectory.info["covered_area"], atol=1e-3)


def test_an_episode_says_what_was_recorded(episodes: list[Episode], room: EnvParams) -> None:
    for episode in episodes:
        np.testing.assert_allclose(episode.reward_parts.sum(axis=1), episode.rewards, atol=1e-5)
        np.testing.assert_allclose(episode.reward_parts[:, 2], -0.2, rtol=1e-6)
        np.testing.assert_allclose(episode.ranges / 5.0, episode.trajectory.obs.ranges, rtol=1e-6)
        away = np.hypot(*(episode.poses[1:, :2] - episode.goal).T)
        np.testing.assert_allclose(episode.goal_distances, away, atol=1e-5)
        inside = np.flatnonzero(away < room.goal_radius)
        assert episode.success == (inside.size > 0)
        assert episode.time_steps == (inside[0] + 1 if inside.size else LENGTH)
        hidden = ~episode.reachable
        np.testing.assert_array_equal(episode.reward_parts[hidden, 0], 0.0)
        assert (episode.reward_parts[~hidden, 0] > 0).all()
        towards = episode.goal_headings() + episode.poses[:, 2]
        ahead = np.stack([np.cos(towards[1:]), np.sin(towards[1:])], axis=-1) * away[:, None]
        np.testing.assert_allclose(
            episode.poses[1:, :2] + ahead, np.tile(episode.goal, (LENGTH, 1)), atol=1e-4
        )
        assert (np.abs(episode.goal_headings()) <= np.pi).all()


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
        area = float(
            coverage.area(jnp.asarray(episode.trajectory.covered[index]), episode.lattice.cell)
        )
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


@pytest.mark.parametrize("noise", [(0.0, 0.0), (0.2, 0.4)], ids=["quiet", "noisy"])
def test_a_recorded_episode_is_the_evaluated_one_to_the_bit(
    tmp_path: Path, noise: tuple[float, float]
) -> None:
    """Of both training seeds and evaluation seeds, alone or beside others, in a map with walls."""
    path, room = write_empty_room(tmp_path), small_room(LENGTH)
    env = EnvConfig(near_goal_fraction=0.5)
    config = TrainConfig(algo="sqn", network=CONFIG, env=env, num_seeds=2, seed=3)
    policy = Policy("made up", config, tuple(random_params(NETWORK, room, seed) for seed in (0, 1)))
    settings = Settings((str(path),), ("random pairs",), 7, 2, 77, (noise,), max_steps=40)
    batches: list[EpisodeBatch] = []
    agents = [TrainedAgent("sqn", (policy,))]
    fields = ("actions", "rewards", "info", "output")
    maps = load_maps(agents, settings)
    evaluate_agents(agents, maps, settings, on_evaluated=batches.append, fields=fields)
    seeds = [(batch.eval_seed, batch.training_seed) for batch in batches]
    assert seeds == [(77, 3), (77, 4), (78, 3), (78, 4)]
    for batch in batches:
        assert batch.agent is agents[0]
        assert batch.world.tasks == "random pairs"
        ends = batch.trajectory.poses[-1]
        assert len(np.unique(ends, axis=0)) == 7, "they are to go different ways"
        index = policy.training_seeds.index(batch.training_seed)
        how: Any = {"tasks": "random pairs", "noise": noise, "max_steps": 40, "index": index}
        several = record(policy, str(path), episodes=5, seed=batch.eval_seed, **how)
        keys = episode_keys(task_key(batch.eval_seed, "random pairs"), 7)[4:5]
        alone = record_episodes(keys, agents[0], batch.training_seed, batch.world)
        for number, episode in [*enumerate(several), (4, alone[0])]:
            assert episode.occupancy_map.name == "room"
            assert episode.num_steps == 40
            evaluated = batch.trajectory.of_robots(number)
            recorded = episode.trajectory.only("poses", "goals", *fields)
            for ours, theirs in zip(
                jax.tree.leaves(recorded), jax.tree.leaves(evaluated), strict=True
            ):
                np.testing.assert_array_equal(ours, theirs)
            assert episode.success == batch.main_metrics.success[number]
            assert episode.time_steps == batch.main_metrics.time_steps[number]


def test_outputs_and_actions_are_the_networks_for_what_it_saw(
    episodes: list[Episode], params: Any
) -> None:
    trajectory = episodes[1].trajectory
    seen = jax.tree.map(lambda x: x[:-1, None], trajectory.obs)
    _, output = NETWORK.apply(params, seen, initial_carry(CONFIG, 1))
    np.testing.assert_allclose(
        output.skill_q_values[:, 0], trajectory.output.skill_q_values, rtol=1e-3, atol=1e-3
    )
    np.testing.assert_array_equal(jnp.argmax(output.q_values[:, 0], axis=-1), trajectory.actions)
