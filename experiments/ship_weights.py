"""Put the policies of finished runs into the package: python experiments/ship_weights.py RUN ...

Each is named after its agent, `pretrained:sqn`, `pretrained:r2d2`, `pretrained:dqn`, or as `--name`
says. The facts of its model card come from the run folder: how it was trained and what it reached
right afterwards.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from experiments.common import run
from sqn_jax.policies import Policy, load_policy
from sqn_jax.pretrained import write_policy

WEIGHTS = Path(__file__).resolve().parents[1] / "sqn_jax" / "weights"


def card(run_dir: Path, policy: Policy) -> dict[str, Any]:
    """What a user of the policy should know, from its run folder.

    Raises:
        ValueError: the run is not finished.
    """
    if not (run_dir / "summary.json").is_file():
        raise ValueError(f"run folder {run_dir}: not finished, expected a summary.json in it")
    summary = json.loads((run_dir / "summary.json").read_text(encoding="utf-8"))
    found = json.loads((run_dir / "evaluation.json").read_text(encoding="utf-8"))["results"]
    return {
        "agent": policy.config.algo,
        "method": policy.config.method,
        "trained_on": policy.config.map,
        "started_from": Path(policy.config.start_from).name,
        "training_episodes": summary["episodes"],
        "training_seed": policy.config.seed,
        "training_minutes": round(summary["wall_seconds"] / 60, 1),
        "versions": summary["versions"],
        "evaluation": [
            {
                "map": entry["map"],
                "tasks": entry["tasks"],
                "episodes": entry["episodes"],
                "goal_radius_m": entry["goal_radius"],
                "success": entry["success"],
                "time_steps": entry["time_steps"],
            }
            for entry in found
        ],
    }


def main() -> None:
    """Read the runs, write the files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run_dirs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="folder (default the package's)")
    parser.add_argument("--name", help="of a single run's policy (default its agent's)")
    options = parser.parse_args()
    if options.name and len(options.run_dirs) > 1:
        parser.error("--name goes with a single run")
    options.out.mkdir(parents=True, exist_ok=True)
    for run_dir in options.run_dirs:
        policy = load_policy(run_dir)
        named = dataclasses.replace(policy, name=options.name or policy.config.algo)
        write_policy(options.out, named, card(run_dir, policy))
        print(f"wrote {options.out / named.name}.npz and .json")


if __name__ == "__main__":
    run(main)
