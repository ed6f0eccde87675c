"""Episodes of the baselines: the oracle and the wall follower.

They choose their actions on the host. For the same keys, starts, goals and noise are the same as in
`episodes.run_episodes`. The step is that of the rollout, and the result is the same `Trajectory`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.agent.networks import QOutput
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.baselines.bug import BugNavigator
from sqn_jax.baselines.oracle import Oracle
from sqn_jax.env import NUM_ACTIONS, EnvParams, EnvState, Observation
from sqn_jax.env.several_maps import select_maps
from sqn_jax.evaluation.episodes import (
    EpisodeResults,
    GivenTasks,
    metrics_of,
    start_by_hand,
    step_by_hand,
    task_metrics,
)
from sqn_jax.maps import OccupancyMap
from sqn_jax.training.rollout import EpisodeMetrics, with_ends

Ints = NDArray[np.int64]
Choose = Callable[[Observation, EnvState], Ints]
"""Actions [E] from the observations and env states of all robots; called once per step."""


def oracle(occupancy_map: OccupancyMap, env_params: EnvParams) -> Choose:
    """A navigator that knows the map, for the episodes of one run.

    Args:
        occupancy_map: the map that `env_params` was made from.
        env_params: the world.

    Returns:
        A function that raises ValueError if the map is not that of `env_params`, or the robot
        cannot move or turn.
    """
    navigator: Oracle | None = None

    def choose(_: Observation, state: EnvState) -> Ints:
        nonlocal navigator
        poses, goals = np.asarray(state.pose, np.float64), np.asarray(state.goal, np.float64)
        if navigator is None:
            navigator = Oracle(occupancy_map, env_params, goals)
        return navigator.choose(poses)

    return choose


def bug(env_params: EnvParams, num_episodes: int) -> Choose:
    """The wall follower, which sees only the observation."""
    navigator = BugNavigator(env_params.config, num_episodes)

    def choose(obs: Observation, _: EnvState) -> Ints:
        ranges, goal = np.asarray(obs.ranges, np.float64), np.asarray(obs.goal, np.float64)
        return navigator.choose(ranges, goal)

    return choose


def run_baseline(
    keys: Array,
    choose: Choose,
    env_params: EnvParams,
    *,
    goal_radii: Sequence[float] = (),
    fields: Sequence[str] = ("poses", "goals"),
) -> tuple[list[EpisodeMetrics], Trajectory]:
    """Run whole episodes with actions chosen on the host.

    Args:
        keys: [E] from `episodes.episode_keys`; the same keys give the same tasks and noise.
        choose: chooses the actions; a new function for each run.
        env_params: the world.
        goal_radii: m, within which the goal is reached; default: `env_params.goal_radius` only.
        fields: the fields of `Trajectory` to return.

    Returns:
        The metrics for each radius, [E] each, and the trajectory with these fields; NumPy arrays.
        `output` is a placeholder: one skill of weight 1 whose action values are 0.
    """
    # Observations of many episodes take much memory and are rarely needed.
    needed = ("actions", *(("obs",) if "obs" in fields else ()))
    trajectory = _run(keys, choose, env_params, needed)
    trajectory = dataclasses.replace(trajectory, output=_one_skill(trajectory))
    radii = goal_radii or [float(env_params.goal_radius)]
    return metrics_of(trajectory, radii), jax.device_get(trajectory.only(*fields))


def run_on_tasks(
    keys: Array,
    choose: Choose,
    env_params: EnvParams,
    tasks: GivenTasks,
    *,
    collision_ends: bool = False,
) -> EpisodeResults:
    """Run whole episodes of given tasks with actions chosen on the host.

    Args:
        keys: [E] from `episodes.episode_keys`.
        choose: chooses the actions; a new function for each run.
        env_params: from `env.several_maps.join_maps`.
        tasks: [E] of them.
        collision_ends: whether a refused move makes a task fail.
    """
    trajectory = _run(keys, choose, select_maps(env_params, tasks.maps), (), tasks)
    metrics = task_metrics(trajectory, tasks, collision_ends=collision_ends)
    starts, goals = jax.device_get((trajectory.poses[0], trajectory.goals))
    return EpisodeResults([metrics], starts, goals, Trajectory())


def _run(
    keys: Array,
    choose: Choose,
    env_params: EnvParams,
    fields: Sequence[str],
    tasks: GivenTasks | None = None,
) -> Trajectory:
    """The trajectory of E robots, with these fields and those that metrics need."""
    step_keys, first = start_by_hand(keys, env_params, tasks)
    needed = ("rewards", "terminated", "poses", "info", *fields)
    actors, steps = first, []
    for keys_of_step in step_keys:
        actions = jnp.asarray(choose(actors.obs, actors.env_state), jnp.int32)
        actors, step = step_by_hand(keys_of_step, actors, actions, env_params)
        steps.append(jax.device_get(step.only(*needed)))
    return with_ends(jax.tree.map(lambda *parts: np.stack(parts), *steps), first, actors)


def _one_skill(steps: Trajectory) -> QOutput:
    shape = steps.rewards.shape
    return QOutput(
        q_values=jnp.zeros((*shape, NUM_ACTIONS)),
        skill_weights=jnp.ones((*shape, 1)),
        skill_q_values=jnp.zeros((*shape, 1, NUM_ACTIONS)),
    )
