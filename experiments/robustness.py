"""The paper's robustness figure: success under velocity noise and range noise.

    .venv/bin/python experiments/robustness.py [--preset quick|best|paper|smoke] [--num-seeds K]

Uses the runs of table1.py, trains what is missing, and writes robustness.json (with one record an
episode in robustness.jsonl), robustness.md and robustness.png.
"""

from __future__ import annotations

import argparse

from experiments.common import (
    add_options,
    episodes_and_seeds,
    prepare,
    run,
)
from sqn_jax import figures
from sqn_jax.evaluation.agents import group_policies
from sqn_jax.evaluation.scores import results_table
from sqn_jax.evaluation.settings import Settings
from sqn_jax.policies.run_policies import load_policy
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.storage.files import write_whole

VELOCITY_NOISE = (0.1, 0.2, 0.3)
RANGE_NOISE = (0.2, 0.4, 0.6)
LEVELS = (
    (0.0, 0.0),
    *((level, 0.0) for level in VELOCITY_NOISE),
    *((0.0, level) for level in RANGE_NOISE),
)
"""Pairs of velocity noise and range noise."""


def main() -> None:
    """Parse the options, train, evaluate, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add_options(parser)
    parser.add_argument("--map", default="maze")
    parser.add_argument("--noise-unit", choices=["relative", "absolute"], default="relative")
    options = parser.parse_args()
    episodes, eval_seeds = episodes_and_seeds(options)
    settings = Settings(
        maps=(options.map,),
        episodes=episodes,
        eval_seeds=eval_seeds,
        noise=LEVELS,
        noise_unit=options.noise_unit,
    )
    folders, out = prepare(options, settings)
    agents = group_policies([load_policy(folder) for folder in folders])
    evaluation = evaluate_session(list(agents), settings, out / "robustness.json")
    radius = settings.goal_radii[0]
    shown = [entry for entry in evaluation["results"] if entry["goal_radius"] == radius]
    figure = figures.robustness(shown, title=f"Robustness, {options.map}, goal radius {radius:g} m")
    figures.save(figure, out / "robustness.png")
    table = results_table(evaluation["results"])
    write_whole(out / "robustness.md", f"# Robustness\n\n{table}\n")
    print(table)
    print(f"wrote robustness.json, robustness.jsonl, robustness.md and robustness.png to {out}")


if __name__ == "__main__":
    run(main)
