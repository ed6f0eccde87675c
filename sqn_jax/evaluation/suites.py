"""Suites of given tasks on any maps: agents side by side, per task, per map and over the suite.

`evaluate_suite` prepares maps a chunk at a time, runs every agent on the tasks of the chunk in one
program for all maps, and returns the contents of the evaluation file. It prints nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sqn_jax.baselines.oracle import Oracle
from sqn_jax.baselines.shortest_paths import shortest_path_lengths
from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env
from sqn_jax.env.navigation import STAND
from sqn_jax.env.prepare import with_noise
from sqn_jax.env.several_maps import join_maps
from sqn_jax.evaluation import baseline_episodes, episodes, suite_scores
from sqn_jax.evaluation.agents import Agent, BaselineAgent, OnBatch, TrainedAgent
from sqn_jax.evaluation.episodes import EpisodeResults, GivenTasks
from sqn_jax.evaluation.settings import SuiteSettings, with_body
from sqn_jax.maps import OccupancyMap
from sqn_jax.tasks.suite import Task, TaskSuite
from sqn_jax.training import memory_budget
from sqn_jax.training.devices import num_cores

Item = TypeVar("Item")

LoadMap = Callable[[str], OccupancyMap]
"""Makes a map of `Task.map_file`; the same for the same name."""

CELLS_AT_ONCE = 2**22
"""Cells of the maps of a chunk, unless a single map has more: tables of 0.3 GB, of two chunks."""

EPISODE_STREAM = 2
"""Which of the streams of an evaluation seed the episodes of a suite follow; drawn tasks have 0
and 1."""


@dataclass(frozen=True, eq=False)
class SuiteChunk:
    """Some tasks of a suite with their maps, prepared for a robot."""

    numbers: NDArray[np.int64]
    """[n] places of the tasks in the suite."""
    maps: list[OccupancyMap]
    worlds: list[EnvParams]
    """For each map the world of that map alone."""
    joined: EnvParams
    """All maps in one, see `env.several_maps`."""
    tasks: GivenTasks
    """[n, ...] in the frames of the grids."""
    shortest_paths: NDArray[np.float64]
    """[n] m."""
    collision_ends: bool

    def repeated(self, tries: int) -> GivenTasks:
        """Each task so many times in a row, [n * tries, ...]."""
        repeated: GivenTasks = jax.tree.map(lambda x: jnp.repeat(x, tries, axis=0), self.tasks)
        return repeated


class SuiteMaps:
    """The maps of a suite by name, each loaded once, while they fit into some memory."""

    def __init__(self, load: LoadMap, cells: int = 2**28) -> None:
        """`cells` bounds the maps that stay in memory; others are loaded again when needed."""
        self._load, self._left = load, cells
        self._loaded: dict[str, OccupancyMap] = {}

    def __call__(self, map_file: str) -> OccupancyMap:
        """The map of this name."""
        if map_file in self._loaded:
            return self._loaded[map_file]
        occupancy_map = self._load(map_file)
        if occupancy_map.occupied.size <= self._left:
            self._left -= occupancy_map.occupied.size
            self._loaded[map_file] = occupancy_map
        return occupancy_map


def num_episodes(agents: Sequence[Agent], suite: TaskSuite, settings: SuiteSettings) -> int:
    """Episodes that `evaluate_suite` will run."""
    num_policies = sum(len(agent.training_seeds) for agent in agents)
    return len(suite.tasks) * settings.tries * num_policies


def evaluate_suite(
    agents: Sequence[Agent],
    suite: TaskSuite,
    maps: Mapping[float, LoadMap],
    settings: SuiteSettings,
    on_batch: OnBatch = lambda count: None,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Run every agent on every task.

    Args:
        agents: the agents; their names must differ. A robot gets what the suite fixes.
        suite: the tasks, checked by `tasks.check_tasks`.
        maps: for each radius of a robot, m, what makes the maps for it.
        settings: episodes, seeds and noise.
        on_batch: called with the number of episodes that have just been run.

    Returns:
        The contents of the evaluation file (`schema`, `suite`, `results`, `comparisons`; see
        `suite_scores`), and a record of each episode.
    """
    tables = {agent.name: suite_scores.empty_table(agent, suite, settings) for agent in agents}
    robots = {agent.name: robot_for(agent.env_config, suite) for agent in agents}
    for robot in dict.fromkeys(robots.values()):
        for chunk in one_ahead(chunks(suite, robot, maps[robot.robot_radius], settings.noise)):
            memory_budget.bound_programs()
            for agent in agents:
                if robots[agent.name] == robot:
                    results = run_chunk(agent, chunk, settings, on_batch)
                    tables[agent.name].fill(chunk.numbers, results, chunk.shortest_paths)
    return suite_scores.contents(list(tables.values()), suite, settings), [
        record for table in tables.values() for record in table.records(suite, settings)
    ]


