"""Write the tables of the pages from the records: python experiments/readme_tables.py [--check]

Each table stands between `<!-- table NAME -->` and `<!-- end -->` in README.md or a page of
docs/; what is between is replaced. With `--check` nothing is written: the exit code is
1 if a table is not what the records say.

± is the sample standard deviation (n - 1). Records without `std_ddof` hold the population figure,
of which `spread` makes that of the sample.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments import bench_breakdown, bench_learner, bench_simulator, bench_train
from experiments.common import recorded, run
from experiments.entries import Entry, mean, mean_and_spread, one_of, results_of, spread, steps
from experiments.robustness import LEVELS, RANGE_NOISE, VELOCITY_NOISE
from experiments.suite_tables import best, card, external, fresh
from sqn_jax.config.presets import PAPER_MAPS
from sqn_jax.evaluation.paper_results import PAPER_RESULTS
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.statistics import sample_std

ROOT = Path(__file__).resolve().parents[1]
DOCS = ("RESULTS", "LAB_NOTES", "PERFORMANCE", "DEPLOYMENT", "MODEL_CARD")
PAGES = ("README.md", *(f"docs/{name}.md" for name in DOCS))
NAMES = {"sqn": "SQN", "r2d2": "R2D2", "dqn": "DQN"}
ALIKE = {"sqn sqn": "sqn", "r2d2": "r2d2", "dqn": "dqn"}
"""Three agents trained alike, by their names in `pretrained_table.json`, and their algorithms."""
BENCHMARK = "benchmark.json"
PAPER_TASKS = (*((name, "evaluation points") for name in PAPER_MAPS), ("maze", "random pairs"))
STARTS = ("start_smoke.json", "start_evaluate.json", "start_render.json")


def agents() -> str:
    """Three agents trained alike on the Maze, each above the paper's: success and time steps."""
    entries = results_of("pretrained_table.json")
    rows = []
    for agent, algorithm in ALIKE.items():
        ours = [one_of(entries, agent, name) for name in PAPER_MAPS]
        rows.append([NAMES[algorithm], *(f"{mean(each)}, {steps(each)}" for each in ours)])
        rows.append(_paper_row(algorithm))
    return markdown_table(["success, time steps", *PAPER_MAPS], rows)


def policies() -> str:
    """The policies that come with the package, and the baselines: success and time steps."""
    entries = results_of("pretrained_table.json")
    labels = {
        **{agent: f"`pretrained:{algorithm}`" for agent, algorithm in ALIKE.items()},
        **{"sqn best": "`pretrained:best`", "bug": "bug", "oracle": "oracle"},
    }
    rows = [
        [label, *(_in_full(one_of(entries, agent, name)) for name in PAPER_MAPS)]
        for agent, label in labels.items()
    ]
    rows += [_paper_row(algorithm) for algorithm in NAMES]
    return markdown_table(["", *PAPER_MAPS], rows)


def seeds() -> str:
    """Several training seeds of the preset `quick`: mean success and its spread over them."""
    evaluation = recorded("seeds_table.json")
    return f"{_over_seeds(evaluation)}\n\n{_comparisons(evaluation)}"


def paper() -> str:
    """Five training seeds of the preset `paper`."""
    evaluation = recorded("paper_table.json")
    return f"{_over_seeds(evaluation)}\n\n{_comparisons(evaluation)}"


def paper_sqn() -> str:
    """One long run of SQN with the preset `paper`: success and time steps with each epsilon."""
    entries = results_of("paper_sqn_table.json") + results_of("paper_sqn_pairs.json")
    rows = []
    for agent, label in {"sqn": "SQN, epsilon 0", "sqn, epsilon 0.1": "SQN, epsilon 0.1"}.items():
        ours = [one_of(entries, agent, name, tasks=tasks) for name, tasks in PAPER_TASKS]
        rows.append([label, *(f"{mean(each)}, {steps(each)}" for each in ours)])
    rows.append([*_paper_row("sqn"), ""])
    return markdown_table(["success, time steps", *PAPER_MAPS, "maze, random pairs"], rows)


