"""The paper's table: three agents on four maps, beside the paper's numbers and two references.

    .venv/bin/python experiments/table1.py [--preset quick|best|paper|smoke] [--num-seeds K]

Trains what is missing, the K seeds of an agent in one program, evaluates it, and writes table1.json
(with one record an episode in table1.jsonl), table1.md and learning_curves.png. With smoke the
robots learn next to nothing; it shows that everything works.
"""

from __future__ import annotations

import argparse
from typing import Any

from experiments.common import (
    add_options,
    episodes_and_seeds,
    prepare,
    run,
)
from sqn_jax import figures
from sqn_jax.config.presets import PAPER_MAPS
from sqn_jax.evaluation.agents import group_policies, with_baselines
from sqn_jax.evaluation.paper_results import PAPER_RESULTS, PAPER_REWARDS
from sqn_jax.evaluation.scores import markdown_table, results_table
from sqn_jax.evaluation.settings import Settings
from sqn_jax.policies.run_policies import load_policy
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.storage.files import write_whole
from sqn_jax.storage.run_folder import RunFolder


def paper_table(results: list[dict[str, Any]]) -> str:
    """Success and time steps of each agent on each map, ours and the paper's."""
    radius = results[0]["goal_radius"]
    maps = list(dict.fromkeys(entry["map"] for entry in results))
    agents = list(dict.fromkeys(entry["agent"] for entry in results))
    rows = []
    for agent in agents:
        row = [agent]
        for name in maps:
            (entry,) = (
                entry
                for entry in results
                if (entry["agent"], entry["map"], entry["goal_radius"]) == (agent, name, radius)
            )
            cell = f"{_spread(entry['success'], 2)}, {_spread(entry['time_steps'], 1)}"
            if name in PAPER_RESULTS.get(entry["algorithm"], {}):
                success, steps = PAPER_RESULTS[entry["algorithm"]][name]
                cell += f" (paper {success:.2f}, {steps:.1f})"
            row.append(cell)
        rows.append(row)
    return markdown_table(["agent: success, time steps", *maps], rows)


def _spread(statistics: dict[str, Any], digits: int) -> str:
    mean, spread = statistics["mean"], statistics["std_of_means"]
    return f"{mean:.{digits}f}" + ("" if spread is None else f" ± {spread:.{digits}f}")


def report(evaluation: dict[str, Any], settings: Settings) -> str:
    """The page table1.md."""
    results = evaluation["results"]
    seeds = len(results[0]["training_seeds"])
    lines = [
        "# Table I",
        "",
        f"Greedy episodes between the maps' evaluation points, {settings.episodes} under each of "
        f"{settings.eval_seeds} evaluation seeds, {seeds} training seed(s); goal radius "
        f"{settings.goal_radii[0]:g} m, failures at the step limit. ± is the sample standard "
        "deviation (n - 1) of the means of the pairs of training seed and evaluation seed.",
        "",
        paper_table(results),
        "",
        results_table(results),
    ]
    for comparison in evaluation["comparisons"]:
        low, high = comparison["ci95"]
        lines += [
            "",
            f"A training run of {comparison['first']} has more success than one of "
            f"{comparison['second']} with "
            f"probability {comparison['probability']:.2f} [{low:.2f}, {high:.2f}].",
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Parse the options, train, evaluate, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add_options(parser)
    parser.add_argument("--maps", nargs="+", default=list(PAPER_MAPS))
    options = parser.parse_args()
    episodes, eval_seeds = episodes_and_seeds(options)
    settings = Settings(maps=tuple(options.maps), episodes=episodes, eval_seeds=eval_seeds)
    folders, out = prepare(options, settings)
    curves: dict[str, list[Any]] = {}
    for folder in folders:
        run_folder, config = RunFolder.open(folder)
        curves.setdefault(config.algo.upper(), []).append(run_folder.read_metrics())
    rewards = {algo.upper(): reward for algo, reward in PAPER_REWARDS.items()}
    title = f"Training, preset {options.preset}"
    figure = figures.learning_curves(curves, title=title, paper_rewards=rewards)
    figures.save(figure, out / "learning_curves.png")
    trained = group_policies([load_policy(folder) for folder in folders])
    agents = with_baselines(trained, baselines=True)
    evaluation = evaluate_session(agents, settings, out / "table1.json")
    page = report(evaluation, settings)
    write_whole(out / "table1.md", page)
    print(page)
    print(f"wrote table1.json, table1.jsonl, table1.md and learning_curves.png to {out}")


if __name__ == "__main__":
    run(main)
