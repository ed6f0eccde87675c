"""How many training seeds show a difference: python experiments/power.py --out FILE.json

From the spread of the seeds on record: SPL between random pairs of the maze of SQN and R2D2 with
the preset `quick`, paired by seed. The power is that of the paired t-test, two-sided at 5 %; the
permutation test that is used comes close to it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from experiments.arm_statistics import LEVEL, RELEVANT
from experiments.common import recorded, run
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.statistics import sample_std
from sqn_jax.storage.files import write_json

FILES = (
    *("seeds_runs.json", "pretrained_runs.json", "quick_pair.json"),
    *("quick_seeds_runs.json", "table_quick_runs.json"),
)
"""Records of runs of `quick`; some at an earlier length, and without advantage learning."""
SEEDS = (3, 5, 6, 8, 10, 12, 15, 20)


def runs_on_record(files: Iterable[str] = FILES) -> list[dict[str, Any]]:
    """Each run of `quick` on record: file, agent, seed, episodes, SPL between random pairs."""
    return [
        {
            "file": name,
            "algo": each["config"]["algo"],
            "seed": each["config"]["seed"],
            "episodes": each["config"]["total_episodes"],
            "advantage_learning": each["config"]["learner"].get("advantage_learning", 0.0),
            "spl": entry["spl"]["mean"],
        }
        for name in files
        for each in recorded(name)["runs"]
        for entry in each["evaluation"]
        if (entry["map"], entry["tasks"]) == ("maze", "random pairs")
    ]


def paired_differences(runs: Sequence[Mapping[str, Any]]) -> list[float]:
    """SPL of SQN minus that of R2D2 for each file and seed that has both, trained alike."""
    settings = ("file", "seed", "episodes", "advantage_learning")
    by_agent: dict[str, dict[Any, float]] = {"sqn": {}, "r2d2": {}}
    for each in runs:
        if each["algo"] in by_agent:
            by_agent[each["algo"]][tuple(each[name] for name in settings)] = each["spl"]
    theirs = by_agent["r2d2"]
    return [spl - theirs[key] for key, spl in by_agent["sqn"].items() if key in theirs]


def power(difference: float, spread: float, num_seeds: int, level: float = LEVEL) -> float:
    """Probability that a paired t-test of n seeds shows a difference that is there.

    Args:
        difference: the true mean of the differences.
        spread: their standard deviation.
        num_seeds: n, at least 2.
        level: of significance, two-sided.
    """
    from scipy import stats

    freedom, noncentrality = num_seeds - 1, difference / spread * num_seeds**0.5
    critical = stats.t.ppf(1 - level / 2, freedom)
    above = stats.nct.sf(critical, freedom, noncentrality)
    return float(above + stats.nct.cdf(-critical, freedom, noncentrality))


def spread_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of the standard deviation of normal values [n], by the chi-squared distribution."""
    from scipy import stats

    array = np.asarray(values, np.float64)
    freedom = array.size - 1
    tails = stats.chi2.ppf([(1 + confidence) / 2, (1 - confidence) / 2], freedom)
    low, high = np.sqrt(freedom * array.var(ddof=1) / tails)
    return float(low), float(high)


def main() -> None:
    """Print the table and write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    runs = runs_on_record()
    differences = paired_differences(runs)
    spread = sample_std(differences)
    assert spread is not None, "several pairs are on record"
    noticed = float(np.mean(differences))
    spreads = {"spread": spread, "upper end": spread_interval(differences)[1]}
    table = [
        {"spread": value, "seeds": seeds, "difference": difference}
        | {"power": power(difference, value, seeds)}
        for value in spreads.values()
        for seeds in SEEDS
        for difference in (RELEVANT, noticed)
    ]
    write_json(
        options.out,
        {
            "runs": runs,
            "differences": differences,
            "mean": noticed,
            "spread": spread,
            "spread_ci95": list(spread_interval(differences)),
            "power": table,
        },
    )
    print(f"SQN minus R2D2 in {len(differences)} pairs: {noticed:+.3f}, spread {spread:.3f}")
    digits = {"spread": 3, "seeds": 0, "difference": 3, "power": 2}
    rows = [[f"{row[name]:.{count}f}" for name, count in digits.items()] for row in table]
    print(markdown_table(list(digits), rows))


if __name__ == "__main__":
    run(main)
