"""Arms of training runs beside each other: what counts is how their training seeds differ.

A training seed gives one number, its mean over all episodes; arms are compared seed by seed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.statistics import paired_comparison, seed_interval

Scores = dict[str, list[dict[str, Any]]]
"""By arm, rows with `seed`, `map`, `tasks`, `epsilon`, `spl`, `success`, `time_steps`."""

PRIMARY = "spl"
RELEVANT = 0.02
"""The smallest difference in SPL that counts."""
LEVEL = 0.05
FEWEST_SEEDS = 6
"""With fewer pairs no permutation test reaches the level: of five the least p-value is 2 / 32."""


def paired_by_seed(first: Mapping[int, float], second: Mapping[int, float]) -> dict[str, Any]:
    """Compare two arms on the seeds that both have.

    Returns:
        `seeds`; `difference`, the mean of first - second; its `ci95` (Student's); `p_value`, of the
        permutation test that exchanges the arms seed by seed, exact up to 13 seeds; all None where
        there are too few seeds.
    """
    seeds = sorted(set(first) & set(second))
    if not seeds:
        return {"seeds": seeds, "difference": None, "ci95": None, "p_value": None}
    ours, theirs = (np.array([arm[seed] for seed in seeds]) for arm in (first, second))
    compared = paired_comparison(ours, theirs)
    interval = seed_interval(ours - theirs)
    return {
        "seeds": seeds,
        "difference": compared["difference"],
        "ci95": None if interval is None else list(interval),
        "p_value": compared["p_value"],
    }


def verdict(comparison: Mapping[str, Any], least_difference: float = 0.0) -> str:
    """What a comparison says, by the rule that was stated beforehand: yes, no or undecided.

    "yes": significantly more, maybe by `RELEVANT` or more, and by `least_difference` or more on
    average. "no": the interval leaves no room for `RELEVANT`. Else undecided, as it is with fewer
    than `FEWEST_SEEDS`.
    """
    if len(comparison["seeds"]) < FEWEST_SEEDS:
        return "undecided"
    if comparison["ci95"][1] < RELEVANT:
        return "no"
    difference = comparison["difference"]
    is_more = difference > 0 and comparison["p_value"] < LEVEL
    return "yes" if is_more and difference >= least_difference else "undecided"


def comparison_line(compared: Mapping[str, Any]) -> str:
    """A comparison in a line: arms, difference, interval, p-value, and its verdict, if any."""
    first, second = compared["arms"]
    line = f"{first} minus {second}, {len(compared['seeds'])} seeds of both"
    if compared["difference"] is not None:
        described = {"mean": compared["difference"], "ci95": compared["ci95"]}
        line += f": SPL {_cell(described, sign='+')}"
    if compared["p_value"] is not None:
        line += f", p {_p(compared['p_value'])}"
    return f"{line}: {compared['verdict']}" if "verdict" in compared else line


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for their number (Holm 1979): ascending, each times those that are left."""
    order = np.argsort(p_values, kind="stable")
    left = len(p_values) - np.arange(len(p_values))
    adjusted = np.maximum.accumulate(np.minimum(1, np.asarray(p_values, np.float64)[order] * left))
    result = np.empty(len(p_values))
    result[order] = adjusted
    return [float(value) for value in result]


def by_seed(rows: Iterable[Mapping[str, Any]], metric: str, **selected: Any) -> dict[int, float]:
    """Mean of a metric for each training seed over the rows of some maps, tasks and epsilon.

    Args:
        rows: of one arm.
        metric: `spl`, `success` or `time_steps`.
        selected: by column, a value or a tuple of values.
    """
    values: dict[int, list[float]] = {}
    for row in rows:
        if all(_is_one_of(row[column], wanted) for column, wanted in selected.items()):
            values.setdefault(row["seed"], []).append(row[metric])
    return {seed: float(np.mean(of_seed)) for seed, of_seed in values.items()}


def _is_one_of(value: Any, wanted: Any) -> bool:
    return value in wanted if isinstance(wanted, tuple) else value == wanted


def _groups(
    rows: Sequence[Mapping[str, Any]], primary: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Maps that are judged together: first the primary ones, procedural ones of a kind, others."""
    groups: dict[str, tuple[str, ...]] = {}
    for name in dict.fromkeys(row["map"] for row in rows):
        kind, _, number = name.partition(":")
        group = f"{kind}s unseen" if number else name
        groups[group] = (*groups.get(group, ()), name)
    if not primary:
        return groups
    alike = [group for group, maps in groups.items() if set(maps) == set(primary)]
    deciding = alike[0] if alike else "maps that decide"
    return {deciding: tuple(primary), **groups}


def arm_results(
    scores: Scores, *, reference: str, primary: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Each arm on each group of maps: both metrics over training seeds, and beside the reference.

    Args:
        scores: of all arms, evaluated alike.
        reference: the arm that the others are compared with.
        primary: the maps that decide; several of them are also judged together.

    Returns:
        An entry for each group of maps, tasks, epsilon and arm: `spl` and `success`, `mean` and
        `ci95` of the seeds' means, `seeds`; of the others `difference`, `p_value`, and `p_holm`
        adjusted for the number of arms. First come the random pairs on the maps that decide, or on
        the first map.
    """
    rows = next(iter(scores.values()))
    tasks = sorted({row["tasks"] for row in rows}, reverse=True)  # Random pairs first.
    epsilons = sorted({row["epsilon"] for row in rows})
    results: list[dict[str, Any]] = []
    for group, maps in _groups(rows, primary).items():
        for kind in tasks:
            for epsilon in epsilons:
                selected = {"map": maps, "tasks": kind, "epsilon": epsilon}
                entries = [
                    {"maps": group, "tasks": kind, "epsilon": epsilon, "arm": arm}
                    | _described(scores, arm, reference, selected)
                    for arm in scores
                ]
                tested = [entry for entry in entries if entry["p_value"] is not None]
                adjusted = holm([entry["p_value"] for entry in tested])
                for entry, value in zip(tested, adjusted, strict=True):
                    entry["p_holm"] = value
                results += entries
    return results


def _described(
    scores: Scores, arm: str, reference: str, selected: Mapping[str, Any]
) -> dict[str, Any]:
    entry: dict[str, Any] = {}
    for metric in ("spl", "success"):
        values = by_seed(scores[arm], metric, **selected)
        interval = seed_interval(list(values.values()))
        mean = float(np.mean(list(values.values())))
        entry[metric] = {"mean": mean, "ci95": None if interval is None else list(interval)}
        entry["seeds"] = sorted(values)
    compared: dict[str, Any] = {"difference": None, "ci95": None, "p_value": None}
    if arm != reference and reference in scores:
        pair = (by_seed(scores[each], PRIMARY, **selected) for each in (arm, reference))
        compared = paired_by_seed(*pair)
    names = {"difference": "difference", "ci95": "difference_ci95", "p_value": "p_value"}
    return entry | {new: compared[old] for old, new in names.items()} | {"p_holm": None}


def arms_table(results: Sequence[Mapping[str, Any]]) -> str:
    """The results as a table, a row for each arm on each group of maps."""
    header = ["maps", "tasks", "arm", "seeds", "SPL", "success", "SPL minus SQN's", "p", "p (Holm)"]
    lines = []
    for entry in results:
        place = entry["maps"] + (f", epsilon {entry['epsilon']:g}" if entry["epsilon"] else "")
        difference = {"mean": entry["difference"], "ci95": entry["difference_ci95"]}
        cells = [_cell(entry["spl"]), _cell(entry["success"]), _cell(difference, sign="+")]
        cells += [_p(entry["p_value"]), _p(entry["p_holm"])]
        lines.append([place, entry["tasks"], entry["arm"], str(len(entry["seeds"])), *cells])
    return markdown_table(header, lines)


def _cell(described: Mapping[str, Any], sign: str = "") -> str:
    mean, interval = described["mean"], described["ci95"]
    if mean is None:
        return ""
    shown = f"{mean:{sign}.3f}"
    if interval is None:
        return shown
    return f"{shown} [{interval[0]:{sign}.3f}, {interval[1]:{sign}.3f}]"


def _p(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