def paper_half() -> str:
    """One seed of each agent halfway through `paper`: success with each epsilon and parameters."""
    rows = []
    for algorithm, label in NAMES.items():
        for params in ("latest", "target"):
            entries = results_of(f"paper_half_{params}.json")
            entries += results_of(f"paper_half_pairs_{params}.json")
            names = [algorithm, *(f"{algorithm}, epsilon {epsilon}" for epsilon in (0.05, 0.1))]
            cells = [
                " / ".join(mean(one_of(entries, agent, name, tasks=tasks)) for agent in names)
                for name, tasks in PAPER_TASKS
            ]
            rows.append([f"{label}, {params}", *cells])
        results = [f"{PAPER_RESULTS[algorithm][name][0]:.2f}" for name in PAPER_MAPS]
        rows.append([f"{label} in the paper", *results, ""])
    header = ["epsilon 0 / 0.05 / 0.1", *PAPER_MAPS, "maze, random pairs"]
    return markdown_table(header, rows)


def dead_ends() -> str:
    """Agents trained on the Maze and twelve caves: success of each training seed."""
    entries = results_of("caves_horizon_table.json")
    rows = []
    for agent, label in NAMES.items():
        scores = [one_of(entries, agent, name)["success_per_seed"] for name in ("maze", "cave")]
        rows.append([label, *(", ".join(f"{score:.3f}" for score in each) for each in scores)])
    return markdown_table(["", "maze", "cave"], rows)


def noise() -> str:
    """Success in the maze under the paper's noise."""
    three = results_of("pretrained_noise.json")
    best = results_of("best_noise.json")
    header = ["", "none", *(f"velocity {level:g}" for level in VELOCITY_NOISE)]
    header += [f"range {100 * level:.0f} %" for level in RANGE_NOISE]
    rows = [
        [label, *(mean(one_of(entries, agent, "maze", noise=level)) for level in LEVELS)]
        for label, entries, agent in (
            *((f"`pretrained:{agent}`", three, agent) for agent in NAMES),
            ("`pretrained:best`", best, "sqn"),
            ("SQN of `paper`", results_of("paper_sqn_noise.json"), "sqn"),
        )
    ]
    return markdown_table(header, rows)


def quick() -> str:
    """The run of `make train`, evaluated with more episodes."""
    entries = results_of("maze_quick_500.json")
    labels = {
        "random pairs": "random pairs of spawn points",
        "evaluation points": "the four evaluation points",
    }
    rows = []
    for tasks, label in labels.items():
        entry = one_of(entries, "sqn", "maze", tasks=tasks)
        spl = f"{entry['spl']['mean']:.2f} ± {spread(entry, 'spl'):.2f}"
        rows.append([label, mean_and_spread(entry), steps(entry), spl])
    return markdown_table(["500 greedy episodes on the maze", "success", "steps", "SPL"], rows)


def sensors() -> str:
    """`pretrained:best` with other sensors than it was trained with: success and refused moves."""
    results = recorded("deployment.json")["results"]
    tasks = list(dict.fromkeys(entry["tasks"] for entry in results))
    names = list(dict.fromkeys(entry["sensor"] for entry in results))
    found = {(entry["sensor"], entry["tasks"]): entry for entry in results}
    rows = [
        [name, *(_with_collisions(found[name, each]) for each in tasks if (name, each) in found)]
        for name in names
    ]
    return markdown_table(["success, refused moves an episode", *tasks], rows)


def _with_collisions(entry: Entry) -> str:
    return f"{entry['success']:.2f}, {entry['collisions']:.1f}"


def simulator() -> str:
    """Steps a second with both cores; JaxNav without its reset in every step."""
    programs = [f"{name}, 2 devices" for name in ("sqn_jax, maze", "sqn_jax, cave", "JaxNav")]
    entries = recorded(BENCHMARK)["simulator"]
    return bench_simulator.table([entry for entry in entries if entry["program"] in programs])


