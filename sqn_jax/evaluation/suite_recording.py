"""Recorded episodes of the tasks of a suite; they are the same as those of its evaluation."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.evaluation.recording import RECORDED, Episode, covered_points
from sqn_jax.evaluation.settings import SuiteSettings
from sqn_jax.evaluation.suites import LoadMap, SuiteChunk, chunks, robot_for, run_chunk
from sqn_jax.tasks.suite import Task, TaskSuite


def first_try(seed: int, noise: tuple[float, float] = (0.0, 0.0)) -> SuiteSettings:
    """One episode of each task: the first one of an evaluation under this seed."""
    return SuiteSettings(episodes=1, eval_seeds=1, seed=seed, noise=noise)


def record_tasks(
    agent: TrainedAgent,
    suite: TaskSuite,
    numbers: Sequence[int],
    load: LoadMap,
    settings: SuiteSettings,
) -> list[Episode]:
    """Run tasks of a suite and record them, each to its own limit.

    Args:
        agent: the agent; of it the first training seed is used.
        suite: the tasks, checked by `tasks.check_tasks`.
        numbers: which tasks, from 0, none twice.
        load: makes the maps for this robot.
        settings: from `first_try`.

    Returns:
        The episodes, in the order of `numbers`.
    """
    policy = agent.policies[0]
    alone = dataclasses.replace(
        agent, policies=(dataclasses.replace(policy, params=policy.params[:1]),)
    )
    recorded: dict[int, Episode] = {}
    robot = robot_for(agent.env_config, suite)
    for chunk in chunks(suite, robot, load, settings.noise, only=numbers):
        (results,) = run_chunk(alone, chunk, settings, lambda count: None, RECORDED)
        recorded |= _episodes(agent.name, suite, chunk, results.trajectory)
    return [recorded[number] for number in numbers]


def _episodes(
    name: str, suite: TaskSuite, chunk: SuiteChunk, trajectory: Trajectory
) -> dict[int, Episode]:
    """The episodes of a chunk by the numbers of their tasks, each with the world of its map."""
    episodes = {}
    map_of_task = np.asarray(chunk.tasks.maps)
    for index, (occupancy_map, world) in enumerate(zip(chunk.maps, chunk.worlds, strict=True)):
        own = np.flatnonzero(map_of_task == index)
        on_map = trajectory.of_robots(own)
        covered = jax.device_get(covered_points(on_map.poses, world))
        on_map = dataclasses.replace(on_map, covered=covered)
        for place, number in enumerate(chunk.numbers[own].tolist()):
            task = suite.tasks[number]
            radius = jnp.float32(task.goal_radius)
            of_task = dataclasses.replace(world, max_steps=task.max_steps, goal_radius=radius)
            episode = Episode(name, occupancy_map, of_task, on_map.of_robots(place))
            episodes[number] = episode.first_steps(_length(episode, task, suite.collision_ends))
    return episodes


def _length(episode: Episode, task: Task, collision_ends: bool) -> int:
    """Steps until the episode is over."""
    collisions = np.flatnonzero(episode.collisions[: task.max_steps])
    return int(collisions[0]) + 1 if collision_ends and collisions.size else task.max_steps
