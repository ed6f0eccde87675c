"""Episodes of trained policies, without learning and without auto-reset.

Episodes of all evaluation seeds run `BATCH` at a time in the same compiled program, whatever is
returned of them. On a CPU an episode is the same bit for bit whether it runs alone or beside
others, for a score or a picture. On an accelerator all training seeds run in one call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import NDArray

from sqn_jax.agent.networks import Params, QNetwork
from sqn_jax.agent.trajectory import Trajectory, over_robots
from sqn_jax.env import EnvParams, EnvState, Observation, reset_to, sample_task
from sqn_jax.env.randomize import robot_axes
from sqn_jax.env.several_maps import select_maps, without_spawn_points
from sqn_jax.training.exported import exported_jit
from sqn_jax.training.rollout import (
    ActorState,
    EpisodeMetrics,
    RandomDraws,
    before_first_action,
    episode_metrics,
    random_draws,
    step_actors,
    unroll,
)

BATCH = 100
"""Episodes that run at once."""


@partial(jax.jit, static_argnames="num_episodes")
def episode_keys(key: Array, num_episodes: int) -> Array:
    """One key for each episode, [E]; key i does not depend on the number of episodes."""
    return jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(num_episodes))


@struct.dataclass
class GivenTasks:
    """Tasks that are given instead of drawn, one for each of E episodes."""

    starts: Array
    """[E, 3] x m, y m, heading rad; a heading that is NaN is drawn."""
    goals: Array
    """[E, 2] x m, y m."""
    maps: Array
    """[E] int32: which map of `env.several_maps.join_maps` each lies on."""
    max_steps: Array
    """[E] int32: steps until the episode ends as a failure, at most those of the world."""
    goal_radii: Array
    """[E] m."""


@exported_jit
def draw_tasks(keys: Array, env_params: EnvParams) -> tuple[Array, Array]:
    """The starts [E, 3] and goals [E, 2] that the episodes of keys [E] have in a world.

    A program of its own, so that the program of the episodes is the same for all kinds of tasks.
    """

    def draw(key: Array) -> tuple[Array, Array]:
        task_key, _ = jax.random.split(_start_key(key))
        return sample_task(task_key, env_params)

    return jax.vmap(draw)(keys)


def _start_key(key: Array) -> Array:
    """Out of the key of an episode that of its task and of the noise of its first scan."""
    return jax.random.split(jax.random.split(key)[0], 1)[0]


def _start_episodes(
    keys: Array, starts: Array, goals: Array, env_params: EnvParams
) -> tuple[RandomDraws, Observation, EnvState]:
    """Start the episodes of these keys: the random draws of their steps, and what is before them.

    All follows from an episode's own key, so policies that get the same keys and the same world
    have the same tasks and the same noise.

    Args:
        keys: [E] from `episode_keys`.
        starts: [E, 3] x m, y m, heading rad; a heading that is NaN is drawn.
        goals: [E, 2] x m, y m.
        env_params: the world, or that of each robot.

    Returns:
        The random draws [T, E], the first observations and the states of the env, [E, ...].
    """

    def draws_of(key: Array) -> RandomDraws:
        draws = random_draws(jax.random.split(key)[1], env_params.max_steps, 1)
        return jax.tree.map(lambda x: x[:, 0], draws)

    def begin(
        key: Array, start: Array, goal: Array, world: EnvParams
    ) -> tuple[Observation, EnvState]:
        heading_key, noise_key = jax.random.split(_start_key(key))
        drawn = jax.random.uniform(heading_key, (), minval=-jnp.pi, maxval=jnp.pi)
        heading = jnp.where(jnp.isnan(start[2]), drawn, start[2])
        return reset_to(noise_key, start.at[2].set(heading), goal, world)

    draws = jax.vmap(draws_of, out_axes=1)(keys)
    begin_all = jax.vmap(begin, in_axes=(0, 0, 0, robot_axes(env_params)))
    obs, env_state = begin_all(keys, starts, goals, env_params)
    return draws, obs, env_state


class EpisodeResults(NamedTuple):
    """What came of E episodes of one policy; NumPy arrays."""

    metrics: list[EpisodeMetrics]
    """For each goal radius, for given tasks once; [E] each."""
    starts: NDArray[np.floating]
    """[E, 3] x m, y m, heading rad."""
    goals: NDArray[np.floating]
    """[E, 2] x m, y m."""
    trajectory: Trajectory
    """The requested fields of all steps."""

    def of_episodes(self, chosen: slice) -> EpisodeResults:
        """Some of the episodes."""
        metrics = jax.tree.map(lambda x: x[chosen], self.metrics)
        trajectory = self.trajectory.of_robots(chosen)
        return EpisodeResults(metrics, self.starts[chosen], self.goals[chosen], trajectory)


def run_seeds(
    keys: Array,
    params: Params,
    env_params: EnvParams,
    network: QNetwork,
    *,
    epsilon: float = 0.0,
    goal_radii: Sequence[float] = (),
    fields: Sequence[str] = (),
    on_batch: Callable[[int], object] = lambda count: None,
    tasks: GivenTasks | None = None,
    collision_ends: bool = False,
) -> list[EpisodeResults]:
    """Run the same episodes with S policies, a batch of episodes at a time.

    Args:
        keys: [E] from `episode_keys`; independent of any training key.
        params: parameters of the networks, with a leading axis [S].
        env_params: the world, with its noise; for given tasks from `env.several_maps.join_maps`.
        network: the network of these parameters.
        epsilon: probability of a random action in each step; 0 is greedy.
        goal_radii: m, within which the goal is reached; default: `env_params.goal_radius` only.
        fields: the fields of `Trajectory` to return; all together take about 0.4 kB per step.
        on_batch: called after each batch with its number of episodes, of all policies together.
        tasks: the tasks of the episodes, with radii of their own; None: drawn from the world.
        collision_ends: whether a collision makes a given task fail.

    Returns:
        The results of each policy.
    """
    radii = goal_radii or [float(env_params.goal_radius)]
    world = without_spawn_points(env_params)
    groups = _groups(params)
    batches = []
    for first in range(0, len(keys), BATCH):
        count = min(BATCH, len(keys) - first)
        chosen = first + np.arange(BATCH) % count  # The rest of a batch is padding.
        own_keys, own_tasks = _rows((keys, tasks), chosen)
        if own_tasks is None:
            places = draw_tasks(own_keys, env_params)
        else:
            places = own_tasks.starts, own_tasks.goals
        maps = None if own_tasks is None else own_tasks.maps
        results = []
        for trajectory, starts in (
            one
            for group in groups
            for one in _run_batch(own_keys, *places, maps, group, world, network, epsilon)
        ):
            if own_tasks is None:
                metrics = metrics_of(trajectory, radii)
            else:
                metrics = [task_metrics(trajectory, own_tasks, collision_ends=collision_ends)]
            ends = jax.device_get((starts, places[1], trajectory.only(*fields)))
            results.append(EpisodeResults(metrics, *ends).of_episodes(slice(count)))
        batches.append(results)
        on_batch(len(results) * count)
    return [join_results(results) for results in zip(*batches, strict=True)]


def join_results(batches: Sequence[EpisodeResults]) -> EpisodeResults:
    """The results of several batches of episodes of one policy, in their order."""

    def join(*parts: NDArray[Any], axis: int = 0) -> NDArray[Any]:
        return np.concatenate(parts, axis)

    metrics, starts, goals, trajectories = zip(*batches, strict=True)
    trajectory = over_robots(join, *trajectories)
    return EpisodeResults(jax.tree.map(join, *metrics), join(*starts), join(*goals), trajectory)


def run_episodes(
    keys: Array,
    params: Params,
    env_params: EnvParams,
    network: QNetwork,
    *,
    fields: Sequence[str] = ("poses", "goals"),
    **options: Any,
) -> tuple[list[EpisodeMetrics], Trajectory]:
    """Run episodes of one policy.

    Args:
        keys: [E] from `episode_keys`.
        params: parameters of one network, without an axis of seeds.
        env_params: the world.
        network: the network of these parameters.
        fields: the fields of `Trajectory` to return.
        options: others of `run_seeds`.

    Returns:
        The metrics for each radius, [E] each, and the trajectory with these fields; NumPy arrays.
    """
    stacked = jax.tree.map(lambda x: np.asarray(x)[None], params)  # JAX would compile a program.
    (results,) = run_seeds(keys, stacked, env_params, network, fields=fields, **options)
    return results.metrics, results.trajectory


def _groups(params: Params) -> list[Params]:
    """The policies [S, ...] that run in one call: all, on a CPU each alone.

    There a call with several takes as long as one after the other, and rounds rewards otherwise.
    """
    if jax.default_backend() != "cpu":
        return [params]
    num_policies = len(jax.tree.leaves(params)[0])
    return [jax.tree.map(lambda x, i=i: x[i : i + 1], params) for i in range(num_policies)]


@jax.jit
def _rows(arrays: Any, chosen: NDArray[np.integer]) -> Any:
    """These rows of each array of a tree: one program where indexing would be a handful."""
    return jax.tree.map(lambda x: x[chosen], arrays)


@exported_jit(static_argname="network")
def _run_batch(
    keys: Array,
    starts: Array,
    goals: Array,
    maps: Array | None,
    params: Params,
    world: EnvParams,
    network: QNetwork,
    epsilon: float,
) -> list[tuple[Trajectory, Array]]:
    """For each policy of params [S, ...] the trajectory of E robots and their starts [E, 3]."""
    if maps is not None:
        world = select_maps(world, maps)
    draws, obs, env_state = _start_episodes(keys, starts, goals, world)
    actors = before_first_action(obs, env_state, network)
    epsilons = jnp.full(len(keys), epsilon, jnp.float32)

    def run(params: Params) -> Trajectory:
        return unroll(draws, params, actors, epsilons, world, network)[1]

    num_policies = len(jax.tree.leaves(params)[0])
    if num_policies == 1:
        # An axis of one would only be in the compiler's way.
        trajectories = [run(jax.tree.map(lambda x: x[0], params))]
    else:
        stacked = jax.vmap(run)(params)
        trajectories = [jax.tree.map(lambda x, i=i: x[i], stacked) for i in range(num_policies)]
    return [(trajectory, trajectory.poses[0]) for trajectory in trajectories]


def metrics_of(trajectory: Trajectory, goal_radii: Sequence[float]) -> list[EpisodeMetrics]:
    """`episode_metrics` for each radius, m; NumPy arrays [E].

    A program of its own, so that the program of the episodes is the same for all radii.
    """
    judged = trajectory.only("rewards", "poses", "info")
    on_host: list[EpisodeMetrics] = jax.device_get(
        [_metrics(judged, np.float32(radius)) for radius in goal_radii]
    )
    return on_host


def task_metrics(
    trajectory: Trajectory, tasks: GivenTasks, *, collision_ends: bool
) -> EpisodeMetrics:
    """`episode_metrics` by the limits of each task; NumPy arrays [E]."""
    judged = trajectory.only("rewards", "poses", "info")
    ends = np.bool_(collision_ends)
    on_host: EpisodeMetrics = jax.device_get(
        _metrics(judged, tasks.goal_radii, tasks.max_steps, ends)
    )
    return on_host


_metrics = jax.jit(episode_metrics)


def start_by_hand(
    keys: Array, env_params: EnvParams, tasks: GivenTasks | None = None
) -> tuple[Array, ActorState]:
    """Start the episodes of `run_seeds` for an agent that is not a network.

    Args:
        keys: [E] from `episode_keys`.
        env_params: the world, or that of each robot.
        tasks: the tasks; None: drawn from the world.

    Returns:
        The keys [T, E] for `step_by_hand`, and the actor state, whose carry is empty [E, 0].
    """
    if tasks is None:
        starts, goals = draw_tasks(keys, env_params)
    else:
        starts, goals = tasks.starts, tasks.goals
    return _start_by_hand(keys, starts, goals, without_spawn_points(env_params))


@jax.jit
def _start_by_hand(
    keys: Array, starts: Array, goals: Array, world: EnvParams
) -> tuple[Array, ActorState]:
    draws, obs, env_state = _start_episodes(keys, starts, goals, world)
    return draws.step_keys, ActorState(obs, env_state, carry=jnp.zeros((len(keys), 0)))


@jax.jit
def step_by_hand(
    step_keys: Array, actors: ActorState, actions: Array, env_params: EnvParams
) -> tuple[ActorState, Trajectory]:
    """Compiled `rollout.step_actors`: one step with actions [E] chosen on the host."""
    return step_actors(step_keys, actors, actions, env_params)
