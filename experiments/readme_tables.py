"""Write the README's tables from the recorded files: python experiments/readme_tables.py [--check]

Each table stands between `<!-- table NAME -->` and `<!-- end -->`; what is between is replaced.
With `--check` nothing is written: the exit code is 1 if a table is not what the records say.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import recorded, run
from experiments.robustness import LEVELS, RANGE_NOISE, VELOCITY_NOISE
from sqn_jax.config.presets import PAPER_MAPS
from sqn_jax.evaluation.paper_results import PAPER_RESULTS
from sqn_jax.evaluation.scores import markdown_table

ROOT = Path(__file__).resolve().parents[1]
NAMES = {"sqn": "SQN", "r2d2": "R2D2", "dqn": "DQN"}
PRETRAINED = {
    "sqn best": "`pretrained:best`",
    "sqn sqn": "`pretrained:sqn`",
    "r2d2": "`pretrained:r2d2`",
    "dqn": "`pretrained:dqn`",
}
"""Names of agents in evaluations of all policies that come with the package."""
RADIUS = 0.3

Entry = dict[str, Any]


def policies() -> str:
    """The policies that come with the package on the paper's four maps, beside the paper's."""
    entries = recorded("pretrained_table.json")["results"]
    rows = [
        [label, *(_success_and_steps(_one(entries, agent, name)) for name in PAPER_MAPS)]
        for agent, label in (PRETRAINED | {"bug": "bug", "oracle": "oracle"}).items()
    ]
    for algorithm in NAMES:
        found = [PAPER_RESULTS[algorithm][name] for name in PAPER_MAPS]
        cells = [f"{success:.2f}, {steps:.0f}" for success, steps in found]
        rows.append([f"paper, {NAMES[algorithm]}", *cells])
    return markdown_table(["", *PAPER_MAPS], rows)


def seeds() -> str:
    """All training seeds of the preset `quick`: mean success and its spread over them."""
    found = recorded("seeds_table.json")
    agents = list(dict.fromkeys(entry["agent"] for entry in found["results"]))
    maps = list(dict.fromkeys(entry["map"] for entry in found["results"]))
    rows = []
    for agent in agents:
        scores = [_one(found["results"], agent, name)["success_per_seed"] for name in maps]
        count = f"{len(scores[0])} seed" + "s" * (len(scores[0]) > 1)
        cells = [f"{np.mean(each):.2f} ± {np.std(each):.2f}" for each in scores]
        rows.append([f"{NAMES[agent]}, {count}", *cells])
    lines = [markdown_table(["", *maps], rows), ""]
    for told in found["comparisons"]:
        first, second = told["first"], told["second"]
        if agents.index(first) < agents.index(second):
            low, high = told["ci95"]
            lines.append(
                f"{NAMES[first]} beats {NAMES[second]} with probability "
                f"{told['probability']:.2f} [{low:.2f}, {high:.2f}]."
            )
    return "\n".join(lines)


def noise() -> str:
    """Success on the maze under the paper's noise."""
    three = recorded("pretrained_noise.json")["results"]
    best = recorded("best_noise.json")["results"]
    header = ["", "none", *(f"velocity {level:g}" for level in VELOCITY_NOISE)]
    header += [f"range {100 * level:.0f} %" for level in RANGE_NOISE]
    rows = [
        [label, *(_mean(_one(entries, agent, "maze", noise=level)) for level in LEVELS)]
        for label, entries, agent in (
            ("`pretrained:best`", best, "sqn"),
            *((f"`pretrained:{agent}`", three, agent) for agent in NAMES),
        )
    ]
    return markdown_table(header, rows)


def quick() -> str:
    """The run of `make train`, evaluated with more episodes."""
    entries = recorded("maze_quick_500.json")["results"]
    labels = {
        "random pairs": "random pairs of spawn points",
        "evaluation points": "the four evaluation points",
    }
    rows = []
    for tasks, label in labels.items():
        entry = _one(entries, "sqn", "maze", tasks=tasks)
        steps, spl = entry["time_steps"]["mean"], entry["spl"]["mean"]
        rows.append([label, _mean(entry), f"{steps:.0f}", f"{spl:.2f}"])
    success, steps = PAPER_RESULTS["sqn"]["maze"]
    rows.append(["the paper, SQN, on its own maze", f"{success:.2f}", f"{steps:.0f}", ""])
    header = ["Greedy episodes on the maze", "success", "time steps, failures at 400", "SPL"]
    return markdown_table(header, rows)


TABLES = {each.__name__: each for each in (policies, seeds, noise, quick)}


def _one(
    entries: list[Entry],
    agent: str,
    name: str,
    noise: tuple[float, float] = (0.0, 0.0),
    tasks: str = "evaluation points",
) -> Entry:
    wanted = (agent, name, *noise, tasks, RADIUS)
    labels = ("agent", "map", "velocity_noise", "range_noise", "tasks", "goal_radius")
    (entry,) = (each for each in entries if tuple(each[label] for label in labels) == wanted)
    return entry


def _mean(entry: Entry) -> str:
    return f"{entry['success']['mean']:.2f}"


def _success_and_steps(entry: Entry) -> str:
    told = f"{_mean(entry)}, {entry['time_steps']['mean']:.0f}"
    ratio = entry["steps_over_oracle"]
    return told if ratio is None or entry["agent"] == "oracle" else f"{told} ({ratio['mean']:.2f})"


def filled(text: str) -> str:
    """A page with every table as the records have it.

    Raises:
        ValueError: a table is asked for that there is none of, or one has no end.
    """
    begun = re.findall(r"<!-- table (\w+) -->", text)
    for name in begun:
        if name not in TABLES:
            raise ValueError(
                f"table {name}: none of this name, expected one of {', '.join(TABLES)}"
            )
        block = re.compile(rf"(<!-- table {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        parts = block.split(text)
        if len(parts) != 4:
            raise ValueError(f"table {name}: {len(parts) // 3} of them with an end, expected 1")
        text = f"{parts[0]}{parts[1]}{TABLES[name]()}\n{parts[2]}{parts[3]}"
    return text


def main() -> None:
    """Fill in the README."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    page = ROOT / "README.md"
    before = page.read_text(encoding="utf-8")
    after = filled(before)
    if options.check:
        print("README.md says what the records say" if after == before else "README.md differs")
        raise SystemExit(after != before)
    page.write_text(after, encoding="utf-8")
    print(f"filled {len(re.findall(r'<!-- table', after))} tables of README.md")


if __name__ == "__main__":
    run(main)
