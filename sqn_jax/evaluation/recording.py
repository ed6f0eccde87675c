"""Episodes with everything that happened in them, for pictures: the states of the simulator itself.

`episodes.run_episodes` keeps what statistics need. Here a few episodes are kept whole: the covered
area, the readings and the parts of the reward are those that the step function produced, none is
worked out again. `record` goes from a policy and the name of a map to such episodes on the host.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import NDArray

from sqn_jax.agent.networks import Params, QOutput, make_network
from sqn_jax.config import Algorithm, NetworkConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams, EnvState, Observation
from sqn_jax.env.coverage import Lattice
from sqn_jax.env.navigation import Info
from sqn_jax.evaluation.compare import (
    SPAWN_MODES,
    Learnt,
    Settings,
    Tasks,
    World,
    load_maps,
    robot_for,
    task_key,
    worlds,
)
from sqn_jax.evaluation.episodes import episode_keys, start_episode
from sqn_jax.maps import OccupancyMap
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.rollout import Chance, Fleet, act_and_step, draw_chance

Floats = NDArray[np.floating]


@struct.dataclass
class Recording:
    """E episodes of T steps. Index t of `states` and `observations` is before step t."""

    states: EnvState
    """[E, T + 1, ...] poses, goals, covered points."""
    observations: Observation
    """[E, T + 1, ...] what the agent saw, in 0..1 and with noise where there is any."""
    actions: Array
    """[E, T] int32."""
    rewards: Array
    """[E, T]."""
    info: Info
    """[E, T] each: what `navigation.step` says of a step, the parts of the reward among it."""
    outputs: QOutput
    """[E, T, ...] action values, skill decision, action values of each skill."""

    def episode(self, index: int) -> Recording:
        """One of them: the same arrays without the first axis."""
        chosen: Recording = jax.tree.map(lambda x: x[index], self)
        return chosen


@partial(jax.jit, static_argnames=("algo", "network_config"))
def record_episodes(
    keys: Array,
    params: Params,
    env_params: EnvParams,
    *,
    algo: Algorithm,
    network_config: NetworkConfig,
) -> Recording:
    """Drive greedy episodes and keep all of them.

    Tasks and noise are those that `episodes.run_episodes` has for the same keys. How an episode
    goes on may differ from there, since sums are rounded in another order.

    Args:
        keys: [E] from `episodes.episode_keys`.
        params: parameters of one network, without a seed axis.
        env_params: the world, with the noise it was made with.
        algo: which network the parameters belong to.
        network_config: its sizes.

    Returns:
        The episodes; a step takes about 1 kB on the maze and 6 kB in the cave.
    """
    network = make_network(algo, network_config, NUM_ACTIONS)
    advance = partial(
        act_and_step,
        network=network,
        params=params,
        epsilon=jnp.zeros(1),
        env_params=env_params,
    )

    def one(key: Array) -> Recording:
        drive_key, fleet = start_episode(key, network, env_params)
        chance = draw_chance(drive_key, env_params.max_steps, 1)

        def body(fleet: Fleet, chance: Chance) -> tuple[Fleet, Any]:
            after, (_, _, action, (reward, _, info), output) = advance(fleet, chance)
            return after, ((after.state, after.obs), action, reward, info, output)

        _, (seen, *steps) = jax.lax.scan(body, fleet, chance)
        states, observations = jax.tree.map(
            lambda first, later: jnp.concatenate([first[None], later])[:, 0],
            (fleet.state, fleet.obs),
            seen,
        )
        return Recording(states, observations, *jax.tree.map(lambda x: x[:, 0], steps))

    return jax.vmap(one)(keys)


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of T steps on the host, with all that a picture of it needs; NumPy arrays.

    Arrays of T + 1 hold what was before each step, and after the last.
    """

    agent: str
    """Who drove."""
    occupancy_map: OccupancyMap
    poses: Floats
    """[T + 1, 3] x m, y m, heading rad."""
    goal: Floats
    """[2] x m, y m."""
    ranges: Floats
    """[T + 1, R] m, what the agent saw, with noise where there is any; from the rightmost beam."""
    covered: NDArray[np.uint32]
    """[T + 1, ...] the points seen so far, a bit each; see `covered_points`."""
    actions: NDArray[np.integer]
    """[T] in 0..4, see `env.ACTION_NAMES`."""
    rewards: Floats
    """[T]."""
    reward_parts: Floats
    """[T, 3] navigation, exploration and time, weighted: their sum is the reward."""
    goal_distances: Floats
    """[T] m, in a straight line, after each step."""
    reachable: NDArray[np.bool_]
    """[T] whether the goal was in view and not hidden after each step (paper eq. 8)."""
    collisions: NDArray[np.bool_]
    """[T] the move was refused."""
    covered_areas: Floats
    """[T] m2 newly seen."""
    skill_weights: Floats
    """[T, K] the skill decision."""
    skill_q_values: Floats
    """[T, K, A] action values of each skill."""
    q_values: Floats
    """[T, A] their weighted sum, by which the action was chosen."""
    field_of_view: float
    """Angle from the first beam to the last, rad."""
    max_range: float
    """m."""
    goal_radius: float
    """m."""
    robot_radius: float
    """m."""
    time_step: float
    """s."""
    lattice: Lattice
    """Where the points of `covered` lie."""

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.actions)

    @property
    def success(self) -> bool:
        """Whether the goal radius was entered at any time."""
        return bool((self.goal_distances < self.goal_radius).any())

    @property
    def time_steps(self) -> int:
        """The step of the first entry, counted from 1; T for a failure."""
        inside = self.goal_distances < self.goal_radius
        return int(inside.argmax()) + 1 if inside.any() else self.num_steps

    def beam_angles(self) -> Floats:
        """[R] directions of the beams from the heading, rad, from the rightmost to the leftmost."""
        half = self.field_of_view / 2
        return np.linspace(-half, half, self.ranges.shape[1])

    def beam_ends(self, index: int) -> Floats:
        """[R, 2] m, where the beams end on the map before step `index` (0..T)."""
        x, y, heading = self.poses[index]
        angles = heading + self.beam_angles()
        reach = self.ranges[index]
        return np.stack([x + reach * np.cos(angles), y + reach * np.sin(angles)], axis=-1)

    def covered_points(self, index: int) -> Floats:
        """[P, 2] m, the points seen before step `index` (0..T), each for `lattice.cell` squared."""
        return self.lattice.points()[covered_bits(self.covered[index])]

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
        mask: NDArray[np.bool_] = covered_bits(self.covered[index])[place]
        return mask