def robot_for(env_config: EnvConfig, suite: TaskSuite) -> EnvConfig:
    """The robot of an agent with what a suite fixes, yet without noise."""
    robot = with_body(suite.robot_of(env_config), env_config)
    return dataclasses.replace(robot, near_goal_fraction=0.0, velocity_noise=0.0, range_noise=0.0)


def chunks(
    suite: TaskSuite,
    robot: EnvConfig,
    load: LoadMap,
    noise: tuple[float, float] = (0.0, 0.0),
    only: Collection[int] | None = None,
) -> Iterator[SuiteChunk]:
    """Prepare the tasks of a suite, or `only` some, for a robot, the maps of a chunk at a time.

    All chunks have the same number of steps, and count the covered area on the same lattice, so
    that they share their compiled program.
    """
    tasks_of: dict[str, list[int]] = {}
    for number, task in enumerate(suite.tasks):
        tasks_of.setdefault(task.map_file, []).append(number)
    sizes = {name: load(name) for name in tasks_of}
    if only is not None:  # The episodes are those of the whole suite: sizes and limits as there.
        tasks_of = {
            name: chosen
            for name, numbers in tasks_of.items()
            if (chosen := [number for number in numbers if number in only])
        }
    cells = {name: sizes[name].occupied.size for name in tasks_of}
    of_maps = [occupancy_map.size_m for occupancy_map in sizes.values()]
    tile_m = (max(width for width, _ in of_maps), max(height for _, height in of_maps))
    max_steps = max(task.max_steps for task in suite.tasks)
    for names in _groups(cells):
        maps = [load(name) for name in names]
        with ThreadPoolExecutor(num_cores()) as threads:
            made = threads.map(partial(make_env, config=robot), maps)
            worlds = [with_noise(world, *noise) for world in made]
        numbers = np.concatenate([tasks_of[name] for name in names])
        which = np.repeat(np.arange(len(names)), [len(tasks_of[name]) for name in names])
        tasks = [suite.tasks[number] for number in numbers]
        given = _given_tasks(tasks, which, maps)
        yield SuiteChunk(
            numbers=numbers,
            maps=maps,
            worlds=worlds,
            joined=join_maps(worlds, tile_m=tile_m, max_steps=max_steps),
            tasks=given,
            shortest_paths=_shortest_paths(tasks, given, maps, robot.robot_radius),
            collision_ends=suite.collision_ends,
        )


def one_ahead(items: Iterator[Item]) -> Iterator[Item]:
    """The same items; while one is in use, a thread makes the next."""
    thread = ThreadPoolExecutor(1)
    try:
        coming = thread.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = thread.submit(next, items, None)
            yield item
    finally:
        thread.shutdown(wait=False, cancel_futures=True)


def _groups(cells: dict[str, int]) -> Iterator[list[str]]:
    """Names of maps, in their order, of `CELLS_AT_ONCE` together or one alone."""
    group: list[str] = []
    total = 0
    for name, count in cells.items():
        if group and total + count > CELLS_AT_ONCE:
            yield group
            group, total = [], 0
        group.append(name)
        total += count
    if group:
        yield group


