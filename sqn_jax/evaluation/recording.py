"""Recorded episodes for pictures; they are the same episodes as those of an evaluation.

`record` takes a policy and the name of a map and returns such episodes on the host. They come from
`episodes.run_episodes`, the compiled program of the evaluation. It does not return the covered
points, which take up to several kB per step: functions of the simulator compute them again from the
poses, in another program.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.env import EnvParams
from sqn_jax.env.coverage import Lattice
from sqn_jax.env.geometry import beam_angles, wrap_angle
from sqn_jax.env.navigation import covered_along
from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.evaluation.compare import load_maps
from sqn_jax.evaluation.episodes import episode_keys, run_episodes
from sqn_jax.evaluation.settings import (
    SPAWN_MODES,
    Settings,
    Tasks,
    World,
    robot_for,
    task_key,
    worlds,
)
from sqn_jax.maps import OccupancyMap
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.exported import exported_jit

Floats = NDArray[np.floating]

RECORDED = tuple(
    field.name for field in dataclasses.fields(Trajectory) if field.name not in ("carry", "covered")
)
"""The fields of a trajectory that are recorded; `covered` is computed from the poses."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of T steps on the host, with all that pictures need; NumPy arrays.

    Arrays of length T + 1 have the values before each step, and after the last.
    """

    agent: str
    """Name of the agent."""
    occupancy_map: OccupancyMap
    env_params: EnvParams
    """The world that was made from the map."""
    trajectory: Trajectory
    """[T, ...] or [T + 1, ...], without an axis of robots."""

    @property
    def poses(self) -> Floats:
        """[T + 1, 3] x m, y m, heading rad."""
        poses: Floats = self.trajectory.poses
        return poses

    @property
    def goal(self) -> Floats:
        """[2] x m, y m."""
        goal: Floats = self.trajectory.goals
        return goal

    @cached_property
    def ranges(self) -> Floats:
        """[T + 1, R] m, the ranges the agent saw, including noise."""
        ranges: Floats = self.trajectory.obs.ranges * self.max_range
        return ranges

    @property
    def actions(self) -> NDArray[np.integer]:
        """[T] in 0..4, see `env.ACTION_NAMES`."""
        actions: NDArray[np.integer] = self.trajectory.actions
        return actions

    @property
    def rewards(self) -> Floats:
        """[T]."""
        rewards: Floats = self.trajectory.rewards
        return rewards

    @cached_property
    def reward_parts(self) -> Floats:
        """[T, 4] the weighted terms navigation, exploration, time and collision.

        Their sum is the reward.
        """
        names = ("navigation", "exploration", "time", "collision")
        parts = np.stack([self.trajectory.info[f"reward_{name}"] for name in names], axis=-1)
        return parts * np.asarray(self.env_params.reward_weights)

    @property
    def goal_distances(self) -> Floats:
        """[T] m, straight-line distance to the goal after each step."""
        distances: Floats = self.trajectory.info["goal_distance"]
        return distances

    @property
    def reachable(self) -> NDArray[np.bool_]:
        """[T] whether the goal was in view and not hidden after each step (paper, eq. 8)."""
        reachable: NDArray[np.bool_] = self.trajectory.info["reward_navigation"] > 0
        return reachable

    @property
    def collisions(self) -> NDArray[np.bool_]:
        """[T] whether the move was refused since the body would touch something."""
        collisions: NDArray[np.bool_] = self.trajectory.info["collision"]
        return collisions

    @property
    def skill_weights(self) -> Floats:
        """[T, K] skill weights, 0..1 (paper, eq. 4)."""
        weights: Floats = self.trajectory.output.skill_weights
        return weights

    @property
    def skill_q_values(self) -> Floats:
        """[T, K, A] action values of each skill (paper, eq. 5)."""
        values: Floats = self.trajectory.output.skill_q_values
        return values

    @property
    def q_values(self) -> Floats:
        """[T, A] action values: the weighted sum of those of the skills."""
        values: Floats = self.trajectory.output.q_values
        return values

    @property
    def max_range(self) -> float:
        """Range of the sensor, m."""
        return self.env_params.config.max_range

    @property
    def field_of_view(self) -> float:
        """Angle from the first beam to the last, rad."""
        return math.radians(self.env_params.config.field_of_view_deg)

    @cached_property
    def goal_radius(self) -> float:
        """m."""
        return float(self.env_params.goal_radius)

    @property
    def robot_radius(self) -> float:
        """m."""
        return self.env_params.config.robot_radius

    @cached_property
    def time_step(self) -> float:
        """s."""
        return float(self.env_params.time_step)

    @property
    def lattice(self) -> Lattice:
        """The lattice of the points that can be covered."""
        return self.env_params.lattice

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.rewards)

    @property
    def success(self) -> bool:
        """Whether the goal radius was entered at any time."""
        return bool((self.goal_distances < self.goal_radius).any())

    @property
    def time_steps(self) -> int:
        """The step of the first entry, counted from 1; T for a failure."""
        inside = self.goal_distances < self.goal_radius
        return int(inside.argmax()) + 1 if inside.any() else self.num_steps

    def first_steps(self, count: int) -> Episode:
        """The first `count` steps of the episode, at most all."""
        return dataclasses.replace(self, trajectory=self.trajectory.first_steps(count))

    def goal_headings(self) -> Floats:
        """[T + 1] rad in [-pi, pi), direction of the goal relative to the heading."""
        x, y, heading = self.poses.T
        return wrap_angle(np.arctan2(self.goal[1] - y, self.goal[0] - x) - heading)

    def beam_angles(self) -> Floats:
        """[R] rad, directions of the beams relative to the heading, from right to left."""
        return beam_angles(self.env_params.config)

    def beam_ends(self, index: int) -> Floats:
        """[R, 2] x m, y m, the ends of the beams on the map before step `index` (0..T)."""
        x, y, heading = self.poses[index]
        angles = heading + self.beam_angles()
        reach = self.ranges[index]
        return np.stack([x + reach * np.cos(angles), y + reach * np.sin(angles)], axis=-1)

    def covered_bits(self, index: int) -> NDArray[np.bool_]:
        """[..., 32] whether each point of the lattice was seen before step `index` (0..T)."""
        covered = self.trajectory.covered[index]
        return (covered[..., None] >> np.arange(32, dtype=np.uint32) & 1).astype(bool)

    def covered_points(self, index: int) -> Floats:
        """[P, 2] x m, y m, points seen before step `index` (0..T); each has the area `cell`²."""
        return self.lattice.points()[self.covered_bits(index)]

    def covered_mask(self, index: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """The seen area as an image over the whole map, before step `index` (0..T).

        Args:
            index: 0..T.
            shape: rows and columns of the image; row 0 is at the bottom.

        Returns:
            [rows, columns] bool, whether the lattice point nearest to each pixel has been seen.
        """
        width, height = self.occupancy_map.size_m
        x = (np.arange(shape[1]) + 0.5) * width / shape[1]
        y = (np.arange(shape[0]) + 0.5) * height / shape[0]
        place = self.lattice.nearest_point(*np.meshgrid(x, y))
        mask: NDArray[np.bool_] = self.covered_bits(index)[place]
        return mask


def record(
    policy: Policy,
    map_name: str = "maze",
    *,
    tasks: Tasks = "evaluation points",
    episodes: int = 4,
    seed: int = 1_000,
    noise: tuple[float, float] = (0.0, 0.0),
    max_steps: int = 0,
    index: int = 0,
) -> list[Episode]:
    """Run greedy episodes of a policy and record them: the first ones of `sqn evaluate`.

    Args:
        policy: the policy.
        map_name: a map of the project, or a file.
        tasks: between evaluation points, or random pairs of spawn points.
        episodes: the number of episodes.
        seed: the evaluation seed.
        noise: of the velocity and of the ranges, in the units of the policy's config.
        max_steps: steps per episode; 0: the limit of the map.
        index: of the training seed in the policy.

    Returns:
        The episodes.

    Raises:
        ValueError: the map is unusable, or a setting is out of its range.
    """
    if tasks not in SPAWN_MODES:
        raise ValueError(f"tasks is {tasks!r}, expected one of {', '.join(SPAWN_MODES)}")
    if not 0 <= index < len(policy.params):
        raise ValueError(f"index is {index}, expected 0 to {len(policy.params) - 1}")
    settings = Settings((map_name,), (tasks,), episodes, 1, seed, (noise,), max_steps=max_steps)
    agent = TrainedAgent(policy.config.algo, (policy,))
    maps = load_maps([agent], settings)
    (world,) = worlds(robot_for(agent.env_config, settings), maps, settings)
    keys = episode_keys(task_key(seed, tasks), episodes)
    return record_episodes(keys, agent, policy.training_seeds[index], world)


def record_episodes(
    keys: Array, agent: TrainedAgent, training_seed: int | None, world: World
) -> list[Episode]:
    """Run greedy episodes in a world and record them.

    Args:
        keys: [E] from `episode_keys`.
        agent: the agent.
        training_seed: selects the parameters of the agent.
        world: the world.

    Returns:
        The episodes; a step takes about 0.5 kB, plus up to several kB for its covered points.
    """
    params, env_params = agent.params(training_seed), world.env_params
    _, trajectory = run_episodes(
        keys, params, env_params, agent.network, epsilon=agent.epsilon, fields=RECORDED
    )
    covered = jax.device_get(covered_points(trajectory.poses, env_params))
    trajectory = dataclasses.replace(trajectory, covered=covered)
    return [
        Episode(agent.name, world.occupancy_map, env_params, trajectory.of_robots(index))
        for index in range(len(keys))
    ]


@exported_jit
def covered_points(poses: Array, env_params: EnvParams) -> Array:
    """[T + 1, E, ...] the points covered along poses [T + 1, E, 3]."""
    return jax.vmap(covered_along, in_axes=(1, None), out_axes=1)(poses, env_params)