def covered_bits(covered: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """A `covered` array [words, groups, rows] with an axis more: [..., 32], a truth a point."""
    return (covered[..., None] >> np.arange(32, dtype=np.uint32) & 1).astype(bool)


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
    """Drive a policy greedily and keep everything: the first episodes of `sqn evaluate`'s.

    Args:
        policy: who drives.
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
    return record_world(policy, world, episodes=episodes, seed=seed, index=index)


def record_world(
    policy: Policy, world: World, *, episodes: int, seed: int = 1_000, index: int = 0
) -> list[Episode]:
    """The same in a world that is there already."""
    keys = episode_keys(task_key(seed, world.tasks), episodes)
    config = policy.config
    recording = record_episodes(
        keys,
        policy.params[index],
        world.env_params,
        algo=config.algo,
        network_config=config.network,
    )
    return on_host(recording, world, agent=config.algo)


def on_host(recording: Recording, world: World, *, agent: str) -> list[Episode]:
    """The episodes of a recording one by one, as NumPy arrays."""
    params = world.env_params
    config = params.config
    weights = np.asarray(params.reward_weights)
    told: Any = jax.device_get(recording)
    info = told.info
    parts = ("reward_navigation", "reward_exploration", "reward_time")
    reward_parts = np.stack([info[name] for name in parts], axis=-1) * weights
    return [
        Episode(
            agent=agent,
            occupancy_map=world.occupancy_map,
            poses=told.states.pose[e],
            goal=told.states.goal[e, 0],
            ranges=told.observations.ranges[e] * config.max_range,
            covered=told.states.covered[e],
            actions=told.actions[e],
            rewards=told.rewards[e],
            reward_parts=reward_parts[e],
            goal_distances=info["goal_distance"][e],
            reachable=info["reward_navigation"][e] > 0,
            collisions=info["collision"][e],
            covered_areas=info["covered_area"][e],
            skill_weights=told.outputs.skill_weights[e],
            skill_q_values=told.outputs.skill_q_values[e],
            q_values=told.outputs.q_values[e],
            field_of_view=math.radians(config.field_of_view_deg),
            max_range=config.max_range,
            goal_radius=float(params.goal_radius),
            robot_radius=config.robot_radius,
            time_step=float(params.time_step),
            lattice=params.lattice,
        )
        for e in range(len(told.actions))
    ]