def breakdown() -> str:
    """Where the time of a step goes."""
    return bench_breakdown.table(recorded(BENCHMARK)["breakdown"])


def training() -> str:
    """The whole training program."""
    return bench_train.table(recorded(BENCHMARK)["train"])


def learner() -> str:
    """R2D2 updates of the preset `paper`, with both cores."""
    results = recorded(BENCHMARK)["learner"]
    programs = ("JAX, 2 devices", "PyTorch, 2 threads")
    updates = [entry for entry in results["updates"] if entry["program"] in programs]
    return bench_learner.table({**results, "updates": updates})


def starts() -> str:
    """Seconds of commands, and where they go when all programs have been compiled before."""
    rows = []
    for name in STARTS:
        record = recorded(name)
        parts = [f"{kind} {seconds:.1f}" for kind, seconds in record["warm"]["seconds"].items()]
        rows.append(
            [
                f"`sqn {' '.join(record['command'])}`",
                *(f"{record[each]['whole']:.1f}" for each in ("cold", "warm")),
                ", ".join(parts[:5]),
            ]
        )
    header = ["command", "first time, s", "later, s", "of the latter"]
    return markdown_table(header, rows)


TABLES = {
    each.__name__: each
    for each in (
        *(agents, policies, quick, seeds, paper, paper_sqn, paper_half, dead_ends, noise),
        *(external, fresh, best, card),
        *(sensors, simulator, breakdown, training, learner, starts),
    )
}


def _over_seeds(evaluation: dict[str, Any]) -> str:
    """Mean success of the training seeds on each map, and its spread over them."""
    entries = evaluation["results"]
    maps = list(dict.fromkeys(entry["map"] for entry in entries))
    rows = []
    for agent in dict.fromkeys(entry["agent"] for entry in entries):
        scores = [one_of(entries, agent, name)["success_per_seed"] for name in maps]
        count = f"{len(scores[0])} seed" + "s" * (len(scores[0]) > 1)
        rows.append([f"{NAMES[agent]}, {count}", *(_over(each) for each in scores)])
    return markdown_table(["", *maps], rows)


def _over(scores: Sequence[float]) -> str:
    deviation = sample_std(scores)
    text = f"{sum(scores) / len(scores):.2f}"
    return text if deviation is None else f"{text} ± {deviation:.2f}"


def _comparisons(evaluation: dict[str, Any]) -> str:
    agents = list(dict.fromkeys(entry["agent"] for entry in evaluation["results"]))
    lines = []
    for comparison in evaluation["comparisons"]:
        first, second = comparison["first"], comparison["second"]
        if agents.index(first) < agents.index(second):
            low, high = comparison["ci95"]
            lines.append(
                f"{NAMES[first]} beats {NAMES[second]} with probability "
                f"{comparison['probability']:.2f} [{low:.2f}, {high:.2f}]."
            )
    return "\n".join(lines)


def _in_full(entry: Entry) -> str:
    """Success, time steps, and in brackets the steps of the successes over the oracle's."""
    text = f"{mean_and_spread(entry)}, {steps(entry)}"
    ratio = entry["steps_over_oracle"]
    return text if ratio is None or entry["agent"] == "oracle" else f"{text} ({ratio['mean']:.2f})"


def _paper_row(algorithm: str) -> list[str]:
    results = [PAPER_RESULTS[algorithm][name] for name in PAPER_MAPS]
    cells = [f"{success:.2f}, {steps:.0f}" for success, steps in results]
    return [f"{NAMES[algorithm]} in the paper", *cells]


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
    """Fill in the pages."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    differing = []
    for name in PAGES:
        page = ROOT / name
        before = page.read_text(encoding="utf-8")
        after = filled(before)
        if after != before:
            differing.append(name)
            if not options.check:
                page.write_text(after, encoding="utf-8")
    if options.check:
        print(f"differ: {', '.join(differing)}" if differing else "every table is as on record")
        raise SystemExit(bool(differing))
    print(f"written: {', '.join(differing)}" if differing else "every table was as on record")


if __name__ == "__main__":
    run(main)
