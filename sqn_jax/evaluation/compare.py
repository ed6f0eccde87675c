"""Agents side by side: the same starts, goals and noise for each, on any maps.

`evaluate_agents` drives learnt policies and reference navigators over maps and noise levels and
returns what the evaluation file holds. What is said on screen is up to the caller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sqn_jax.baselines.shortest_paths import shortest_ways
from sqn_jax.config import EnvConfig, TrainConfig
from sqn_jax.env import EnvParams, make_env
from sqn_jax.env.prepare import with_noise
from sqn_jax.evaluation import baseline_episodes, episodes, scores
from sqn_jax.evaluation.scores import Outcome
from sqn_jax.maps import OccupancyMap, load_map
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.rollout import EpisodeSummary, Trace, summarize

Tasks = Literal["evaluation points", "random pairs"]
SPAWN_MODES: dict[Tasks, Literal["evaluation", "training"]] = {
    "evaluation points": "evaluation",
    "random pairs": "training",
}
"""The two kinds of tasks, and the spawn mode that draws them."""

MOST_EPISODES, MOST_STEPS = 100_000, 100_000
"""Under one evaluation seed, and an episode: more would not fit into memory."""

Driven = tuple[list[EpisodeSummary], Trace]
"""A summary for each goal radius, and the trace."""
Maps = Mapping[tuple[str, float], OccupancyMap]
"""Maps by their name in the settings and the radius of the robot, m, they were loaded for."""
OnBatch = Callable[[int], object]
OnDriven = Callable[["Agent", "World", int, Driven], object]


@dataclass(frozen=True)
class Settings:
    """What an evaluation is made of."""

    maps: tuple[str, ...]
    """Maps of the project by name, or files."""
    tasks: tuple[Tasks, ...] = ("evaluation points",)
    episodes: int = 100
    """Episodes under each evaluation seed."""
    eval_seeds: int = 5
    """How many evaluation seeds."""
    seed: int = 1_000
    """The first of them."""
    noise: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    """Pairs of velocity noise and range noise."""
    noise_unit: Literal["relative", "absolute"] | None = None
    """Reading of both, see `EnvConfig`; None as each robot was configured."""
    goal_radii: tuple[float, ...] = (0.3, 0.5)
    """m; each radius is judged from the same episodes."""
    max_steps: int = 0
    """Steps an episode; 0 for each map's own limit."""

    def __post_init__(self) -> None:
        for name, limit in (("episodes", MOST_EPISODES), ("eval_seeds", 10_000)):
            if not 1 <= getattr(self, name) <= limit:
                raise ValueError(
                    f"{name} is {getattr(self, name)}, expected at least 1 and at most {limit:,}"
                )
        if not 0 <= self.max_steps <= MOST_STEPS:
            raise ValueError(f"max_steps is {self.max_steps}, expected 0 to {MOST_STEPS:,}")
        if not 0 <= self.seed <= 2**31 - self.eval_seeds:
            raise ValueError(
                f"seed is {self.seed}, expected 0 to {2**31 - self.eval_seeds} for "
                f"{self.eval_seeds} evaluation seeds"
            )
        for level in (level for pair in self.noise for level in pair):
            if not 0 <= level <= 1e6:
                raise ValueError(f"noise is {level}, expected 0 to 1000000")
        for radius in self.goal_radii:
            if not 1e-6 <= radius <= 1e6:
                raise ValueError(f"goal radius is {radius}, expected 0.000001 to 1000000 m")
        for name in ("maps", "tasks", "noise", "goal_radii"):
            given = getattr(self, name)
            for one in given:
                if given.count(one) > 1:
                    raise ValueError(f"{name}: {one} comes twice, expected each once")
        if not (self.maps and self.tasks and self.noise and self.goal_radii):
            raise ValueError("nothing to evaluate: expected a map, a task and a goal radius")


class Agent(Protocol):
    """Whoever drives."""

    @property
    def name(self) -> str: ...
    @property
    def algorithm(self) -> str: ...
    @property
    def env_config(self) -> EnvConfig:
        """The robot and its sensors."""

    @property
    def training_seeds(self) -> Sequence[int | None]:
        """One None for an agent that was not trained."""

    def drive(
        self, index: int, world: World, eval_seed: int, settings: Settings, on_batch: OnBatch
    ) -> Driven:
        """Episodes of the training seed with this index: a summary for each goal radius."""


@dataclass(frozen=True)
class World:
    """A map made ready for a robot, some tasks and some noise."""

    occupancy_map: OccupancyMap
    env_params: EnvParams
    tasks: Tasks
    noise: tuple[float, float]


