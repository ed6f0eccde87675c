"""From driven episodes to numbers: statistics of an evaluation, one record an episode, a table.

NumPy on the host; knows nothing of how the episodes came about.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sqn_jax.evaluation.statistics import (
    bootstrap_interval,
    interquartile_mean,
    probability_of_improvement,
    sample_std,
    stratified_bootstrap,
    success_weighted_path_length,
    wilson_interval,
)
from sqn_jax.training.rollout import EpisodeSummary

SCHEMA = 2
"""Of the evaluation file: 2 has sample standard deviations, 1 had the population's."""


@dataclass(frozen=True)
class Outcome:
    """The episodes of one training seed under one evaluation seed, E of them."""

    training_seed: int | None
    """None for a navigator that was not trained."""
    eval_seed: int
    summary: EpisodeSummary
    """Arrays [E]."""
    starts: NDArray[np.floating]
    """[E, 3] x m, y m, heading rad."""
    goals: NDArray[np.floating]
    """[E, 2] m."""
    shortest: NDArray[np.floating] | None = None
    """[E] m, length of the shortest way from start to goal; None where it was not worked out."""

    @cached_property
    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """Every number of an episode by the name it has in the files, [E] each."""
        summary = self.summary
        named: dict[str, ArrayLike] = {
            "success": summary.success,
            "time_steps": summary.time_steps,
            "mean_reward": summary.mean_reward,
            "collisions": summary.collisions,
            "coverage_m2": summary.covered_area,
            "path_length_m": summary.path_length,
        }
        if self.shortest is not None:
            named["spl"] = success_weighted_path_length(
                summary.success, summary.path_length, self.shortest
            )
        return {name: np.asarray(values, np.float64) for name, values in named.items()}


def describe(
    outcomes: Sequence[Outcome], oracle: Sequence[Outcome] | None = None
) -> dict[str, Any]:
    """Statistics over all episodes of an agent in one world, ready for JSON.

    Args:
        outcomes: one for each training seed and evaluation seed, of equally many episodes.
        oracle: those of the oracle on the same tasks, one for each evaluation seed.

    Returns:
        `success`, `time_steps` (failures at the limit), `time_steps_success` (None without a
        success), `steps_over_oracle` (of each success over the oracle's in the same task; None
        without), `spl` (None where no shortest ways are known), `mean_reward`, `collisions`,
        `coverage_m2`: each with the `mean`, the `std` over episodes, a 95 % interval `ci95` over
        episodes (Wilson for `success`, bootstrap for the others) and `std_of_means`, that of the
        means of the (training seed, evaluation seed) pairs: for one training seed what the paper
        gives. Both are sample standard deviations (n - 1), None for a single value.
        With several training seeds also `iqm` and `iqm_ci95`, the interquartile mean over them;
        the intervals over episodes say nothing of how much training seeds differ.
    """
    metrics = [outcome.metrics for outcome in outcomes]
    result: dict[str, Any] = {}
    names = ("success", "time_steps", "spl", "mean_reward", "collisions", "coverage_m2")
    for name in names:
        values = [metric[name] for metric in metrics if name in metric]
        result[name] = _describe(name, values, outcomes) if len(values) == len(metrics) else None
    steps = [metric["time_steps"][metric["success"] > 0] for metric in metrics]
    result["time_steps_success"] = _over_episodes(np.concatenate(steps))
    result["steps_over_oracle"] = _over_episodes(_steps_over_oracle(outcomes, oracle or []))
    result["success_per_seed"] = _of_each_seed("success", outcomes)
    return result


def _steps_over_oracle(
    outcomes: Sequence[Outcome], oracle: Sequence[Outcome]
) -> NDArray[np.float64]:
    """Steps over the oracle's, of every task in which both arrive."""
    same = {each.eval_seed: each for each in oracle}
    ratios = [np.empty(0)]
    for outcome in (outcome for outcome in outcomes if outcome.eval_seed in same):
        ours, theirs = outcome.metrics, same[outcome.eval_seed].metrics
        both = (ours["success"] > 0) & (theirs["success"] > 0)
        ratios.append(ours["time_steps"][both] / theirs["time_steps"][both])
    return np.concatenate(ratios)


