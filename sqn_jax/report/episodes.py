"""The episodes that went worst, and the places where they did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sqn_jax.baselines.shortest_paths import shortest_path_lengths
from sqn_jax.evaluation.compare import EpisodeBatch, World

Floats = NDArray[np.floating]

NEAR = 1.0
"""m; how far around a place a robot counts as being there."""


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
    """The steps that were looked at, the last ones of the episode."""

    @property
    def is_most(self) -> bool:
        """Whether the robot was there at least half of the time."""
        return 2 * self.steps >= self.of


@dataclass(frozen=True, eq=False)
class HardEpisode:
    """One episode that went badly."""

    batch: EpisodeBatch
    episode: int
    """Which of the batch's."""
    way: float
    """m, the shortest way from start to goal."""
    left: float
    """m, the shortest way from where the robot ended to the goal; 0 for a success."""
    place: Place
    """Of a failure in the last half of the episode, of a success up to its goal."""

    @property
    def success(self) -> bool:
        return bool(self.batch.main_metrics.success[self.episode])

    @property
    def steps(self) -> int:
        """Steps until the goal was reached; the whole episode for a failure."""
        return int(self.batch.main_metrics.time_steps[self.episode])

    @property
    def refused(self) -> int:
        """Moves refused within these steps."""
        return int(self.batch.trajectory.info["collision"][: self.steps, self.episode].sum())

    @property
    def slowness(self) -> float:
        """Steps, as a multiple of those that the shortest way takes at full speed."""
        return self.steps / _fewest_steps(self.batch, self.way)


def densest_place(points: Floats) -> Place:
    """The point with most points within `NEAR` of it; among equals the one they are nearest to.

    Args:
        points: [N, 2] x m, y m, at least one.
    """
    best = (0, 0.0)
    densest = points[0]
    # A robot that stands still has many points and one place.
    for point in np.unique(points, axis=0):
        away = np.hypot(*(points - point).T)
        near = away[away <= NEAR]
        rank = (near.size, -float(near.sum()))
        if rank > best:
            best, densest = rank, point
    return Place(float(densest[0]), float(densest[1]), best[0], len(points))


def hardest(batches: Sequence[EpisodeBatch], count: int = 3) -> list[HardEpisode]:
    """The episodes that went worst, the worst first.

    Failures come before successes: those with the longest way left over the map first. If they are
    too few, the successes that were slowest beside their shortest way follow.

    Args:
        batches: all episodes, their trajectories with `info`.
        count: at most so many.
    """
    found: list[HardEpisode] = []
    for success in (False, True):
        if len(found) < count:
            ranked = _ranked(batches, success=success)
            found += [_looked_at(*each) for each in ranked[: count - len(found)]]
    return found


def _ranked(batches: Sequence[EpisodeBatch], *, success: bool) -> list[tuple[EpisodeBatch, int]]:
    """All failures or all successes, from the worst to the best."""
    ranks: list[tuple[float, int, int]] = []
    numbered = list(enumerate(batches))
    for world in {id(batch.world): batch.world for batch in batches}.values():
        # Together, since agents have goals in common and a distance field takes its time.
        same = [(number, batch) for number, batch in numbered if batch.world is world]
        chosen = [
            (number, episode)
            for number, batch in same
            for episode in np.flatnonzero(np.asarray(batch.main_metrics.success) == success)
        ]
        if not chosen:
            continue
        moment = 0 if success else -1
        places = np.stack([batches[n].trajectory.poses[moment, episode] for n, episode in chosen])
        goals = np.stack([batches[number].goals[episode] for number, episode in chosen])
        ways = _ways(world, places, goals)
        for (number, episode), way in zip(chosen, ways, strict=True):
            batch = batches[number]
            steps = float(batch.main_metrics.time_steps[episode])
            badness = steps / _fewest_steps(batch, way) if success else float(way)
            ranks.append((-badness, number, int(episode)))
    return [(batches[number], episode) for _, number, episode in sorted(ranks)]


def _looked_at(batch: EpisodeBatch, episode: int) -> HardEpisode:
    success = bool(batch.main_metrics.success[episode])
    steps = int(batch.main_metrics.time_steps[episode])
    poses = batch.trajectory.poses[:, episode]
    first = 0 if success else steps // 2
    goals = batch.goals[[episode, episode]]
    way, left = (float(length) for length in _ways(batch.world, poses[[0, -1]], goals))
    place = densest_place(poses[first + 1 : steps + 1, :2])
    return HardEpisode(batch, episode, way, 0.0 if success else left, place)


def _ways(
    world: World, places: NDArray[np.floating], goals: NDArray[np.floating]
) -> NDArray[np.float64]:
    robot_radius = world.env_params.config.robot_radius
    return shortest_path_lengths(world.occupancy_map, places, goals, robot_radius=robot_radius)


def _fewest_steps(batch: EpisodeBatch, way: float) -> float:
    """Steps that a way takes at full speed; at least one."""
    config = batch.world.env_params.config
    return max(1.0, way / (config.forward_speed * config.time_step))