@dataclass(frozen=True)
class Learnt:
    """Policies of one agent: runs that differ in nothing but their seeds."""

    name: str
    policies: tuple[Policy, ...]

    @property
    def algorithm(self) -> str:
        return self.policies[0].config.algo

    @property
    def env_config(self) -> EnvConfig:
        return self.policies[0].config.env

    @property
    def training_seeds(self) -> Sequence[int | None]:
        return [seed for policy in self.policies for seed in policy.training_seeds]

    def drive(
        self, index: int, world: World, eval_seed: int, settings: Settings, on_batch: OnBatch
    ) -> Driven:
        params = [params for policy in self.policies for params in policy.params]
        config = self.policies[0].config
        return episodes.run_episodes(
            episodes.episode_keys(task_key(eval_seed, world.tasks), settings.episodes),
            params[index],
            world.env_params,
            algo=config.algo,
            network_config=config.network,
            goal_radii=settings.goal_radii,
            on_batch=on_batch,
        )


@dataclass(frozen=True)
class Reference:
    """A navigator that was not trained: `oracle` knows the map, `bug` sees what the agents see."""

    name: Literal["oracle", "bug"]
    env_config: EnvConfig
    training_seeds: Sequence[int | None] = (None,)

    @property
    def algorithm(self) -> str:
        return self.name

    def drive(
        self, index: int, world: World, eval_seed: int, settings: Settings, on_batch: OnBatch
    ) -> Driven:
        del index
        key, count, env_params = (
            task_key(eval_seed, world.tasks),
            settings.episodes,
            world.env_params,
        )
        if self.name == "oracle":
            _, trace = baseline_episodes.run_oracle(key, world.occupancy_map, env_params, count)
        else:
            _, trace = baseline_episodes.run_bug(key, env_params, count)
        on_batch(count)
        radii = [jnp.float32(radius) for radius in settings.goal_radii]
        return [jax.device_get(summarize(trace, radius)) for radius in radii], trace


def group_policies(policies: Sequence[Policy]) -> list[Learnt]:
    """Pool the runs that differ in nothing but their seeds; each pool is one agent.

    Raises:
        ValueError: a training seed comes twice in a pool.
    """
    pools: dict[TrainConfig, list[Policy]] = {}
    for policy in policies:
        same = dataclasses.replace(
            policy.config,
            seed=0,
            num_seeds=1,
            checkpoint_minutes=1.0,
            checkpoint_replay=True,
            max_skipped_updates=0,
        )
        pools.setdefault(same, []).append(policy)
    algorithms = [config.algo for config in pools]
    agents = []
    for config, pool in pools.items():
        alone = algorithms.count(config.algo) == 1
        agent = Learnt(config.algo if alone else f"{config.algo} {pool[0].name}", tuple(pool))
        seeds = list(agent.training_seeds)
        if len(set(seeds)) < len(seeds):
            folders = ", ".join(policy.name for policy in pool)
            raise ValueError(f"runs {folders}: the same settings and the same training seed twice")
        agents.append(agent)
    return agents


def with_references(agents: Sequence[Agent], *, references: bool) -> list[Agent]:
    """The agents, and after them the navigators that were not trained, with the first's robot."""
    if not references:
        return list(agents)
    robot = agents[0].env_config if agents else EnvConfig()
    return [*agents, Reference("bug", robot), Reference("oracle", robot)]


def num_episodes(agents: Sequence[Agent], settings: Settings) -> int:
    """Episodes that `evaluate_agents` will drive."""
    worlds = len(settings.maps) * len(settings.tasks) * len(settings.noise)
    policies = sum(len(agent.training_seeds) for agent in agents)
    return worlds * policies * settings.eval_seeds * settings.episodes


def load_maps(agents: Sequence[Agent], settings: Settings) -> Maps:
    """The maps of an evaluation, for every robot that is to drive on them.

    Raises:
        ValueError: a map is unusable for a robot.
    """
    radii = dict.fromkeys(agent.env_config.robot_radius for agent in agents)
    maps = {
        (name, radius): load_map(name, robot_radius=radius)
        for name in settings.maps
        for radius in radii
    }
    called: dict[str, str] = {}
    for (name, _), occupancy_map in maps.items():
        if occupancy_map.tiles != (1, 1):
            raise ValueError(f"map {name}: several, expected one for an evaluation")
        if called.setdefault(occupancy_map.name, name) != name:
            raise ValueError(
                f"maps {called[occupancy_map.name]} and {name}: both are called "
                f"{occupancy_map.name!r}, the results could not be told apart"
            )
    return maps


