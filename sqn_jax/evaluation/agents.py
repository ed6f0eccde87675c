"""The agents of an evaluation, trained policies and baselines, and batches of their episodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sqn_jax.agent.networks import Params, QNetwork
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.baselines.bug import Bug
from sqn_jax.baselines.oracle import require_mobile
from sqn_jax.config import EnvConfig, TrainConfig
from sqn_jax.config.validation import require_limits
from sqn_jax.evaluation import baseline_episodes, episodes
from sqn_jax.evaluation.episodes import EpisodeResults
from sqn_jax.evaluation.settings import Settings, World, task_key
from sqn_jax.evaluation.statistics import success_weighted_path_length
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.rollout import EpisodeMetrics
from sqn_jax.training.state import network_of

OnBatch = Callable[[int], object]
"""Called with the number of episodes that have just been run."""


class Agent(Protocol):
    """Anything that can be evaluated: it chooses the actions of a robot."""

    @property
    def name(self) -> str: ...
    @property
    def algorithm(self) -> str: ...
    @property
    def env_config(self) -> EnvConfig:
        """The robot and its sensors."""

    @property
    def training_seeds(self) -> Sequence[int | None]:
        """Seeds of the training runs; a single None for an agent that was not trained."""

    @property
    def epsilon(self) -> float:
        """Probability of a random action in each step."""

    def run(
        self,
        eval_seeds: Sequence[int],
        world: World,
        settings: Settings,
        fields: Sequence[str],
        on_batch: OnBatch,
    ) -> list[list[EpisodeResults]]:
        """Run the episodes of evaluation seeds with the policies of all training seeds.

        Args:
            eval_seeds: determine tasks and noise.
            world: the world to run in.
            settings: the number of episodes E and the goal radii.
            fields: the fields of `Trajectory` to return.
            on_batch: called after each batch of episodes.

        Returns:
            For each evaluation seed and each training seed the results of E episodes.
        """


def require_robot(agent: Agent, robot: EnvConfig) -> None:
    """Refuse a robot that an agent cannot control, before anything is run.

    Args:
        agent: a trained policy or a baseline.
        robot: the robot of an evaluation: the agent's own with what a suite or the settings fix.

    Raises:
        ValueError: one line: a policy was trained with another number of beams, or the robot of a
            baseline cannot move.
    """
    num_beams = agent.env_config.num_beams
    if isinstance(agent, TrainedAgent) and robot.num_beams != num_beams:
        raise ValueError(
            f"robot.num_beams is {robot.num_beams}, expected {num_beams}, with which "
            f"{agent.name} was trained"
        )
    if agent.algorithm == "oracle":
        require_mobile(robot)
    if agent.algorithm == "bug":
        Bug(robot)


@dataclass(frozen=True)
class TrainedAgent:
    """Policies of one agent: runs that differ only in their seeds."""

    name: str
    policies: tuple[Policy, ...]
    epsilon: float = 0.0
    """Probability of a random action in each step; 0 is greedy."""

    @property
    def algorithm(self) -> str:
        return self.policies[0].config.algo

    @property
    def env_config(self) -> EnvConfig:
        return self.policies[0].config.env

    @property
    def network(self) -> QNetwork:
        return network_of(self.policies[0].config)

    @property
    def training_seeds(self) -> Sequence[int | None]:
        return [seed for policy in self.policies for seed in policy.training_seeds]

    def params(self, training_seed: int | None) -> Params:
        """The trained parameters of this seed."""
        params_of_seeds = [params for policy in self.policies for params in policy.params]
        return params_of_seeds[self.training_seeds.index(training_seed)]

    def stacked_params(self) -> Params:
        """The parameters of all training seeds, with a leading axis [S]."""
        params_of_seeds = [params for policy in self.policies for params in policy.params]
        # By NumPy: for each shape of a parameter JAX would compile a program.
        return jax.tree.map(lambda *x: np.stack(x), *params_of_seeds)

    def run(
        self,
        eval_seeds: Sequence[int],
        world: World,
        settings: Settings,
        fields: Sequence[str],
        on_batch: OnBatch,
    ) -> list[list[EpisodeResults]]:
        of_policies = episodes.run_seeds(
            _keys(eval_seeds, world, settings),
            self.stacked_params(),
            world.env_params,
            self.network,
            epsilon=self.epsilon,
            goal_radii=settings.goal_radii,
            fields=fields,
            on_batch=on_batch,
        )
        return [
            [results.of_episodes(own) for results in of_policies]
            for own in _of_seeds(eval_seeds, settings)
        ]


@dataclass(frozen=True)
class BaselineAgent:
    """An agent that was not trained: `oracle` knows the map, `bug` sees what agents see."""

    name: Literal["oracle", "bug"]
    env_config: EnvConfig
    training_seeds: Sequence[int | None] = (None,)
    epsilon: float = 0.0
    navigator: baseline_episodes.Navigator | None = None
    """That of `at_work`, for some episodes of a world."""

    def at_work(self, eval_seeds: Sequence[int], world: World, settings: Settings) -> BaselineAgent:
        """The same agent; the oracle already plans what `run` with these arguments will need."""
        if self.name != "oracle":
            return self
        navigator = baseline_episodes.oracle_ahead(
            _keys(eval_seeds, world, settings), world.occupancy_map, world.env_params
        )
        return dataclasses.replace(self, navigator=navigator)

    @property
    def algorithm(self) -> str:
        return self.name

    def run(
        self,
        eval_seeds: Sequence[int],
        world: World,
        settings: Settings,
        fields: Sequence[str],
        on_batch: OnBatch,
    ) -> list[list[EpisodeResults]]:
        if self.navigator is not None:
            navigator = self.navigator
        elif self.name == "oracle":
            navigator = baseline_episodes.oracle(world.occupancy_map, world.env_params)
        else:
            navigator = baseline_episodes.bug(world.env_params.config)
        metrics, trajectory = baseline_episodes.run_baseline(
            _keys(eval_seeds, world, settings),
            navigator,
            world.env_params,
            goal_radii=settings.goal_radii,
            fields=tuple(dict.fromkeys(("poses", "goals", *fields))),
            on_batch=on_batch,
        )
        # A copy, or the starts would keep all poses in memory.
        starts = np.array(trajectory.poses[0])
        results = EpisodeResults(metrics, starts, trajectory.goals, trajectory.only(*fields))
        return [[results.of_episodes(own)] for own in _of_seeds(eval_seeds, settings)]


def _keys(eval_seeds: Sequence[int], world: World, settings: Settings) -> jax.Array:
    """The keys of the episodes of all evaluation seeds, one seed after the other."""
    of_seeds = [task_key(seed, world.tasks) for seed in eval_seeds]
    return jnp.concatenate([episodes.episode_keys(key, settings.episodes) for key in of_seeds])


def _of_seeds(eval_seeds: Sequence[int], settings: Settings) -> list[slice]:
    """Where among these episodes those of each evaluation seed are."""
    firsts = [index * settings.episodes for index in range(len(eval_seeds))]
    return [slice(first, first + settings.episodes) for first in firsts]


@dataclass(frozen=True, eq=False)
class EpisodeBatch:
    """The E episodes of one training seed in one world under one evaluation seed."""

    agent: Agent
    world: World
    training_seed: int | None
    """None for a baseline, which was not trained."""
    eval_seed: int
    metrics: Mapping[float, EpisodeMetrics]
    """By goal radius, m, in the order of the settings; NumPy arrays [E]."""
    starts: NDArray[np.floating]
    """[E, 3] x m, y m, heading rad."""
    goals: NDArray[np.floating]
    """[E, 2] x m, y m."""
    shortest_paths: NDArray[np.floating] | None = None
    """[E] m, from start to goal; None where they were not computed."""
    trajectory: Trajectory = field(default_factory=Trajectory)
    """The requested fields of all steps, NumPy arrays; empty in the results of an evaluation."""

    @property
    def main_metrics(self) -> EpisodeMetrics:
        """The metrics for the first goal radius."""
        return next(iter(self.metrics.values()))

    @property
    def routes(self) -> NDArray[np.int64]:
        """[E] numbers that are equal for tasks from and to the same two points of the map."""
        occupancy_map = self.world.occupancy_map
        is_evaluation = self.world.tasks == "evaluation points"
        points = occupancy_map.evaluation_points if is_evaluation else occupancy_map.spawn_points
        nearest = [
            np.linalg.norm(places[:, None, :2] - points, axis=-1).argmin(axis=1)
            for places in (self.starts, self.goals)
        ]
        return np.asarray(nearest[0] * len(points) + nearest[1], np.int64)

    def numbers(self, goal_radius: float) -> dict[str, NDArray[np.float64]]:
        """The numbers of each episode, [E] each, by the names that they have in the files."""
        metrics = self.metrics[goal_radius]
        named: dict[str, ArrayLike] = {
            "success": metrics.success,
            "time_steps": metrics.time_steps,
            "mean_reward": metrics.mean_reward,
            "collisions": metrics.collisions,
            "coverage_m2": metrics.covered_area,
            "path_length_m": metrics.path_length,
        }
        if self.shortest_paths is not None:
            named["spl"] = success_weighted_path_length(
                metrics.success, metrics.path_length, self.shortest_paths
            )
        return {name: np.asarray(values, np.float64) for name, values in named.items()}


def group_policies(policies: Sequence[Policy]) -> list[TrainedAgent]:
    """Pool the runs that differ only in their seeds; each pool is one agent.

    Raises:
        ValueError: a training seed occurs twice in a pool.
    """
    pools: dict[TrainConfig, list[Policy]] = {}
    for policy in policies:
        without_seed = dataclasses.replace(
            policy.config,
            seed=0,
            num_seeds=1,
            checkpoint_minutes=1.0,
            checkpoint_replay=True,
            max_skipped_updates=0,
            eval=dataclasses.replace(policy.config.eval, curve_points=0, curve_episodes=1),
        )
        pools.setdefault(without_seed, []).append(policy)
    algorithms = [config.algo for config in pools]
    agents = []
    for config, pool in pools.items():
        is_only_one = algorithms.count(config.algo) == 1
        name = config.algo if is_only_one else f"{config.algo} {pool[0].name}"
        agent = TrainedAgent(name, tuple(pool))
        seeds = list(agent.training_seeds)
        if len(set(seeds)) < len(seeds):
            folders = ", ".join(policy.name for policy in pool)
            raise ValueError(f"runs {folders}: the same settings and the same training seed twice")
        agents.append(agent)
    return agents


def with_epsilons(agents: Sequence[TrainedAgent], epsilons: Sequence[float]) -> list[TrainedAgent]:
    """Each agent once for each probability of a random action.

    The names say it, if it is more than 0, and the same for the bumper.

    Raises:
        ValueError: a probability is not in 0..1, or comes twice.
    """
    for epsilon in epsilons:
        require_limits(epsilon, "epsilon", 0, 1)
        if epsilons.count(epsilon) > 1:
            raise ValueError(f"epsilon: {epsilon} comes twice, expected each once")

    def named(agent: TrainedAgent, epsilon: float) -> TrainedAgent:
        said = {"epsilon": epsilon, "bumper": agent.env_config.bumper}
        name = ", ".join([agent.name, *(f"{key} {said[key]:g}" for key in said if said[key] > 0)])
        return dataclasses.replace(agent, name=name, epsilon=epsilon)

    return [named(agent, epsilon) for agent in agents for epsilon in epsilons]


def bumper_of(agent: Agent) -> dict[str, float]:
    """What a result says of the agent's bumper: nothing without one, as baselines are."""
    bumper = agent.env_config.bumper if isinstance(agent, TrainedAgent) else 0.0
    return {"bumper": bumper} if bumper > 0 else {}


def with_baselines(agents: Sequence[Agent], *, baselines: bool) -> list[Agent]:
    """The agents, followed by the baselines, which get the robot of the first agent."""
    if not baselines:
        return list(agents)
    robot = agents[0].env_config if agents else EnvConfig()
    return [*agents, BaselineAgent("bug", robot), BaselineAgent("oracle", robot)]
