"""Episodes for pictures: a view of the very episodes that an evaluation has.

`record` goes from a policy and the name of a map to such episodes on the host. They come from
`episodes.run_episodes`, that is from the compiled program of the evaluation. The points covered on
the way are the only thing it does not put out, since they take up to several kB a step: the
simulator's own functions count them again along the poses, in a program of their own.
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
from sqn_jax.evaluation.agents import Learnt
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

Floats = NDArray[np.floating]

RECORDED = tuple(
    field.name for field in dataclasses.fields(Trajectory) if field.name not in ("carry", "covered")
)
"""The fields of a trajectory that an `Episode` is made from; `covered` is added to them."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of T steps on the host, with all that a picture of it needs; NumPy arrays.

    Arrays of T + 1 hold what was before each step, and after the last.
    """

    agent: str
    """Who acted."""
    occupancy_map: OccupancyMap
    env_params: EnvParams
    """The world that was made from the map."""
    trajectory: Trajectory
    """What happened, [T, ...] or [T + 1, ...], without an axis of robots."""

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
        """[T + 1, R] m, what the agent saw, with noise where there is any."""
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
        """[T, 3] navigation, exploration and time, weighted: their sum is the reward."""
        names = ("reward_navigation", "reward_exploration", "reward_time")
        parts = np.stack([self.trajectory.info[name] for name in names], axis=-1)
        return parts * np.asarray(self.env_params.reward_weights)

    @property
    def goal_distances(self) -> Floats:
        """[T] m, in a straight line, after each step."""
        distances: Floats = self.trajectory.info["goal_distance"]
        return distances

    @property
    def reachable(self) -> NDArray[np.bool_]:
        """[T] whether the goal was in view and not hidden after each step (paper eq. 8)."""
        reachable: NDArray[np.bool_] = self.trajectory.info["reward_navigation"] > 0
        return reachable

    @property
    def collisions(self) -> NDArray[np.bool_]:
        """[T] the move was refused."""
        collisions: NDArray[np.bool_] = self.trajectory.info["collision"]
        return collisions

    @property
    def skill_weights(self) -> Floats:
        """[T, K] the skill decision."""
        weights: Floats = self.trajectory.output.skill_weights
        return weights

    @property
    def skill_q_values(self) -> Floats:
        """[T, K, A] action values of each skill."""
        values: Floats = self.trajectory.output.skill_q_values
        return values

    @property
    def q_values(self) -> Floats:
        """[T, A] their weighted sum, by which the action was chosen."""
        values: Floats = self.trajectory.output.q_values
        return values

    @property
    def max_range(self) -> float:
        """m."""
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
        """Where the points lie that were covered."""
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
        """The beginning of the episode, at most all of it."""
        return dataclasses.replace(self, trajectory=self.trajectory.first_steps(count))

    def goal_headings(self) -> Floats:
        """[T + 1] rad in [-pi, pi), direction of the goal from the robot's heading."""
        x, y, heading = self.poses.T
        return wrap_angle(np.arctan2(self.goal[1] - y, self.goal[0] - x) - heading)

    def beam_angles(self) -> Floats:
        """[R] directions of the beams from the heading, rad, from the rightmost to the leftmost."""
        return beam_angles(self.env_params.config)

    def beam_ends(self, index: int) -> Floats:
        """[R, 2] m, where the beams end on the map before step `index` (0..T)."""
        x, y, heading = self.poses[index]
        angles = heading + self.beam_angles()
        reach = self.ranges[index]
        return np.stack([x + reach * np.cos(angles), y + reach * np.sin(angles)], axis=-1)

    def covered_bits(self, index: int) -> NDArray[np.bool_]:
        """[..., 32] whether each point of the lattice was seen before step `index` (0..T)."""
        covered = self.trajectory.covered[index]
        return (covered[..., None] >> np.arange(32, dtype=np.uint32) & 1).astype(bool)

    def covered_points(self, index: int) -> Floats:
        """[P, 2] m, the points seen before step `index` (0..T), each for `lattice.cell` squared."""
        return self.lattice.points()[self.covered_bits(index)]

    def covered_mask(self, index: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """The seen area as an image over the whole map, before step `index` (0..T).

        Args:
            index: 0..T.
            shape: rows and columns of the image; row 0 is at the bottom.

        Returns:
            [rows, columns], whether the point of the lattice nearest to each pixel has been seen.
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
    """Run a policy greedily and keep everything: the first episodes of `sqn evaluate`'s.

    Args:
        policy: who acts.
        map_name: a map of the project, or a file.
        tasks: from the evaluation points or between random pairs of spawn points.
        episodes: how many.
        seed: the evaluation seed.
        noise: of the velocity and of the ranges, in the units the policy was configured with.
        max_steps: steps an episode; 0 for the map's own limit.
        index: which of the policy's training seeds.

    Raises:
        ValueError: the map is unusable, or a setting is out of its range.
    """
    if tasks not in SPAWN_MODES:
        raise ValueError(f"tasks is {tasks!r}, expected one of {', '.join(SPAWN_MODES)}")
    if not 0 <= index < len(policy.params):
        raise ValueError(f"index is {index}, expected 0 to {len(policy.params) - 1}")
    settings = Settings((map_name,), (tasks,), episodes, 1, seed, (noise,), max_steps=max_steps)
    agent = Learnt(policy.config.algo, (policy,))
    maps = load_maps([agent], settings)
    (world,) = worlds(robot_for(agent.env_config, settings), maps, settings)
    keys = episode_keys(task_key(seed, tasks), episodes)
    return record_episodes(keys, agent, policy.training_seeds[index], world)


def record_episodes(
    keys: Array, agent: Learnt, training_seed: int | None, world: World
) -> list[Episode]:
    """Run a policy greedily in a world that is there already, and keep everything.

    Args:
        keys: [E] from `episode_keys`, of which an evaluation seed has the first ones.
        agent: who acts.
        training_seed: with the parameters of which seed.
        world: where.

    Returns:
        The episodes; a step takes about 0.5 kB, and its covered points up to several kB more.
    """
    params, env_params = agent.params(training_seed), world.env_params
    _, recorded = run_episodes(keys, params, env_params, agent.network, fields=RECORDED)
    covered = jax.device_get(_covered(recorded.poses, env_params))
    recorded = dataclasses.replace(recorded, covered=covered)
    return [
        Episode(agent.name, world.occupancy_map, env_params, recorded.of_robots(index))
        for index in range(len(keys))
    ]


@jax.jit
def _covered(poses: Array, env_params: EnvParams) -> Array:
    """[T + 1, E, ...] the points covered along poses [T + 1, E, 3]."""
    return jax.vmap(covered_along, in_axes=(1, None), out_axes=1)(poses, env_params)
