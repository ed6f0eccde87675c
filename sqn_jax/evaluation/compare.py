"""Agents side by side: the same starts, goals and noise for each, on any maps.

`evaluate_agents` runs policies and baselines on maps under noise and returns the contents of the
evaluation file. It prints nothing.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sqn_jax.baselines.shortest_paths import has_paths, require_paths
from sqn_jax.config.map_names import MapFile, parse
from sqn_jax.evaluation import scores
from sqn_jax.evaluation.agents import (
    Agent,
    BaselineAgent,
    EpisodeBatch,
    OnBatch,
    TrainedAgent,
    bumper_of,
    require_robot,
)
from sqn_jax.evaluation.cached_paths import path_lengths
from sqn_jax.evaluation.episodes import EpisodeResults
from sqn_jax.evaluation.settings import (
    Maps,
    Settings,
    World,
    as_the_oracle_knows_it,
    robot_for,
    worlds,
)
from sqn_jax.maps import OccupancyMap, load_map, step_warning
from sqn_jax.training import memory_budget

EPISODES_AT_ONCE = 2_000
"""Episodes of each policy whose results are held at once, unless one evaluation seed has more."""

Floats = NDArray[np.floating]

OnEvaluated = Callable[[EpisodeBatch], object]
"""Called with the episodes of a training seed in a world under an evaluation seed."""


def num_episodes(agents: Sequence[Agent], settings: Settings) -> int:
    """Episodes that `evaluate_agents` will run."""
    num_worlds = len(settings.maps) * len(settings.tasks) * len(settings.noise)
    num_policies = sum(len(agent.training_seeds) for agent in agents)
    return num_worlds * num_policies * settings.eval_seeds * settings.episodes


RECORD_BYTES = 1_000
"""What the record of an episode takes until it is written."""


def memory_bytes(
    agents: Sequence[Agent], maps: Maps, settings: Settings, fields: Sequence[str] = ()
) -> float:
    """About what `evaluate_agents` takes at most, with steps that are given on as `fields`.

    A batch of an evaluation seed is there twice while its parts are joined; with `fields` those of
    all worlds are assumed to stay.
    """
    steps = settings.max_steps or max(world.max_steps for world in maps.values())
    numbers = 3 + 7 * ("info" in fields)  # Of a step, with the pose.
    if "output" in fields:
        numbers += 5 + 6 * max(_num_skills(agent) for agent in agents)
    batches = 2 + (len(settings.tasks) * len(maps) * settings.eval_seeds if fields else 0)
    records = num_episodes(agents, settings) * len(settings.goal_radii)
    loaded = min(settings.episodes * settings.eval_seeds, max(EPISODES_AT_ONCE, settings.episodes))
    joined = 2 * loaded + (batches - 2) * settings.episodes
    return RECORD_BYTES * records + 4.0 * numbers * steps * joined


def _num_skills(agent: Agent) -> int:
    return agent.network.config.num_skills if isinstance(agent, TrainedAgent) else 1


def load_maps(agents: Sequence[Agent], settings: Settings) -> Maps:
    """Load the maps of an evaluation, for the robot of every agent.

    Files of one name are told apart by their folders: the maps are called `hall/map`, `yard/map`.

    Raises:
        ValueError: a map is unusable for a robot, or a robot for an agent.

    Warns:
        UserWarning: see `load_map`; or an episode is too short for the paths of a map file.
    """
    for agent in agents:
        require_robot(agent, robot_for(agent.env_config, settings))
    robots = {
        robot.robot_radius: robot
        for robot in (robot_for(agent.env_config, settings) for agent in agents)
    }
    maps = {}
    for name, (radius, robot) in product(settings.maps, robots.items()):
        loaded = load_map(name, robot_radius=radius)
        if loaded.tiles != (1, 1):
            raise ValueError(f"map {name}: several, expected one for an evaluation")
        if any(agent.algorithm == "oracle" for agent in agents):
            require_paths(loaded, "for the oracle to plan on (--no-baselines leaves it out)")
        maps[name, radius] = loaded
        if settings.max_steps == 0 and isinstance(parse(name).names[0], MapFile):
            step_length = robot.forward_speed * robot.time_step
            line = step_warning(loaded, radius, step_length, settings.goal_radii[0])
            if line is not None:
                warnings.warn(line, stacklevel=2)
    names = _distinct_names({name: loaded.name for (name, _), loaded in maps.items()})
    return {key: dataclasses.replace(loaded, name=names[key[0]]) for key, loaded in maps.items()}


def _distinct_names(names: Mapping[str, str]) -> dict[str, str]:
    """By setting, names that differ: to those of files that do not, folders are added.

    Raises:
        ValueError: one file twice, by different paths.
    """
    distinct = {}
    for setting, name in names.items():
        twins = [other for other in names if names[other] == name]
        if len(twins) > 1 and isinstance(parse(setting).names[0], MapFile):
            paths = [parse(other).names[0] for other in twins]
            parts = [
                Path(path.path).resolve().parts if isinstance(path, MapFile) else (str(path),)
                for path in paths
            ]
            own = parts[twins.index(setting)]
            if parts.count(own) > 1:
                raise ValueError(
                    f"maps {' and '.join(twins)}: one file twice, the results could not be told "
                    "apart"
                )
            stems = [(*part[:-1], Path(part[-1]).stem) for part in parts]
            if stems.count((*own[:-1], Path(own[-1]).stem)) == 1:
                parts, own = stems, (*own[:-1], Path(own[-1]).stem)
            length = next(
                count
                for count in range(2, len(own) + 1)
                if sum(part[-count:] == own[-count:] for part in parts) == 1
            )
            name = "/".join(own[-length:])
        distinct[setting] = name
    return distinct


def evaluate_agents(
    agents: Sequence[Agent],
    maps: Maps,
    settings: Settings,
    on_batch: OnBatch = lambda count: None,
    on_evaluated: OnEvaluated | None = None,
    fields: Sequence[str] = (),
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Run every agent in every world.

    Args:
        agents: the agents; their names must differ.
        maps: from `load_maps`.
        settings: maps, tasks, noise, seeds and goal radii.
        on_batch: called with the number of episodes that have just been run.
        on_evaluated: called with the episodes of each training seed in each world under each
            evaluation seed.
        fields: the fields of `Trajectory` that `on_evaluated` gets, beside poses and goals.

    Returns:
        The contents of the evaluation file (`schema`, `std_ddof`, `results`, `comparisons`), and a
        record of each episode. `std_ddof` is 1: sample standard deviations (`scores.describe`). In
        files without it they are those of the population.
    """
    results: list[dict[str, Any]] = []
    records: list[dict[str, Any]] = []
    quiet: dict[str, list[list[EpisodeBatch]]] = {agent.name: [] for agent in agents}
    robots = {agent.name: robot_for(agent.env_config, settings) for agent in agents}
    main_radius = settings.goal_radii[0]
    # Whole trajectories come to the host only where somebody looks at them.
    needed = () if on_evaluated is None else tuple(dict.fromkeys(("poses", "goals", *fields)))
    oracles: dict[Any, list[EpisodeBatch]] = {}
    for robot in dict.fromkeys(robots.values()):
        paths: dict[bytes, NDArray[np.float64] | None] = {}
        for world in worlds(robot, maps, settings):
            memory_budget.bound_programs()
            actors = [agent for agent in agents if robots[agent.name] == robot]
            evaluated: dict[str, list[EpisodeBatch]] = {agent.name: [] for agent in actors}
            # First of all the oracle begins to plan: the others run meanwhile.
            running = {
                agent.name: _results(agent, world, settings, needed, on_batch) for agent in actors
            }
            for agent in actors:
                for batch in _batches(agent, world, settings, paths, running[agent.name]):
                    if on_evaluated is not None:
                        on_evaluated(batch)
                    # The steps of many episodes would fill the memory; statistics need none.
                    without_steps = dataclasses.replace(batch, trajectory=batch.trajectory.only())
                    evaluated[agent.name].append(without_steps)
            same_tasks = (
                *(as_the_oracle_knows_it(robot), world.occupancy_map.name),
                *(world.tasks, world.noise),
            )
            if "oracle" in evaluated:
                oracles[same_tasks] = evaluated["oracle"]
            for agent in actors:
                for radius in settings.goal_radii:
                    labels = _labels(agent, world, radius)
                    batches = evaluated[agent.name]
                    described = scores.describe(batches, radius, oracles.get(same_tasks))
                    results.append({**labels, **_seeds(agent, settings), **described})
                    records += scores.records(batches, radius, **labels)
                if world.noise == (0.0, 0.0):
                    quiet[agent.name].append(evaluated[agent.name])
    comparisons = [
        {"first": first, "second": second, **improvement}
        for first in quiet
        for second in quiet
        if first != second
        and (improvement := scores.improvement(quiet[first], quiet[second], main_radius))
    ]
    return {"schema": 1, "std_ddof": 1, "results": results, "comparisons": comparisons}, records


