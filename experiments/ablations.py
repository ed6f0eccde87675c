"""Does the skill ensemble help? Arms trained alike, compared by their training seeds.

    python -m experiments.ablations --arena quick|caves|paper|smoke [--arms A ...] [--seeds S ...]

Trains what is missing of an arena of docs/ENSEMBLE.md, the first seeds of all arms first, evaluates
every run once, and writes ablations.json, ablations.md, learning_curves.png and differences.png.
The same command resumes what was stopped. With smoke the robots learn next to nothing; it shows
that everything works.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.arm_statistics import (
    PRIMARY,
    Scores,
    arm_results,
    arms_table,
    by_seed,
    decision_line,
    paired_by_seed,
    verdict,
)
from experiments.common import run, run_name, train_unless_done
from sqn_jax import config as configs
from sqn_jax import figures
from sqn_jax.config import TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent, with_epsilons
from sqn_jax.evaluation.settings import Settings, Tasks
from sqn_jax.outside.reading import read_json
from sqn_jax.policies.run_policies import load_policy
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.storage.files import write_json
from sqn_jax.storage.run_folder import RunFolder

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

DECIDED = ("sqn", "r2d2")
"""The arms whose difference is the answer."""

UNSEEN = ("maze:100", "maze:101", "maze:102")
"""Mazes that no run is trained on."""

PRIMARY_TASKS: Tasks = "random pairs"

MAX_SCORES_BYTES = 2**24

FIRST_SEED = 10
"""Seeds below have been used to choose settings."""


@dataclass(frozen=True)
class Arena:
    """Where arms are compared: how they are trained, and on what they are judged."""

    preset: str
    seeds: Mapping[str, int]
    """How many seeds each arm has, from `FIRST_SEED` on."""
    maps: tuple[str, ...]
    primary: tuple[str, ...]
    """The maps among them by which the arena is decided."""
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
        ValueError: there is no "=".
    """
    changes = {}
    for text in texts:
        name, is_one, value = text.partition("=")
        if not is_one:
            raise ValueError(f"--set {text}: expected NAME=VALUE")
        try:
            changes[name] = json.loads(value)
        except json.JSONDecodeError:
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
        ValueError: a setting is unknown or out of its range, or runs would have seeds in common.
    """
    chosen = list(arena.seeds) if arms is None else list(arms)
    firsts = sorted(seeds or [])
    if any(later - earlier < num_seeds for earlier, later in itertools.pairwise(firsts)):
        raise ValueError(f"--seeds {firsts} with --num-seeds {num_seeds}: seeds come twice")
    preset = with_settings(PRESETS[arena.preset], {**arena.changes, **(changes or {})})

    def seeds_of(arm: str) -> Sequence[int]:
        if seeds is not None:
            return seeds
        return range(FIRST_SEED, FIRST_SEED + arena.seeds.get(arm, 1), num_seeds)

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


def evaluation_settings(arena: Arena) -> Settings:
    """Both kinds of tasks on the maps of an arena."""
    return Settings(
        maps=arena.maps,
        tasks=("evaluation points", "random pairs"),
        episodes=arena.episodes,
        eval_seeds=arena.eval_seeds,
    )


def scores_of(trained: Run, folder: Path, arena: Arena, path: Path) -> list[dict[str, Any]]:
    """The scores of a run by training seed, map, tasks and epsilon; evaluated unless on file.

    Raises:
        ValueError: the file is of another evaluation.
    """
    settings = evaluation_settings(arena)
    asked = {**dataclasses.asdict(settings), "epsilons": arena.epsilons}
    asked = json.loads(json.dumps({"run": configs.to_public_dict(trained.config), **asked}))
    if path.is_file():
        found = read_json(path, MAX_SCORES_BYTES, "scores")
        if not isinstance(found, dict) or found.get("evaluation") != asked:
            raise ValueError(
                f"{path}: of another run or evaluation, expected --out to name a folder"
            )
        scores: list[dict[str, Any]] = found["scores"]
        return scores
    rows: dict[tuple[Any, ...], dict[str, list[float]]] = {}

    def keep(batch: EpisodeBatch) -> None:
        occupancy_map, tasks = batch.world.occupancy_map, batch.world.tasks
        key = (batch.training_seed, occupancy_map.name, tasks, batch.agent.epsilon)
        numbers = batch.numbers(settings.goal_radii[0])
        for name in ("spl", "success", "time_steps"):
            rows.setdefault(key, {}).setdefault(name, []).append(float(numbers[name].mean()))

    agents = with_epsilons([TrainedAgent(trained.arm, (load_policy(folder),))], arena.epsilons)
    evaluate_session(list(agents), settings, on_evaluated=keep)
    scores = [
        {
            **dict(zip(("seed", "map", "tasks", "epsilon"), key, strict=True)),
            # All evaluation seeds have as many episodes.
            **{name: sum(values) / len(values) for name, values in row.items()},
        }
        for key, row in rows.items()
    ]
    write_json(path, {"evaluation": asked, "scores": scores})
    return scores


def train_within(
    planned: Sequence[Run], arena: Arena, out: Path, minutes: float
) -> Iterator[tuple[Run, Path, list[dict[str, Any]]]]:
    """Train and evaluate runs; none is begun when the longest so far would not fit any more."""
    begun, longest = time.monotonic(), 0.0
    for index, each in enumerate(planned):
        left = 60 * minutes - (time.monotonic() - begun)
        folder, path = out / each.name, out / f"{each.name}_scores.json"
        if not path.is_file() and left < longest:
            names = ", ".join(other.name for other in planned[index:])
            print(f"--budget-minutes {minutes:g} are used up; not trained: {names}")
            return
        started = time.monotonic()
        train_unless_done(each.config, folder)
        yield each, folder, scores_of(each, folder, arena, path)
        longest = max(longest, time.monotonic() - started)


def decision(scores: Scores, arena: Arena) -> dict[str, Any] | None:
    """The comparison by which an arena is decided, greedy; None unless both arms are there."""
    if not all(arm in scores for arm in DECIDED):
        return None
    selected = {"map": arena.primary, "tasks": PRIMARY_TASKS, "epsilon": 0.0}
    compared = paired_by_seed(*(by_seed(scores[arm], PRIMARY, **selected) for arm in DECIDED))
    return {"arms": DECIDED, "maps": arena.primary, **compared, "verdict": verdict(compared)}


def write_results(
    name: str, trained: Sequence[tuple[Run, Path, list[dict[str, Any]]]], out: Path
) -> str:
    """Write the results of the runs that there are; returns the page."""
    scores: Scores = {}
    curves: dict[str, list[Any]] = {}
    for each, folder, rows in trained:
        scores.setdefault(each.arm, []).extend(rows)
        metrics = RunFolder.open(folder)[0].read_metrics()
        curves.setdefault(each.arm, []).append(metrics)
    results = arm_results(scores, reference=DECIDED[0])
    decided = decision(scores, ARENAS[name])
    settings = {each.name: configs.to_public_dict(each.config) for each, _, _ in trained}
    write_json(
        out / "ablations.json",
        {
            **{"schema": 1, "arena": name, "decision": decided, "results": results},
            **{"scores": scores, "settings": settings},
        },
    )
    page = f"# Arena {name}\n\n{arms_table(results)}\n"
    if decided is not None:
        page += f"\n{decision_line(decided)}\n"
    (out / "ablations.md").write_text(page, encoding="utf-8")
    shown = dict(list(curves.items())[: len(figures.style.COLORS)])
    figure = figures.learning_curves(shown, title=f"Arena {name}, training seeds in evaluation")
    figures.save(figure, out / "learning_curves.png")
    others = [entry for entry in results if entry["difference"] is not None]
    if others:
        figure = figures.paired_differences(others, title=f"Arena {name}: arm minus SQN")
        figures.save(figure, out / "differences.png")
    return page


def main() -> None:
    """Parse the options, train, evaluate, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arena", choices=list(ARENAS), default="quick")
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), help="default: the arena's")
    parser.add_argument("--seeds", nargs="+", type=int, help="default: the arena's, from 10 on")
    parser.add_argument("--num-seeds", type=int, default=1, help="seeds side by side in a run")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="for all arms")
    parser.add_argument("--budget-minutes", type=float, default=float("inf"))
    parser.add_argument("--out", type=Path, help="default runs/ablations_ARENA")
    options = parser.parse_args()
    if options.num_seeds < 1:
        raise ValueError(f"--num-seeds is {options.num_seeds}, expected at least 1")
    arena = ARENAS[options.arena]
    planned = planned_runs(
        arena, options.arms, options.seeds, options.num_seeds, parse_changes(options.set)
    )
    out: Path = options.out or Path("runs") / f"ablations_{options.arena}"
    out.mkdir(parents=True, exist_ok=True)
    trained = list(train_within(planned, arena, out, options.budget_minutes))
    if not trained:
        raise ValueError("no run is trained, expected a larger --budget-minutes")
    print(write_results(options.arena, trained, out))
    print(f"wrote ablations.json, ablations.md and figures to {out}")


if __name__ == "__main__":
    run(main)
