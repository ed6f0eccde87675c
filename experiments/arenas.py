"""What is compared in docs/ENSEMBLE.md: arms, arenas, and the runs that they take."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from experiments.arm_statistics import RELEVANT
from experiments.common import run_name
from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.config.presets import PRESETS

ARMS: dict[str, dict[str, Any]] = {
    "sqn": {},
    "r2d2": {"algo": "r2d2"},
    "r2d2_wide": {"algo": "r2d2", "network.r2d2_width_factor": 3},
    "dqn": {"algo": "dqn"},
    "sqn_1": {"network.num_skills": 1},
    "sqn_3": {"network.num_skills": 3},
    "sqn_4": {"network.num_skills": 4},
    "equal": {"network.gate": "equal"},
    "no_embeddings": {"network.embeddings": False},
    "temperature": {"network.gate_temperature": 0.5},
    "reachable": {"network.gate": "reachable"},
    "each_skill": {"learner.skill_loss": "each"},
    "entropy": {"learner.gate_entropy_weight": 0.01},
    "balanced": {"network.gate_balance_rate": 0.001},
}
"""What each arm changes, by the dotted names of the settings."""

REFERENCE = "sqn"
"""The arm beside which all others are shown."""

UNSEEN = ("maze:100", "maze:101", "maze:102")
"""Mazes that no run is trained on."""


@dataclass(frozen=True)
class Arena:
    """Where arms are compared: how they are trained, and on what they are judged."""

    preset: str
    seeds: Mapping[str, int]
    """How many seeds each arm has, from `first_seed` on."""
    maps: tuple[str, ...]
    primary: tuple[str, ...]
    """The maps among them by which the arena is decided."""
    decided: tuple[str, str] = ("sqn", "r2d2")
    """The arms whose difference, first minus second, is the answer."""
    described: tuple[tuple[str, str], ...] = ()
    """Arms that are compared likewise, and decide nothing."""
    least_difference: float = 0.0
    """The mean difference in SPL that a yes takes."""
    first_seed: int = 10
    """Seeds below 10 have been used to choose settings."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    epsilons: tuple[float, ...] = (0.0,)
    episodes: int = 100
    eval_seeds: int = 5


ARENAS = {
    "quick": Arena(
        "quick",
        {
            **{"sqn": 10, "r2d2": 10, "r2d2_wide": 5, "dqn": 3, "sqn_1": 3, "sqn_3": 3, "sqn_4": 3},
            **{"equal": 3, "no_embeddings": 3, "temperature": 3},
        },
        ("maze", *UNSEEN),
        primary=("maze",),
    ),
    "wide": Arena(
        "quick",
        {"r2d2_wide": 6, "sqn": 6, "r2d2": 6},
        ("maze", *UNSEEN),
        primary=UNSEEN,
        decided=("r2d2_wide", "sqn"),
        described=(("r2d2_wide", "r2d2"),),
        least_difference=RELEVANT,
        first_seed=13,
    ),
    "caves": Arena(
        "best",
        {"sqn": 6, "r2d2": 6, "reachable": 3, "each_skill": 3, "entropy": 3, "balanced": 3},
        ("maze", *UNSEEN, "cave:100", "cave:101"),
        primary=(*UNSEEN, "cave:100", "cave:101"),
        # Stated before `best` had motion inputs, distances without end and learnability.
        changes={
            **{"map": "maze*12,cave:0-11", "learner.discount": 0.995, "total_episodes": 25_600},
            **{"task_sampling": "uniform", "network.motion_inputs": False},
            "env.goal_distance_encoding": "clipped",
        },
        eval_seeds=2,
    ),
    "paper": Arena(
        "paper",
        {"sqn": 1, "r2d2": 1, "dqn": 1},
        ("maze", "column", "forest", "cave"),
        primary=("maze",),
        epsilons=(0.0, 0.1),
    ),
    "smoke": Arena(
        "smoke",
        {"sqn": 2, "r2d2": 2, "equal": 2},
        ("maze",),
        primary=("maze",),
        episodes=10,
        eval_seeds=1,
    ),
}