def _blocks(settings: Settings) -> list[list[int]]:
    """The evaluation seeds, as many together as are run at once."""
    eval_seeds = settings.all_eval_seeds
    at_once = max(1, EPISODES_AT_ONCE // settings.episodes)
    return [eval_seeds[first : first + at_once] for first in range(0, len(eval_seeds), at_once)]


def _results(
    agent: Agent, world: World, settings: Settings, fields: Sequence[str], on_batch: OnBatch
) -> Iterator[tuple[list[int], list[list[EpisodeResults]]]]:
    """The results of an agent, as many evaluation seeds at once; a baseline is at work at once."""
    blocks = _blocks(settings)
    first: Agent = agent
    if isinstance(agent, BaselineAgent):
        first = agent.at_work(blocks[0], world, settings)
    runners = [first, *[agent] * (len(blocks) - 1)]
    return (
        (block, runner.run(block, world, settings, fields, on_batch))
        for block, runner in zip(blocks, runners, strict=True)
    )


def _batches(
    agent: Agent,
    world: World,
    settings: Settings,
    paths: dict[bytes, NDArray[np.float64] | None],
    of_blocks: Iterable[tuple[list[int], list[list[EpisodeResults]]]],
) -> Iterator[EpisodeBatch]:
    """The episodes of all training seeds under all evaluation seeds.

    `paths` caches the lengths of the shortest paths, m, by task; None where they are not searched.
    """
    for block, results in of_blocks:
        of_seeds = list(zip(product(block, agent.training_seeds), chain(*results), strict=True))
        _search_paths(paths, world, [(starts, goals) for _, (_, starts, goals, _) in of_seeds])
        for (eval_seed, training_seed), (metrics, starts, goals, trajectory) in of_seeds:
            yield EpisodeBatch(
                agent=agent,
                world=world,
                training_seed=training_seed,
                eval_seed=eval_seed,
                metrics=dict(zip(settings.goal_radii, metrics, strict=True)),
                starts=starts,
                goals=goals,
                shortest_paths=paths[_task_name(world, starts, goals)],
                trajectory=trajectory,
            )


def _task_name(world: World, starts: Floats, goals: Floats) -> bytes:
    return world.occupancy_map.name.encode() + starts.tobytes() + goals.tobytes()


def _search_paths(
    paths: dict[bytes, NDArray[np.float64] | None],
    world: World,
    tasks: Sequence[tuple[Floats, Floats]],
) -> None:
    """Add the shortest paths of tasks that are not there yet, all goals of a map at once."""
    new = {_task_name(world, *task): task for task in tasks}
    new = {name: task for name, task in new.items() if name not in paths}
    if not new:
        return
    starts, goals = (np.concatenate(each) for each in zip(*new.values(), strict=True))
    robot_radius = world.env_params.config.robot_radius
    lengths = _shortest_paths(world.occupancy_map, starts, goals, robot_radius)
    ends = np.cumsum([len(own_goals) for _, own_goals in new.values()])
    split = [None] * len(new) if lengths is None else np.split(lengths, ends[:-1])
    paths.update(zip(new, split, strict=True))


def _shortest_paths(
    occupancy_map: OccupancyMap, starts: Floats, goals: Floats, robot_radius: float
) -> NDArray[np.float64] | None:
    """[E] m; None on a map that is too large to search paths on."""
    if not has_paths(occupancy_map):
        return None
    return path_lengths(occupancy_map, starts, goals, robot_radius=robot_radius)


def _labels(agent: Agent, world: World, radius: float) -> dict[str, Any]:
    config = world.env_params.config
    return {
        "agent": agent.name,
        "algorithm": agent.algorithm,
        "map": world.occupancy_map.name,
        "tasks": world.tasks,
        "velocity_noise": world.noise[0],
        "velocity_noise_unit": config.velocity_noise_unit,
        "range_noise": world.noise[1],
        "range_noise_unit": config.range_noise_unit,
        "goal_radius": radius,
        "epsilon": agent.epsilon,
        **(
            {}
            if config.robot_radius == agent.env_config.robot_radius
            else {"robot_radius": config.robot_radius}
        ),
        **bumper_of(agent),
    }


def _seeds(agent: Agent, settings: Settings) -> dict[str, Any]:
    return {
        "training_seeds": list(agent.training_seeds),
        "eval_seeds": settings.all_eval_seeds,
        "episodes": settings.episodes,
    }
