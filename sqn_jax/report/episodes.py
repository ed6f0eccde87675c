"""The worst episodes of an evaluation, and the places where robots got stuck in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sqn_jax.baselines.shortest_paths import shortest_path_lengths
from sqn_jax.evaluation.agents import EpisodeBatch
from sqn_jax.evaluation.settings import World

Floats = NDArray[np.floating]

NEAR = 1.0
"""m; a robot is at a place if it is within this distance."""


@dataclass(frozen=True)
class Place:
    """Where a robot was most of the time."""

    x: float
    """m."""
    y: float
    """m."""
    steps: int
    """Steps that ended within `NEAR` of it."""
    of: int
    """Number of steps considered: the last ones of the episode."""

    @property
    def is_most(self) -> bool:
        """Whether the robot was there at least half of the time."""
        return 2 * self.steps >= self.of


@dataclass(frozen=True, eq=False)
class WorstEpisode:
    """One of the worst episodes."""

    batch: EpisodeBatch
    episode: int
    """Index in the batch."""
    shortest_path: float
    """m, from start to goal."""
    remaining_path: float
    """m, shortest path from the last pose to the goal; 0 for a success."""
    place: Place
    """In the second half of a failure; in a success up to the goal."""

    @property
    def success(self) -> bool:
        return bool(self.batch.main_metrics.success[self.episode])

    @property
    def steps(self) -> int:
        """Steps until the goal was reached; the whole episode for a failure."""
        return int(self.batch.main_metrics.time_steps[self.episode])

    @property
    def collisions(self) -> int:
        """Moves within these steps that were refused since the body would touch something."""
        return int(self.batch.trajectory.info["collision"][: self.steps, self.episode].sum())

    @property
    def slowness(self) -> float:
        """Steps divided by those that the shortest path takes at full speed."""
        return self.steps / _fewest_steps(self.batch, self.shortest_path)


def densest_place(points: Floats) -> Place:
    """The point with most points within `NEAR` of it; of equals the one they are nearest to.

    Args:
        points: [N, 2] x m, y m, at least one.
    """
    best = (0, 0.0)
    densest = points[0]
    # A robot that stands still has many equal points.
    for point in np.unique(points, axis=0):
        distances = np.hypot(*(points - point).T)
        near = distances[distances <= NEAR]
        rank = (near.size, -float(near.sum()))
        if rank > best:
            best, densest = rank, point
    return Place(float(densest[0]), float(densest[1]), best[0], len(points))


def worst_episodes(batches: Sequence[EpisodeBatch], count: int = 3) -> list[WorstEpisode]:
    """The worst episodes, the worst first.

    Failures come first, those with the longest remaining path to the goal at the front. If they are
    too few, successes follow, those slowest relative to their shortest path at the front.

    Args:
        batches: all episodes; the trajectories need `info`.
        count: the largest number of episodes.
    """
    worst: list[WorstEpisode] = []
    for success in (False, True):
        if len(worst) < count:
            ranked = _ranked(batches, success=success)
            worst += [_worst_episode(*item) for item in ranked[: count - len(worst)]]
    return worst


def _ranked(batches: Sequence[EpisodeBatch], *, success: bool) -> list[tuple[EpisodeBatch, int]]:
    """All failures or all successes, from the worst to the best."""
    ranks: list[tuple[float, int, int]] = []
    numbered = list(enumerate(batches))
    for world in {id(batch.world): batch.world for batch in batches}.values():
        # All agents together: they have the same goals, and a distance field takes time.
        in_world = [(number, batch) for number, batch in numbered if batch.world is world]
        chosen = [
            (number, episode)
            for number, batch in in_world
            for episode in np.flatnonzero(np.asarray(batch.main_metrics.success) == success)
        ]
        if not chosen:
            continue
        step = 0 if success else -1
        poses = np.stack([batches[n].trajectory.poses[step, episode] for n, episode in chosen])
        goals = np.stack([batches[number].goals[episode] for number, episode in chosen])
        paths = _shortest_paths(world, poses, goals)
        for (number, episode), path in zip(chosen, paths, strict=True):
            batch = batches[number]
            steps = float(batch.main_metrics.time_steps[episode])
            badness = steps / _fewest_steps(batch, path) if success else float(path)
            ranks.append((-badness, number, int(episode)))
    return [(batches[number], episode) for _, number, episode in sorted(ranks)]


def _worst_episode(batch: EpisodeBatch, episode: int) -> WorstEpisode:
    success = bool(batch.main_metrics.success[episode])
    steps = int(batch.main_metrics.time_steps[episode])
    poses = batch.trajectory.poses[:, episode]
    first = 0 if success else steps // 2
    goals = batch.goals[[episode, episode]]
    shortest, remaining = _shortest_paths(batch.world, poses[[0, -1]], goals).tolist()
    place = densest_place(poses[first + 1 : steps + 1, :2])
    return WorstEpisode(batch, episode, shortest, 0.0 if success else remaining, place)


def _shortest_paths(world: World, poses: Floats, goals: Floats) -> NDArray[np.float64]:
    """[N] m from poses [N, 3] to goals [N, 2]."""
    robot_radius = world.env_params.config.robot_radius
    return shortest_path_lengths(world.occupancy_map, poses, goals, robot_radius=robot_radius)


def _fewest_steps(batch: EpisodeBatch, path_length: float) -> float:
    """Steps that a path of this length, m, takes at full speed; at least one."""
    config = batch.world.env_params.config
    return max(1.0, path_length / (config.forward_speed * config.time_step))