def _describe(
    name: str, values: list[NDArray[np.float64]], outcomes: Sequence[Outcome]
) -> dict[str, Any]:
    joined = np.concatenate(values)
    told = _over_episodes(joined)
    assert told is not None
    if name == "success":
        told["ci95"] = list(wilson_interval(int(joined.sum()), joined.size))
    told["std_of_means"] = sample_std([value.mean() for value in values])
    scores = _of_each_seed(name, outcomes)
    if len(scores) > 1:
        told["iqm"] = interquartile_mean(scores)
        told["iqm_ci95"] = list(stratified_bootstrap([scores], interquartile_mean))
    return told


def _of_each_seed(name: str, outcomes: Sequence[Outcome]) -> list[float]:
    """Mean of a metric over all episodes of each training seed."""
    by_seed: dict[int | None, list[NDArray[np.float64]]] = {}
    for outcome in outcomes:
        by_seed.setdefault(outcome.training_seed, []).append(outcome.metrics[name])
    return [float(np.concatenate(values).mean()) for values in by_seed.values()]


def _over_episodes(values: NDArray[np.float64]) -> dict[str, Any] | None:
    if values.size == 0:
        return None
    return {
        "mean": float(values.mean()),
        "std": sample_std(values),
        "ci95": list(bootstrap_interval(values)),
    }


def improvement(ours: Sequence[Sequence[Outcome]], theirs: Sequence[Sequence[Outcome]]) -> Any:
    """Probability that a training run of ours has more success than one of theirs.

    Args:
        ours: for each task (map) the outcomes of an agent, of the same training seeds.
        theirs: the same for another agent.

    Returns:
        `probability` and its `ci95` over training seeds; None unless both agents have several.
    """
    tables = [
        np.array([_of_each_seed("success", task) for task in agent]).T for agent in (ours, theirs)
    ]
    if any(len(table) < 2 for table in tables):
        return None
    return {
        "probability": probability_of_improvement(*tables),
        "ci95": list(stratified_bootstrap(tables, probability_of_improvement)),
    }


def records(outcomes: Sequence[Outcome], **labels: Any) -> Iterator[dict[str, Any]]:
    """One flat object an episode, ready for JSON lines."""
    for outcome in outcomes:
        metrics = outcome.metrics
        for episode in range(len(outcome.goals)):
            yield {
                **labels,
                "training_seed": outcome.training_seed,
                "eval_seed": outcome.eval_seed,
                "episode": episode,
                "start": [float(x) for x in outcome.starts[episode]],
                "goal": [float(x) for x in outcome.goals[episode]],
                "success": bool(metrics["success"][episode]),
                "time_steps": int(metrics["time_steps"][episode]),
                "collisions": int(metrics["collisions"][episode]),
                **{
                    name: float(values[episode])
                    for name, values in metrics.items()
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
    """The results of an evaluation file as a Markdown table, one row an agent and world.

    The first goal radius in the file is the one shown; further ones appear as a column of success.
    """
    radii = list(dict.fromkeys(entry["goal_radius"] for entry in results))
    header = ["map", "agent", "noise", *(f"success {radius:g} m" for radius in radii)]
    header += ["steps", "steps (reached)", "over oracle", "SPL", "collisions", "reward"]
    rows = []
    for entry in (entry for entry in results if entry["goal_radius"] == radii[0]):
        same = [other for other in results if _world_of(other) == _world_of(entry)]
        successes = [f"{other['success']['mean']:.2f}" for other in same]
        if (spread := entry["success"]["std_of_means"]) is not None:
            successes[0] += f" ± {spread:.2f}"
        tasks = "" if entry["tasks"] == "evaluation points" else f" ({entry['tasks']})"
        cells = [entry["map"] + tasks, entry["agent"], _noise_of(entry), *successes]
        shown = (("time_steps", 1), ("time_steps_success", 1), ("steps_over_oracle", 2), ("spl", 2))
        for name, digits in shown:
            told = entry.get(name)
            cells.append("-" if told is None else f"{told['mean']:.{digits}f}")
        cells += [f"{entry['collisions']['mean']:.1f}", f"{entry['mean_reward']['mean']:.2f}"]
        rows.append(cells)
    return markdown_table(header, rows)


def _world_of(entry: dict[str, Any]) -> tuple[Any, ...]:
    names = ("map", "agent", "tasks", "velocity_noise", "range_noise")
    return tuple(entry[name] for name in names)


def _noise_of(entry: dict[str, Any]) -> str:
    parts = [
        f"{name} {entry[f'{name}_noise']:g}"
        for name in ("velocity", "range")
        if entry[f"{name}_noise"] > 0
    ]
    return ", ".join(parts) or "none"
