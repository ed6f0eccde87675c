"""Statistics of batches of episodes, records of single episodes, and the table of results.

NumPy on the host.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sqn_jax.evaluation.agents import EpisodeBatch
from sqn_jax.evaluation.statistics import (
    clustered_interval,
    interquartile_mean,
    probability_of_improvement,
    sample_std,
    stratified_bootstrap,
)
from sqn_jax.outside.messages import shown


def describe(
    batches: Sequence[EpisodeBatch],
    goal_radius: float,
    oracle: Sequence[EpisodeBatch] | None = None,
) -> dict[str, Any]:
    """Statistics over all episodes of an agent in one world, ready for JSON.

    Args:
        batches: one for each training seed and evaluation seed, of equally many episodes.
        goal_radius: m, within which the goal is reached.
        oracle: batches of the oracle on the same tasks, one for each evaluation seed.

    Returns:
        `success`, `time_steps` (failures count the limit), `time_steps_success` (None without a
        success), `steps_over_oracle` (steps of a success, divided by the oracle's in the same task;
        None without a success or without an oracle), `spl` (None where shortest paths are unknown),
        `mean_reward`, `collisions`, `coverage_m2`. Each has the `mean`, the `std` over episodes, a
        95 % interval `ci95` of the mean, and `std_of_means` over the means of the (training seed,
        evaluation seed) pairs; for one training seed this is the spread in the paper. Both are
        sample standard deviations (n - 1), None for a single value. The interval resamples training
        seeds, pairs of points of the map, and tasks between the same two (`clustered_interval`);
        `ci95_over` says whether there are several training seeds. If there is one, the interval is
        over tasks only. With several there are also `iqm` and `iqm_ci95`, the interquartile mean
        over them.
    """
    metrics = [batch.numbers(goal_radius) for batch in batches]
    result: dict[str, Any] = {}
    names = ("success", "time_steps", "spl", "mean_reward", "collisions", "coverage_m2")
    for name in names:
        values = [metric[name] for metric in metrics if name in metric]
        is_known = len(values) == len(metrics)
        result[name] = _describe(name, values, batches, goal_radius) if is_known else None
    steps = [np.where(metric["success"] > 0, metric["time_steps"], np.nan) for metric in metrics]
    result["time_steps_success"] = _over_tasks(steps, batches)
    ratios = _steps_over_oracle(batches, goal_radius, oracle or [])
    result["steps_over_oracle"] = _over_tasks(ratios, batches)
    result["success_per_seed"] = _of_each_seed("success", batches, goal_radius)
    has_seeds = len(result["success_per_seed"]) > 1
    result["ci95_over"] = "training seeds and tasks" if has_seeds else "tasks"
    return result


def _steps_over_oracle(
    batches: Sequence[EpisodeBatch], goal_radius: float, oracle: Sequence[EpisodeBatch]
) -> list[NDArray[np.float64]]:
    """Steps divided by the oracle's; NaN for every task in which one of them misses the goal."""
    oracle_batches = {batch.eval_seed: batch for batch in oracle}
    ratios = []
    for batch in batches:
        ours = batch.numbers(goal_radius)
        ratio = np.full_like(ours["time_steps"], np.nan)
        if batch.eval_seed in oracle_batches:
            theirs = oracle_batches[batch.eval_seed].numbers(goal_radius)
            reached = (ours["success"] > 0) & (theirs["success"] > 0)
            ratio[reached] = ours["time_steps"][reached] / theirs["time_steps"][reached]
        ratios.append(ratio)
    return ratios


def _describe(
    name: str,
    values: list[NDArray[np.float64]],
    batches: Sequence[EpisodeBatch],
    goal_radius: float,
) -> dict[str, Any]:
    description = _over_tasks(values, batches, is_rate=name == "success")
    assert description is not None
    description["std_of_means"] = sample_std([value.mean() for value in values])
    scores = _of_each_seed(name, batches, goal_radius)
    if len(scores) > 1:
        description["iqm"] = interquartile_mean(scores)
        description["iqm_ci95"] = list(stratified_bootstrap([scores], interquartile_mean))
    return description


def _of_each_seed(name: str, batches: Sequence[EpisodeBatch], goal_radius: float) -> list[float]:
    """Mean of a metric over all episodes of each training seed."""
    by_seed: dict[int | None, list[NDArray[np.float64]]] = {}
    for batch in batches:
        by_seed.setdefault(batch.training_seed, []).append(batch.numbers(goal_radius)[name])
    return [float(np.concatenate(values).mean()) for values in by_seed.values()]


def _over_tasks(
    values: Sequence[NDArray[np.float64]],
    batches: Sequence[EpisodeBatch],
    *,
    is_rate: bool = False,
) -> dict[str, Any] | None:
    """Mean, spread and interval of a metric [E] of each batch, NaN left out; None without any."""
    known = np.concatenate([value[~np.isnan(value)] for value in values])
    if known.size == 0:
        return None
    training_seeds = list(dict.fromkeys(batch.training_seed for batch in batches))
    eval_seeds = list(dict.fromkeys(batch.eval_seed for batch in batches))
    table = np.full((len(training_seeds), len(eval_seeds), len(values[0])), np.nan)
    routes = np.empty(table.shape[1:], np.int64)
    for value, batch in zip(values, batches, strict=True):
        column = eval_seeds.index(batch.eval_seed)
        table[training_seeds.index(batch.training_seed), column] = value
        routes[column] = batch.routes
    interval = clustered_interval(
        table.reshape(len(training_seeds), -1), is_rate=is_rate, clusters=routes.reshape(-1)
    )
    return {"mean": float(known.mean()), "std": sample_std(known), "ci95": list(interval)}


