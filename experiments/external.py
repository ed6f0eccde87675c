"""Policies on suites of tasks from elsewhere: python experiments/external.py DIR --out FILE

DIR holds suites of tasks (`sqn tasks`), one JSON file each. Every policy and the wall follower try
each task under the evaluation seeds; the oracle, which plans for long, tries the first tasks only.
`--no-baselines` leaves both out, where they are on record for the suite.
Suites in which a collision ends an episode get the score of the BARN challenge beside their
success. Maps are ranked by every other try and judged by the rest; with one evaluation seed the
worst tenth reads too low. All of it is kinematic, and no entry of any leaderboard.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import run
from sqn_jax.config import EnvConfig
from sqn_jax.evaluation.agents import Agent, BaselineAgent, TrainedAgent, with_epsilons
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.settings import SuiteSettings
from sqn_jax.evaluation.suite_scores import worst_tenth
from sqn_jax.policies.pretrained import find_policy, pretrained_names
from sqn_jax.policies.run_policies import with_bumper
from sqn_jax.runs.evaluate import evaluate_suite_session
from sqn_jax.storage.files import write_json
from sqn_jax.tasks import TaskSuite, read_suite
from sqn_jax.tasks.barn import barn_score

PUBLISHED = {"agent": "DWA (organizers' log)", "success": 0.85, "score": 0.159}
"""What the organizers of BARN publish for their dynamic-window planner, all 300 worlds."""


def evaluate(
    agents: Sequence[Agent], suite: TaskSuite, file: Path, settings: SuiteSettings
) -> list[dict[str, Any]]:
    """A row for each agent: what it reached on a suite, without the single tasks."""
    evaluation, records = evaluate_suite_session(agents, suite, settings, source=file)
    rows = []
    for entry in evaluation["results"]:
        row = {name: value for name, value in entry.items() if name not in ("maps", "tasks")}
        if suite.collision_ends:
            own = [record for record in records if record["agent"] == entry["agent"]]
            row["barn_score"] = float(np.mean([_score(record, suite) for record in own]))
        rows.append({"num_tasks": len(suite.tasks), **row})
    return rows


def _score(record: dict[str, Any], suite: TaskSuite) -> float:
    time_step = suite.robot_of(EnvConfig()).time_step
    seconds = record["time_steps"] * time_step
    return float(barn_score(record["success"], seconds, record["shortest_path_m"]))


def table(suites: dict[str, Any]) -> str:
    """One row for each suite and agent."""
    header = ["suite", "agent", "tasks", "success", "95 % interval", "worst tenth", "SPL", "score"]
    rows = []
    for name, results in suites.items():
        for row in results:
            low, high = row["success"]["ci95"]
            score = f"{row['barn_score']:.3f}" if "barn_score" in row else ""
            rows.append(
                [
                    name,
                    row["agent"],
                    str(row["num_tasks"]),
                    f"{row['success']['mean']:.2f}",
                    f"{low:.2f} to {high:.2f}",
                    f"{worst_tenth(row):.2f}",
                    f"{row['spl']['mean']:.2f}",
                    score,
                ]
            )
    return markdown_table(header, rows)


def main() -> None:
    """Evaluate on every suite of a folder and write one file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--policies", nargs="+", help="default: those that come with the package")
    parser.add_argument("--eval-seeds", type=int, default=5)
    parser.add_argument("--oracle-tasks", type=int, default=50, help="of each suite (default 50)")
    parser.add_argument("--bumper", type=float, help="of the policies' robot, m (default: none)")
    parser.add_argument("--no-baselines", action="store_true", help="the policies alone")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    files = sorted(options.folder.glob("*.json"))
    if not files:
        raise ValueError(f"{options.folder}: no suite, expected files ending in .json")
    names = options.policies or [f"pretrained:{name}" for name in pretrained_names()]
    policies: Sequence[Agent] = with_epsilons(
        [TrainedAgent(name, (with_bumper(find_policy(name), options.bumper),)) for name in names],
        [0.0],
    )
    robot = policies[0].env_config
    settings = SuiteSettings(eval_seeds=options.eval_seeds)
    suites: dict[str, Any] = {}
    for file in files:
        suite = read_suite(file)
        bug = [] if options.no_baselines else [BaselineAgent("bug", robot)]
        rows = evaluate([*policies, *bug], suite, file, settings)
        if not options.no_baselines:
            some = dataclasses.replace(suite, tasks=suite.tasks[: options.oracle_tasks])
            once = dataclasses.replace(settings, eval_seeds=1)
            rows += evaluate([BaselineAgent("oracle", robot)], some, file, once)
        suites[suite.name] = rows
        # What has been evaluated is not lost if the rest is broken off.
        write_json(options.out, {"published": {"barn": PUBLISHED}, "suites": suites})
    print(table(suites))


if __name__ == "__main__":
    run(main)