def evaluate_agents(
    agents: Sequence[Agent],
    maps: Maps,
    settings: Settings,
    on_batch: OnBatch = lambda count: None,
    on_driven: OnDriven = lambda agent, world, index, driven: None,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Drive every agent in every world.

    Args:
        agents: who drives; names must differ.
        maps: from `load_maps`.
        settings: where, how often and under what noise.
        on_batch: called with the number of episodes just driven.
        on_driven: called with agent, world, index of the training seed and what was driven, for
            those who want the traces.

    Returns:
        The evaluation file (`schema`, `results`, `comparisons`), and one record an episode.
    """
    results: list[dict[str, Any]] = []
    records: list[dict[str, Any]] = []
    quiet: dict[str, list[list[Outcome]]] = {agent.name: [] for agent in agents}
    robots = {agent.name: robot_for(agent.env_config, settings) for agent in agents}
    for robot in dict.fromkeys(robots.values()):
        ways: dict[bytes, NDArray[np.float64]] = {}
        for world in worlds(robot, maps, settings):
            drivers = [agent for agent in agents if robots[agent.name] == robot]
            driven = {
                agent.name: _outcomes(agent, world, settings, ways, on_batch, on_driven)
                for agent in drivers
            }
            for agent in drivers:
                outcomes = driven[agent.name]
                for radius, of_radius in outcomes.items():
                    labels = _labels(agent, world, radius)
                    oracle = driven["oracle"][radius] if "oracle" in driven else None
                    told = scores.describe(of_radius, oracle)
                    results.append({**labels, **_drivers(agent, settings), **told})
                    records += scores.records(of_radius, **labels)
                if world.noise == (0.0, 0.0):
                    quiet[agent.name].append(outcomes[settings.goal_radii[0]])
    comparisons = [
        {"first": first, "second": second, **told}
        for first in quiet
        for second in quiet
        if first != second and (told := scores.improvement(quiet[first], quiet[second]))
    ]
    return {"schema": scores.SCHEMA, "results": results, "comparisons": comparisons}, records


def robot_for(env_config: EnvConfig, settings: Settings) -> EnvConfig:
    """The robot and its sensors, without what belongs to training or comes from the settings."""
    return dataclasses.replace(
        env_config,
        max_steps=settings.max_steps,
        near_goal_fraction=0.0,
        velocity_noise=0.0,
        velocity_noise_unit=settings.noise_unit or env_config.velocity_noise_unit,
        range_noise=0.0,
        range_noise_unit=settings.noise_unit or env_config.range_noise_unit,
    )


def worlds(robot: EnvConfig, maps: Maps, settings: Settings) -> Iterator[World]:
    """Every map, task and noise of an evaluation for a robot from `robot_for`."""
    for name in settings.maps:
        occupancy_map = maps[name, robot.robot_radius]
        for tasks in settings.tasks:
            quiet = make_env(occupancy_map, robot, spawn=SPAWN_MODES[tasks])
            for noise in settings.noise:
                yield World(occupancy_map, with_noise(quiet, *noise), tasks, noise)


def _outcomes(
    agent: Agent,
    world: World,
    settings: Settings,
    ways: dict[bytes, NDArray[np.float64]],
    on_batch: OnBatch,
    on_driven: OnDriven,
) -> dict[float, list[Outcome]]:
    """For each goal radius, the outcomes of all training seeds under all evaluation seeds."""
    outcomes: dict[float, list[Outcome]] = {radius: [] for radius in settings.goal_radii}
    for eval_seed in _eval_seeds(settings):
        for index, training_seed in enumerate(agent.training_seeds):
            summaries, trace = agent.drive(index, world, eval_seed, settings, on_batch)
            on_driven(agent, world, index, (summaries, trace))
            starts, goals = np.asarray(trace.poses[0]), np.asarray(trace.goals)
            tasks = world.occupancy_map.name.encode() + starts.tobytes() + goals.tobytes()
            if tasks not in ways:
                ways[tasks] = _ways(world, starts, goals)
            for radius, summary in zip(settings.goal_radii, summaries, strict=True):
                outcomes[radius].append(
                    Outcome(training_seed, eval_seed, summary, starts, goals, ways[tasks])
                )
    return outcomes


def _ways(
    world: World, starts: NDArray[np.floating], goals: NDArray[np.floating]
) -> NDArray[np.float64]:
    robot_radius = world.env_params.config.robot_radius
    return shortest_ways(world.occupancy_map, starts, goals, robot_radius=robot_radius)


def task_key(eval_seed: int, tasks: Tasks) -> jax.Array:
    """The key of the episodes of an evaluation seed; every agent gets the same."""
    return jax.random.fold_in(jax.random.key(eval_seed), list(SPAWN_MODES).index(tasks))


def _eval_seeds(settings: Settings) -> list[int]:
    return [settings.seed + index for index in range(settings.eval_seeds)]


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
    }


def _drivers(agent: Agent, settings: Settings) -> dict[str, Any]:
    return {
        "training_seeds": list(agent.training_seeds),
        "eval_seeds": _eval_seeds(settings),
        "episodes": settings.episodes,
    }