def _given_tasks(
    tasks: Sequence[Task],
    which: NDArray[np.int64],
    maps: Sequence[OccupancyMap],
) -> GivenTasks:
    """Tasks in the frames of their grids, [n, ...]."""
    starts, goals = np.empty((len(tasks), 3), np.float32), np.empty((len(tasks), 2), np.float32)
    for row, (task, number) in enumerate(zip(tasks, which, strict=True)):
        occupancy_map = maps[number]
        start, goal = occupancy_map.to_grid_frame([task.start, task.goal])
        starts[row, :2] = single_precision(start, occupancy_map.resolution)
        yaw = occupancy_map.origin[2]
        starts[row, 2] = np.nan if task.heading is None else task.heading - yaw
        goals[row] = goal
    starts[:, 2] = (starts[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return GivenTasks(
        starts=jnp.asarray(starts),
        goals=jnp.asarray(goals),
        maps=jnp.asarray(which, jnp.int32),
        max_steps=jnp.asarray([task.max_steps for task in tasks], jnp.int32),
        goal_radii=jnp.asarray([task.goal_radius for task in tasks], jnp.float32),
    )


def single_precision(point: NDArray[np.float64], resolution: float) -> NDArray[np.float32]:
    """A place to start from in single precision, in the cell that it has in double precision.

    Rounding can put a place on the border of a cell across it, into an obstacle; then it is the
    center of its cell.
    """
    rounded = np.asarray(point, np.float32)
    cell = np.floor(point / resolution)
    if (np.floor(rounded / np.float32(resolution)) == cell).all():
        return rounded
    return np.asarray((cell + 0.5) * resolution, np.float32)


def _shortest_paths(
    tasks: Sequence[Task], given: GivenTasks, maps: Sequence[OccupancyMap], robot_radius: float
) -> NDArray[np.float64]:
    """[n] m, where the suite does not say them computed."""
    lengths = np.array(
        [np.nan if task.shortest_path is None else task.shortest_path for task in tasks]
    )
    starts, goals = np.asarray(given.starts, np.float64), np.asarray(given.goals, np.float64)
    for number, occupancy_map in enumerate(maps):
        unknown = np.flatnonzero(np.isnan(lengths) & (np.asarray(given.maps) == number))
        if unknown.size:
            lengths[unknown] = shortest_path_lengths(
                occupancy_map, starts[unknown], goals[unknown], robot_radius=robot_radius
            )
    return lengths


def run_chunk(
    agent: Agent,
    chunk: SuiteChunk,
    settings: SuiteSettings,
    on_batch: OnBatch,
    fields: Sequence[str] = (),
) -> list[EpisodeResults]:
    """Run an agent on the tasks of a chunk; of policies alone `fields` of the trajectory, too.

    Returns:
        For each training seed the results of the tries of each task, task by task, [n * tries].
    """
    keys = _keys(jnp.asarray(chunk.numbers), settings)
    tasks = chunk.repeated(settings.tries)
    if isinstance(agent, TrainedAgent):
        return episodes.run_seeds(
            keys,
            agent.stacked_params(),
            chunk.joined,
            agent.network,
            epsilon=agent.epsilon,
            fields=fields,
            on_batch=on_batch,
            tasks=tasks,
            collision_ends=chunk.collision_ends,
        )
    assert isinstance(agent, BaselineAgent)
    results = []
    for first in range(0, len(keys), episodes.BATCH):
        batch = slice(first, min(first + episodes.BATCH, len(keys)))
        count = batch.stop - first
        chosen = first + np.arange(episodes.BATCH) % count  # The rest of a batch is padding.
        own = jax.tree.map(lambda x, i=chosen: x[i], tasks)
        if agent.name == "bug":
            navigator = baseline_episodes.bug(chunk.joined.config)
        else:
            navigator = baseline_episodes.planned(partial(_Oracles, chunk, jax.device_get(own)))
        of_batch = baseline_episodes.run_on_tasks(
            keys[chosen], navigator, chunk.joined, own, collision_ends=chunk.collision_ends
        )
        results.append(of_batch.of_episodes(slice(count)))
        on_batch(count)
    return [episodes.join_results(results)]


def _keys(numbers: jax.Array, settings: SuiteSettings) -> jax.Array:
    """Keys of the tries of tasks, [n * tries]; those of a task do not depend on the others."""

    def of_task(number: jax.Array) -> jax.Array:
        def of_seed(eval_seed: jax.Array) -> jax.Array:
            stream = jax.random.fold_in(jax.random.key(eval_seed), EPISODE_STREAM)
            return episodes.episode_keys(jax.random.fold_in(stream, number), settings.episodes)

        return jax.vmap(of_seed)(jnp.asarray(settings.all_eval_seeds)).reshape(-1)

    return jax.vmap(of_task)(numbers).reshape(-1)


class _Oracles:
    """The oracle on several maps: each plans on one. It knows the goal radius of a task."""

    def __init__(self, chunk: SuiteChunk, tasks: GivenTasks, goals: NDArray[np.float64]) -> None:
        """Prepare the paths to the goals [E, 2] m of tasks [E]."""
        self.length, self.step = chunk.joined.max_steps, 0
        groups: dict[tuple[float, int, int], list[int]] = {}
        for robot in range(len(goals)):
            limits = float(tasks.goal_radii[robot]), int(tasks.max_steps[robot])
            groups.setdefault((*limits, int(tasks.maps[robot])), []).append(robot)
        self.robots = [np.array(robots) for robots in groups.values()]
        limits_of_worlds = [
            (number, {"goal_radius": jnp.float32(radius), "max_steps": max_steps})
            for radius, max_steps, number in groups
        ]
        worlds = [
            dataclasses.replace(chunk.worlds[number], **limits)
            for number, limits in limits_of_worlds
        ]
        maps = [chunk.maps[number] for *_, number in groups]
        own_goals = [goals[robots] for robots in self.robots]
        with ThreadPoolExecutor(num_cores()) as threads:
            self.oracles = list(threads.map(Oracle, maps, worlds, own_goals))

    def choose(self, poses: NDArray[np.float64]) -> NDArray[np.int64]:
        """See `baseline_episodes.Planner`."""
        actions = np.full(len(poses), STAND)
        for robots, oracle in zip(self.robots, self.oracles, strict=True):
            if oracle.step < oracle.max_steps:
                actions[robots] = oracle.choose(poses[robots])
        self.step += 1
        return actions

    def outlook(self) -> NDArray[np.int8]:
        """See `baseline_episodes.Planner`."""
        num_robots = sum(len(robots) for robots in self.robots)
        actions = np.full((num_robots, self.length - self.step), STAND, np.int8)
        for robots, oracle in zip(self.robots, self.oracles, strict=True):
            planned = oracle.outlook()
            actions[robots, : planned.shape[1]] = planned
        return actions
