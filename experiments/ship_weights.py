"""Put the policies of finished runs into the package: python experiments/ship_weights.py RUN ...

Each is named after its agent, `pretrained:sqn`, `pretrained:r2d2`, `pretrained:dqn`, or as `--name`
says; in another folder (`--out`) it is a file that `sqn` takes as FOLDER/NAME.npz. The facts of its
model card come from the run folder: how it was trained and what it reached right afterwards, or by
`--evaluation`, a file of `sqn evaluate` on it, which an earlier `--checkpoint` needs. Runs it went
on from, of which `--before` has records or cards, are named too. `--average POLICY SHARE` takes a
share of another policy and the rest of the run: what is in between a policy and what became of it
in further training can have the merits of both.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from experiments.common import run
from sqn_jax.policies.pretrained import find_policy, write_policy
from sqn_jax.policies.run_policies import Policy, load_policy, require_same_network
from sqn_jax.storage.run_folder import RunFolder

WEIGHTS = Path(__file__).resolve().parents[1] / "sqn_jax" / "policies" / "weights"


def earlier_runs(records: Sequence[Path]) -> list[dict[str, Any]]:
    """Episodes and minutes of runs, from files of `record_run.py` and the cards of policies."""
    return [run for path in records for run in _runs_of(path)]


def _runs_of(path: Path) -> list[dict[str, Any]]:
    contents = json.loads(path.read_text("utf-8"))
    try:
        return _runs_in(contents, path.stem)
    except (KeyError, TypeError):
        raise ValueError(f"{path}: no record of runs and no card of a policy") from None


def _runs_in(contents: Any, name: str) -> list[dict[str, Any]]:
    if "card" in contents:
        before = contents["card"]
        facts = ("training_episodes", "training_minutes", "device")
        last = {"run": name, "seeds": 1} | {fact: before[fact] for fact in facts}
        return [*before["went_on_from"], last]
    return [
        {
            "run": run["run"],
            "seeds": run["config"]["num_seeds"],
            "training_episodes": run["summary"]["episodes"],
            "training_minutes": round(run["summary"]["wall_seconds"] / 60, 1),
            "device": run["summary"]["device"],
        }
        for run in contents["runs"]
    ]


def averaged(policy: Policy, word: str, share: float) -> Policy:
    """A policy whose parameters are by a share those of another, which has one training seed.

    Raises:
        ValueError: there is no such policy, it has several seeds or another network, or the share
            is not between 0 and 1.
    """
    other = find_policy(word)
    require_same_network(other, policy.config)
    if len(other.params) > 1:
        raise ValueError(f"{word}: holds several training seeds, expected one")
    if not 0.0 < share < 1.0:
        raise ValueError(f"--average: a share of {share}, expected between 0 and 1")

    def mixed(theirs: jax.Array, own: jax.Array) -> jax.Array:
        return share * theirs + (1.0 - share) * own

    params = tuple(jax.tree.map(mixed, other.params[0], own) for own in policy.params)
    return dataclasses.replace(policy, params=params)


def card(
    run_dir: Path,
    policy: Policy,
    seed: int,
    checkpoint: int | None,
    evaluation: Path | None,
    before: Sequence[Path],
    average: tuple[str, float] | None,
) -> dict[str, Any]:
    """What a user of the policy should know, from its run folder.

    Of an average nothing is known that is not in `evaluation`, a file of its own.

    Raises:
        ValueError: the run is not finished, or a file is none of an evaluation or of runs.
    """
    if not (run_dir / "summary.json").is_file():
        raise ValueError(f"run folder {run_dir}: not finished, expected a summary.json in it")
    summary = json.loads((run_dir / "summary.json").read_text(encoding="utf-8"))
    rows = RunFolder(run_dir).read_metrics()
    last = next(row for row in rows if row["chunk"] == (checkpoint or rows[-1]["chunk"]))
    file = evaluation or (None if average else run_dir / "evaluation.json")
    read = json.loads(file.read_text(encoding="utf-8")) if file else {"results": []}
    if not isinstance(read, dict) or "results" not in read:
        raise ValueError(f"{file}: has no results, expected a file of sqn evaluate")
    return {
        "agent": policy.config.algo,
        "method": policy.config.method,
        "trained_on": policy.config.maps.stem,
        "went_on_from": earlier_runs(before),
        "training_episodes": last["episodes"],
        "averaged_with": (
            {"policy": Path(average[0]).stem, "share": average[1]} if average else None
        ),
        "training_seed": seed,
        "training_minutes": round(last["wall_seconds"] / 60, 1),
        "device": summary["device"],
        "versions": summary["versions"],
        "evaluation": [
            {
                "map": entry["map"],
                "tasks": entry["tasks"],
                "episodes": entry["episodes"] * len(entry["eval_seeds"]),
                "goal_radius_m": entry["goal_radius"],
                "success": entry["success"],
                "time_steps": entry["time_steps"],
            }
            for entry in read["results"]
            if entry["goal_radius"] == policy.config.env.goal_radius
        ],
    }


def _share(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"--average: a share of {text}, expected a number") from None


def main() -> None:
    """Read the runs, write the files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run_dirs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="folder (default the package's)")
    parser.add_argument("--name", help="of a single run's policy (default its agent's)")
    parser.add_argument("--seed", type=int, help="of a run of several, which (default its first)")
    parser.add_argument("--checkpoint", type=int, help="chunks after which it was saved")
    parser.add_argument("--average", nargs=2, metavar=("POLICY", "SHARE"))
    parser.add_argument("--evaluation", type=Path, help="results, instead of the run's own")
    parser.add_argument("--before", nargs="+", type=Path, default=[], help="records or cards")
    options = parser.parse_args()
    if options.checkpoint is not None and options.evaluation is None:
        parser.error("--checkpoint takes an --evaluation of it")
    single = (options.name, options.checkpoint, options.average, options.evaluation)
    if any(single) and len(options.run_dirs) > 1:
        parser.error("--name, --checkpoint, --average and --evaluation go with a single run")
    if options.name is not None and Path(options.name).name != options.name:
        parser.error(f"--name is {options.name}, expected the name of a file without a folder")
    average = (options.average[0], _share(options.average[1])) if options.average else None
    options.out.mkdir(parents=True, exist_ok=True)
    for run_dir in options.run_dirs:
        policy = load_policy(run_dir, options.checkpoint or "newest")
        if average:
            policy = averaged(policy, *average)
        named = dataclasses.replace(policy, name=options.name or policy.config.algo)
        seed = policy.config.seed if options.seed is None else options.seed
        if seed not in policy.training_seeds:
            parser.error(f"--seed is {seed}, {run_dir} has {policy.training_seeds}")
        facts = card(
            run_dir,
            policy,
            seed,
            options.checkpoint,
            options.evaluation,
            options.before,
            average,
        )
        write_policy(options.out, named, facts, index=policy.training_seeds.index(seed))
        print(f"wrote {options.out / named.name}.npz and .json")


if __name__ == "__main__":
    run(main)
