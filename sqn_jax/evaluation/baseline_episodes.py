"""Episodes of the baselines: the oracle and the wall follower.

For the same keys, starts, goals and noise are the same as in `episodes.run_episodes`. The step is
that of the rollout, and the result is the same `Trajectory`. The wall follower and the plans of the
oracle run in compiled programs; where noise makes the oracle plan anew after each step, the host
chooses the actions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.agent.networks import QOutput
from sqn_jax.agent.trajectory import Trajectory, over_robots
from sqn_jax.baselines.bug import Bug, BugMemory
from sqn_jax.baselines.oracle import Oracle
from sqn_jax.config import EnvConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams, EnvState, Observation
from sqn_jax.env.navigation import STAND
from sqn_jax.env.several_maps import select_maps, without_spawn_points
from sqn_jax.evaluation.cached_paths import prepared_oracle
from sqn_jax.evaluation.episodes import (
    BATCH,
    EpisodeResults,
    GivenTasks,
    metrics_of,
    start_by_hand,
    step_by_hand,
    task_metrics,
)
from sqn_jax.maps import OccupancyMap
from sqn_jax.training.rollout import ActorState, EpisodeMetrics, step_actors, with_ends

CHUNK = 100
"""Steps of one call of a compiled program, whatever the length of the episodes."""

JUDGED = ("rewards", "terminated", "poses", "info")
"""Fields of a trajectory that are always there; the first three decide the metrics."""

Ints = NDArray[np.int64]
Choose = Callable[[Observation, EnvState], Ints]
"""Actions [E] from the observations and env states of all robots; called once per step."""


class Planner(Protocol):
    """Chooses actions by a plan: `Oracle`, or several of them."""

    def choose(self, poses: NDArray[np.float64]) -> Ints:
        """Actions [E] at poses [E, 3]; called once per step."""

    def outlook(self) -> NDArray[np.integer]:
        """Actions [E, T'] of the steps to come, if everything goes as planned."""


class Navigator(Protocol):
    """An agent without a network."""

    def __call__(
        self,
        keys: Array,
        env_params: EnvParams,
        fields: Sequence[str],
        tasks: GivenTasks | None = None,
    ) -> Trajectory:
        """Run whole episodes.

        Args:
            keys: [E] from `episodes.episode_keys`; the same keys give the same tasks and noise.
            env_params: the world, or that of each robot.
            fields: the fields of the trajectory to return, beside those that metrics need.
            tasks: [E] of them; None: drawn from the world.

        Returns:
            NumPy arrays [T, E, ...].
        """


def oracle(occupancy_map: OccupancyMap, env_params: EnvParams) -> Navigator:
    """A navigator that knows the map.

    Args:
        occupancy_map: the map that `env_params` was made from.
        env_params: the world.

    Returns:
        A navigator that raises ValueError if the map is not that of `env_params`, or the robot
        cannot move or turn.
    """
    return planned(lambda goals: Oracle(occupancy_map, env_params, goals))


def oracle_ahead(keys: Array, occupancy_map: OccupancyMap, env_params: EnvParams) -> Navigator:
    """The oracle, which plans the episodes of these keys beside whatever else is done.

    It is at work when this returns, in a thread of its own; the episodes must be those of the keys.
    """
    _, first = start_by_hand(keys, env_params)
    goals, poses = jax.device_get((first.env_state.goal, first.env_state.pose))

    thread = ThreadPoolExecutor(1)
    planner = thread.submit(prepared_oracle, occupancy_map, env_params, goals, poses)
    thread.shutdown(wait=False)
    return planned(lambda _: planner.result())


def planned(make: Callable[[NDArray[np.float64]], Planner]) -> Navigator:
    """A navigator that plans.

    Without noise on the motion its actions are known from the start, but for the rare move that the
    simulator refuses: the episodes run as one program, once more for each surprise.

    Args:
        make: makes the planner for goals [E, 2] m, of a run.
    """

    def run(
        keys: Array,
        env_params: EnvParams,
        fields: Sequence[str],
        tasks: GivenTasks | None = None,
    ) -> Trajectory:
        if env_params.config.velocity_noise > 0:
            return by_hand(lambda goals: _by_poses(make(goals)))(keys, env_params, fields, tasks)
        _, first = start_by_hand(keys, _selected(env_params, tasks), tasks)
        goals, poses = jax.device_get((first.env_state.goal, first.env_state.pose))
        planner = make(goals.astype(np.float64))
        actions = np.full((env_params.max_steps, len(keys)), STAND, np.int32)
        trajectory = None
        for step in range(env_params.max_steps):
            if trajectory is not None:
                poses = trajectory.poses[step]
            chosen = planner.choose(poses.astype(np.float64))
            if trajectory is None or (chosen != actions[step]).any():
                actions[step], actions[step + 1 :] = chosen, planner.outlook().T
                trajectory = _unroll(keys, env_params, fields, tasks, plan=actions)
        assert trajectory is not None
        return trajectory

    return run


def _by_poses(planner: Planner) -> Choose:
    return lambda obs, state: planner.choose(np.asarray(state.pose, np.float64))


def bug(config: EnvConfig) -> Navigator:
    """The wall follower, which sees only the observation."""
    navigator = Bug(config)

    def run(
        keys: Array, env_params: EnvParams, fields: Sequence[str], tasks: GivenTasks | None = None
    ) -> Trajectory:
        return _unroll(keys, env_params, fields, tasks, bug=navigator)

    return run


def by_hand(make: Callable[[NDArray[np.float64]], Choose]) -> Navigator:
    """A navigator whose actions are chosen on the host.

    Args:
        make: makes for goals [E, 2] m, of a run, what chooses the actions.
    """

    def run(
        keys: Array, env_params: EnvParams, fields: Sequence[str], tasks: GivenTasks | None = None
    ) -> Trajectory:
        worlds = _selected(env_params, tasks)
        step_keys, first = start_by_hand(keys, worlds, tasks)
        choose = make(np.asarray(first.env_state.goal, np.float64))
        actors, steps = first, []
        for keys_of_step in step_keys:
            actions = jnp.asarray(choose(actors.obs, actors.env_state), jnp.int32)
            actors, step = step_by_hand(keys_of_step, actors, actions, worlds)
            steps.append(jax.device_get(step.only(*JUDGED, *fields)))
        return with_ends(jax.tree.map(lambda *parts: np.stack(parts), *steps), first, actors)

    return run


def _selected(env_params: EnvParams, tasks: GivenTasks | None) -> EnvParams:
    return env_params if tasks is None else select_maps(env_params, tasks.maps)


def _unroll(
    keys: Array,
    env_params: EnvParams,
    fields: Sequence[str],
    tasks: GivenTasks | None,
    *,
    plan: NDArray[np.int32] | None = None,
    bug: Bug | None = None,
) -> Trajectory:
    """Episodes of the wall follower, or by a plan [T, E]; a batch of robots at a time."""
    batches = []
    for begin in range(0, len(keys), BATCH):
        count = min(BATCH, len(keys) - begin)
        # The rest of a batch is padding.
        chosen = begin + np.arange(min(len(keys), BATCH)) % count
        own_tasks = jax.tree.map(lambda x, i=chosen: x[i], tasks)
        own_plan = None if plan is None else plan[:, chosen]
        batch = _unroll_batch(keys[chosen], env_params, fields, own_tasks, own_plan, bug)
        batches.append(batch.of_robots(slice(count)))
    return over_robots(lambda *parts, axis=0: np.concatenate(parts, axis), *batches)


def _unroll_batch(
    keys: Array,
    env_params: EnvParams,
    fields: Sequence[str],
    tasks: GivenTasks | None,
    plan: NDArray[np.int32] | None,
    bug: Bug | None,
) -> Trajectory:
    """`_unroll` for one batch, a chunk of steps at a time."""
    worlds = _selected(env_params, tasks)
    step_keys, first = start_by_hand(keys, worlds, tasks)
    length = env_params.max_steps
    num_chunks = -(-length // CHUNK)
    # Chunks know no limit of their own, so that maps share their program.
    worlds = dataclasses.replace(without_spawn_points(worlds), max_steps=CHUNK)
    memory = None
    if bug is not None:
        radii = env_params.goal_radius if tasks is None else tasks.goal_radii
        radii = jnp.broadcast_to(radii, len(keys))
        memory = jax.vmap(partial(bug.start, num_chunks * CHUNK))(radii)
    actors, chunks = first, []
    for begin in range(0, length, CHUNK):
        steps = np.minimum(np.arange(begin, begin + CHUNK), length - 1)
        planned_actions = None if plan is None else plan[steps]
        (memory, actors), chunk = _run_chunk(
            memory, actors, step_keys[steps], planned_actions, worlds, bug
        )
        chunk = jax.device_get(chunk.only(*JUDGED, *fields))
        chunks.append(jax.tree.map(lambda x, n=length - begin: x[:n], chunk))
        if plan is not None and _stands(chunk, plan[begin + CHUNK :], env_params.config):
            # All further steps are as the last.
            rest = max(0, length - begin - CHUNK)
            chunks.append(jax.tree.map(lambda x, n=rest: np.repeat(x[-1:], n, axis=0), chunk))
            break
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)
    return jax.device_get(with_ends(joined, first, actors))


def _stands(chunk: Trajectory, plan: NDArray[np.int32], config: EnvConfig) -> bool:
    """Whether robots stood still at the end of a chunk, and will, and see the same each time."""
    stood = (chunk.poses[-1] == chunk.poses[-2]).all()
    return bool(stood and (plan == STAND).all() and config.range_noise == 0)


@partial(jax.jit, static_argnames="bug")
def _run_chunk(
    memory: BugMemory | None,
    actors: ActorState,
    step_keys: Array,
    plan: Array | None,
    worlds: EnvParams,
    bug: Bug | None,
) -> tuple[tuple[BugMemory | None, ActorState], Trajectory]:
    """The steps of a chunk, and the memories and robots after them."""

    def step(
        state: tuple[BugMemory | None, ActorState], of_step: tuple[Array, Array | None]
    ) -> tuple[tuple[BugMemory | None, ActorState], Trajectory]:
        memory, actors = state
        keys, actions = of_step
        if bug is not None and memory is not None:
            memory, actions = jax.vmap(bug.act)(memory, actors.obs)
        assert actions is not None
        actors, taken = step_actors(keys, actors, actions, worlds)
        return (memory, actors), taken

    return jax.lax.scan(step, (memory, actors), (step_keys, plan))


def run_baseline(
    keys: Array,
    navigator: Navigator,
    env_params: EnvParams,
    *,
    goal_radii: Sequence[float] = (),
    fields: Sequence[str] = ("poses", "goals"),
    on_batch: Callable[[int], object] = lambda count: None,
) -> tuple[list[EpisodeMetrics], Trajectory]:
    """Run whole episodes of a baseline.

    Args:
        keys: [E] from `episodes.episode_keys`; the same keys give the same tasks and noise.
        navigator: the baseline.
        env_params: the world.
        goal_radii: m, within which the goal is reached; default: `env_params.goal_radius` only.
        fields: the fields of `Trajectory` to return.
        on_batch: called after each batch with its number of episodes.

    Returns:
        The metrics for each radius, [E] each, and the trajectory with these fields; NumPy arrays.
        `output` is a placeholder: one skill of weight 1 whose action values are 0.
    """
    # Observations of many episodes take much memory and are rarely needed.
    needed = ("actions", *(("obs",) if "obs" in fields else ()))
    trajectory = navigator(keys, _own_robot(env_params), needed)
    if "output" in fields:
        trajectory = dataclasses.replace(trajectory, output=_one_skill(trajectory))
    radii = goal_radii or [float(env_params.goal_radius)]
    metrics = []
    for begin in range(0, len(keys), BATCH):
        of_batch = slice(begin, begin + BATCH)
        metrics.append(metrics_of(trajectory.of_robots(of_batch), radii))
        on_batch(len(keys[of_batch]))
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), *metrics)
    return joined, jax.device_get(trajectory.only(*fields))