def improvement(
    ours: Sequence[Sequence[EpisodeBatch]],
    theirs: Sequence[Sequence[EpisodeBatch]],
    goal_radius: float,
) -> Any:
    """Probability that a training run of one agent has more success than one of another.

    Args:
        ours: for each task (map) the batches of one agent; its training seeds are the same in all.
        theirs: the same for the other agent.
        goal_radius: m, within which the goal is reached.

    Returns:
        `probability` and its `ci95` over training seeds; None unless both agents have several.
    """
    tables = [
        np.array([_of_each_seed("success", task, goal_radius) for task in agent]).T
        for agent in (ours, theirs)
    ]
    if any(len(table) < 2 for table in tables):
        return None
    return {
        "probability": probability_of_improvement(*tables),
        "ci95": list(stratified_bootstrap(tables, probability_of_improvement)),
    }


def records(
    batches: Sequence[EpisodeBatch], goal_radius: float, /, **labels: Any
) -> Iterator[dict[str, Any]]:
    """One flat object per episode, ready for JSON lines."""
    for batch in batches:
        numbers = batch.numbers(goal_radius)
        for episode in range(len(batch.goals)):
            yield {
                **labels,
                "training_seed": batch.training_seed,
                "eval_seed": batch.eval_seed,
                "episode": episode,
                "start": [float(x) for x in batch.starts[episode]],
                "goal": [float(x) for x in batch.goals[episode]],
                "success": bool(numbers["success"][episode]),
                "time_steps": int(numbers["time_steps"][episode]),
                "collisions": int(numbers["collisions"][episode]),
                **{
                    name: float(values[episode])
                    for name, values in numbers.items()
                    if name not in ("success", "time_steps", "collisions")
                },
            }


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with aligned columns."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = (cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
        return "| " + " | ".join(padded) + " |"

    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return "\n".join([line(header), rule, *map(line, rows)])


def results_table(results: Sequence[dict[str, Any]]) -> str:
    """The results of an evaluation file as a Markdown table: one row for each agent and world.

    Numbers are for the first goal radius in the file; further radii have a column of success each.
    """
    radii = list(dict.fromkeys(entry["goal_radius"] for entry in results))
    header = ["map", "agent", "noise", *(f"success {radius:g} m" for radius in radii)]
    header += ["steps", "steps (reached)", "steps / oracle steps", "SPL", "collisions", "reward"]
    rows = []
    for entry in (entry for entry in results if entry["goal_radius"] == radii[0]):
        same_row = [other for other in results if _row_of(other) == _row_of(entry)]
        successes = [f"{other['success']['mean']:.2f}" for other in same_row]
        if (spread := entry["success"]["std_of_means"]) is not None:
            successes[0] += f" ± {spread:.2f}"
        tasks = "" if entry["tasks"] == "evaluation points" else f" ({entry['tasks']})"
        cells = [shown(entry["map"]) + tasks, shown(entry["agent"]), _noise_of(entry), *successes]
        columns = {"time_steps": 1, "time_steps_success": 1, "steps_over_oracle": 2, "spl": 2}
        for name, digits in columns.items():
            metric = entry.get(name)
            cells.append("-" if metric is None else f"{metric['mean']:.{digits}f}")
        cells += [f"{entry['collisions']['mean']:.1f}", f"{entry['mean_reward']['mean']:.2f}"]
        rows.append(cells)
    return markdown_table(header, rows)


def table_note(results: Sequence[dict[str, Any]]) -> str:
    """What the ± of `results_table`, if there is one, and the intervals of the file are over."""
    several = any(len(entry["training_seeds"]) > 1 for entry in results)
    spread = "±: over the means of the evaluation seeds"
    intervals = "95 % intervals (file): over tasks only, one training seed"
    if several:
        spread += " of each training seed"
        intervals = (
            "95 % intervals (file): over training seeds and tasks, of an agent with one training "
            "seed over tasks only"
        )
    has_spread = any(entry["success"]["std_of_means"] is not None for entry in results)
    return f"{spread}; {intervals}" if has_spread else intervals


def _row_of(entry: dict[str, Any]) -> tuple[Any, ...]:
    """Agent and world of an entry: what its row in the table stands for."""
    names = ("map", "agent", "tasks", "velocity_noise", "range_noise")
    return tuple(entry[name] for name in names)


def _noise_of(entry: dict[str, Any]) -> str:
    parts = [
        f"{name} {entry[f'{name}_noise']:g}"
        for name in ("velocity", "range")
        if entry[f"{name}_noise"] > 0
    ]
    return ", ".join(parts) or "none"