@dataclass(frozen=True)
class Run:
    """One training run of an arm, with one seed or several side by side."""

    arm: str
    config: TrainConfig

    @property
    def name(self) -> str:
        return run_name(self.arm, self.config)

    @property
    def seeds(self) -> range:
        """Its training seeds."""
        return range(self.config.seed, self.config.seed + self.config.num_seeds)


def with_settings(config: TrainConfig, changes: Mapping[str, Any]) -> TrainConfig:
    """Settings with some changed, by their dotted names.

    Raises:
        ValueError: there is no such setting, or a value is out of its range.
    """
    values = configs.to_dict(config)
    for name, value in changes.items():
        group, _, setting = name.rpartition(".")
        if group and not isinstance(values.get(group), dict):
            raise ValueError(f"{name}: no such setting, expected one of sqn train --help")
        (values[group] if group else values)[setting] = value
    changed: TrainConfig = configs.from_dict(values)
    return changed


def parse_changes(texts: Sequence[str]) -> dict[str, Any]:
    """Settings and values out of NAME=VALUE; what is no JSON is a text.

    Raises:
        ValueError: there is no "=", or nothing before it.
    """
    changes = {}
    for text in texts:
        name, is_one, value = text.partition("=")
        if not (name and is_one):
            raise ValueError(f"--set {text}: expected NAME=VALUE")
        try:
            changes[name] = json.loads(value)
        except (json.JSONDecodeError, RecursionError):
            changes[name] = value
    return changes


def planned_runs(
    arena: Arena,
    arms: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    num_seeds: int = 1,
    changes: Mapping[str, Any] | None = None,
) -> list[Run]:
    """The runs of an arena in the order in which they are trained: seed by seed, all arms of each.

    So that whatever the budget allows can be compared seed by seed.

    Args:
        arena: which.
        arms: those of the arena by default.
        seeds: the first seed of each run; by default those of the arena.
        num_seeds: seeds side by side in each run.
        changes: to the settings of all arms.

    Raises:
        ValueError: a setting is unknown, out of its range or what arms differ in, an arm comes
            twice, runs would have seeds in common, or more seeds than the arena says.
    """
    for name in ("seed", "num_seeds"):
        if name in (changes or {}):
            raise ValueError(f"--set {name}: expected --seeds and --num-seeds to say it")
    for name in changes or {}:
        if any(name in of_arm for of_arm in ARMS.values()):
            raise ValueError(f"--set {name}: is what arms differ in, expected --arms to say it")
    chosen = list(arena.seeds) if arms is None else list(arms)
    if len(set(chosen)) < len(chosen):
        raise ValueError(f"--arms {' '.join(chosen)}: one comes twice")
    firsts = sorted(seeds or [])
    if any(later - earlier < num_seeds for earlier, later in itertools.pairwise(firsts)):
        raise ValueError(f"--seeds {firsts} with --num-seeds {num_seeds}: seeds come twice")
    preset = with_settings(PRESETS[arena.preset], {**arena.changes, **(changes or {})})

    def seeds_of(arm: str) -> Sequence[int]:
        if seeds is not None:
            return seeds
        count = arena.seeds.get(arm, 1)
        if count % num_seeds:
            raise ValueError(
                f"--num-seeds is {num_seeds}, expected a divisor of the {count} seeds of {arm}"
            )
        return range(arena.first_seed, arena.first_seed + count, num_seeds)

    longest = max(len(seeds_of(arm)) for arm in chosen)
    return [
        Run(
            arm,
            with_settings(
                preset, {"seed": seeds_of(arm)[place], "num_seeds": num_seeds, **ARMS[arm]}
            ),
        )
        for place in range(longest)
        for arm in chosen
        if place < len(seeds_of(arm))
    ]