def run_on_tasks(
    keys: Array,
    navigator: Navigator,
    env_params: EnvParams,
    tasks: GivenTasks,
    *,
    collision_ends: bool = False,
) -> EpisodeResults:
    """Run whole episodes of given tasks.

    Args:
        keys: [E] from `episodes.episode_keys`.
        navigator: the baseline.
        env_params: from `env.several_maps.join_maps`.
        tasks: [E] of them.
        collision_ends: whether a collision makes a task fail.
    """
    trajectory = navigator(keys, _own_robot(env_params), (), tasks)
    metrics = task_metrics(trajectory, tasks, collision_ends=collision_ends)
    starts, goals = jax.device_get((trajectory.poses[0], trajectory.goals))
    return EpisodeResults([metrics], starts, goals, Trajectory())


def _own_robot(env_params: EnvParams) -> EnvParams:
    """A world in which baselines, which know how wide they are, see obstacles as they are.

    Nor has their robot a bumper.
    """
    config = dataclasses.replace(env_params.config, scan_margin=0.0, bumper=0.0)
    return dataclasses.replace(env_params, config=config)


def _one_skill(steps: Trajectory) -> QOutput:
    shape = steps.rewards.shape
    return QOutput(
        q_values=jnp.zeros((*shape, NUM_ACTIONS)),
        skill_weights=jnp.ones((*shape, 1)),
        skill_q_values=jnp.zeros((*shape, 1, NUM_ACTIONS)),
    )
