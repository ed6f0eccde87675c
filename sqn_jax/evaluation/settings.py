"""The settings of an evaluation: maps, tasks, noise and seeds; and the worlds made from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import jax

from sqn_jax.config import EnvConfig
from sqn_jax.config.validation import LIMITS, require_limits
from sqn_jax.env import EnvParams, make_env
from sqn_jax.env.prepare import with_noise
from sqn_jax.maps import OccupancyMap

Tasks = Literal["evaluation points", "random pairs"]
SPAWN_MODES: dict[Tasks, Literal["evaluation", "training"]] = {
    "evaluation points": "evaluation",
    "random pairs": "training",
}
"""The two kinds of tasks, and the spawn mode of each."""

Maps = Mapping[tuple[str, float], OccupancyMap]
"""Maps by their name in the settings and the robot radius, m, for which they were loaded."""


@dataclass(frozen=True)
class Settings:
    """Settings of an evaluation."""

    maps: tuple[str, ...]
    """Names of maps of the project, or files."""
    tasks: tuple[Tasks, ...] = ("evaluation points",)
    episodes: int = 100
    """Episodes under each evaluation seed."""
    eval_seeds: int = 5
    """Number of evaluation seeds."""
    seed: int = 1_000
    """The first evaluation seed."""
    noise: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    """Pairs of velocity noise and range noise."""
    noise_unit: Literal["relative", "absolute"] | None = None
    """Unit of both, see `EnvConfig`; None: as each robot was configured."""
    goal_radii: tuple[float, ...] = (0.3, 0.5)
    """m; success is computed for each radius from the same episodes."""
    max_steps: int = 0
    """Steps per episode; 0: the limit of each map."""
    robot_radius: float | None = None
    """m; None: that of each robot."""

    @property
    def all_eval_seeds(self) -> list[int]:
        """The evaluation seeds, which are consecutive."""
        return [self.seed + index for index in range(self.eval_seeds)]

    def __post_init__(self) -> None:
        require_limits(self.episodes, "episodes", *LIMITS["eval.episodes"])
        require_limits(self.eval_seeds, "eval_seeds", *LIMITS["eval.seeds"])
        require_limits(self.max_steps, "max_steps", *LIMITS["env.max_steps"])
        least, most = LIMITS["eval.seed"]
        require_limits(self.seed, "seed", least, most + 1 - self.eval_seeds)
        for velocity_noise, range_noise in self.noise:
            require_limits(velocity_noise, "velocity noise", *LIMITS["env.velocity_noise"])
            require_limits(range_noise, "range noise", *LIMITS["env.range_noise"])
        for radius in self.goal_radii:
            require_limits(radius, "goal radius", *LIMITS["env.goal_radius"])
        for name in ("maps", "tasks", "noise", "goal_radii"):
            values = getattr(self, name)
            for value in values:
                if values.count(value) > 1:
                    raise ValueError(f"{name}: {value} comes twice, expected each once")
        if not (self.maps and self.tasks and self.noise and self.goal_radii):
            raise ValueError("nothing to evaluate: expected a map, a task and a goal radius")


@dataclass(frozen=True)
class SuiteSettings:
    """How often each task is tried."""

    episodes: int = 1
    """Episodes per task and evaluation seed."""
    eval_seeds: int = 5
    """Number of evaluation seeds."""
    seed: int = 1_000
    """The first evaluation seed."""
    noise: tuple[float, float] = (0.0, 0.0)
    """Velocity noise and range noise, in the units of each robot."""

    def __post_init__(self) -> None:
        require_limits(self.episodes, "episodes", *LIMITS["eval.episodes"])
        require_limits(self.eval_seeds, "eval_seeds", *LIMITS["eval.seeds"])
        least, most = LIMITS["eval.seed"]
        require_limits(self.seed, "seed", least, most + 1 - self.eval_seeds)
        require_limits(self.noise[0], "velocity noise", *LIMITS["env.velocity_noise"])
        require_limits(self.noise[1], "range noise", *LIMITS["env.range_noise"])

    @property
    def all_eval_seeds(self) -> list[int]:
        """The evaluation seeds, which are consecutive."""
        return [self.seed + index for index in range(self.eval_seeds)]

    @property
    def tries(self) -> int:
        """Episodes of each task, of one policy."""
        return self.episodes * self.eval_seeds


@dataclass(frozen=True)
class World:
    """A map prepared for a robot, with one kind of tasks and one level of noise."""

    occupancy_map: OccupancyMap
    env_params: EnvParams
    tasks: Tasks
    noise: tuple[float, float]


def with_body(robot: EnvConfig, trained: EnvConfig) -> EnvConfig:
    """A robot as an agent sees it that was trained with another one.

    Where its body is wider, the agent sees obstacles thicker by the difference (`env.scan_margin`).
    """
    wider = max(0.0, robot.robot_radius - trained.robot_radius)
    return dataclasses.replace(robot, scan_margin=robot.scan_margin + wider)


_SEEN = (
    *("goal_distance_encoding", "goal_distance_scale", "max_goal_distance", "heading_encoding"),
    *("scan_margin", "bumper", "ray_sectors", "ray_iterations"),
)


def as_the_oracle_knows_it(robot: EnvConfig) -> EnvConfig:
    """A robot without what only agents see of it: two that are equal so have the same oracle."""
    usual = EnvConfig()
    return dataclasses.replace(robot, **{name: getattr(usual, name) for name in _SEEN})


def robot_for(env_config: EnvConfig, settings: Settings) -> EnvConfig:
    """The robot of an agent under the settings of an evaluation, yet without noise."""
    radius = settings.robot_radius
    robot = env_config if radius is None else dataclasses.replace(env_config, robot_radius=radius)
    return dataclasses.replace(
        with_body(robot, env_config),
        max_steps=settings.max_steps,
        near_goal_fraction=0.0,
        velocity_noise=0.0,
        velocity_noise_unit=settings.noise_unit or env_config.velocity_noise_unit,
        range_noise=0.0,
        range_noise_unit=settings.noise_unit or env_config.range_noise_unit,
    )


def worlds(robot: EnvConfig, maps: Maps, settings: Settings) -> Iterator[World]:
    """Every world (map, kind of tasks, noise) of an evaluation for a robot from `robot_for`."""
    for name in settings.maps:
        occupancy_map = maps[name, robot.robot_radius]
        for tasks in settings.tasks:
            without_noise = make_env(occupancy_map, robot, spawn=SPAWN_MODES[tasks])
            for noise in settings.noise:
                yield World(occupancy_map, with_noise(without_noise, *noise), tasks, noise)


def task_key(eval_seed: int, tasks: Tasks) -> jax.Array:
    """The key of the episodes of an evaluation seed; it is the same for every agent."""
    return stream_key(eval_seed, list(SPAWN_MODES).index(tasks))


@jax.jit
def stream_key(seed: int, stream: int) -> jax.Array:
    """The key of a stream of a seed; streams are independent of each other."""
    return jax.random.fold_in(jax.random.key(seed), stream)
