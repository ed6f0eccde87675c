"""Results of evaluations on record, and how tables print them."""

from __future__ import annotations

from typing import Any

from experiments.common import recorded

RADIUS = 0.3
"""m, within which a goal counts as reached in the tables."""

Entry = dict[str, Any]


def spread(entry: Entry, metric: str = "success") -> float:
    """Sample standard deviation of the means of the (training seed, evaluation seed) pairs.

    Evaluation files without `std_ddof` hold the standard deviation of the population.
    """
    deviation: float = entry[metric]["std_of_means"]
    count = len(entry["training_seeds"]) * len(entry["eval_seeds"])
    return deviation if entry["std_ddof"] else deviation * float((count / (count - 1)) ** 0.5)


def results_of(name: str) -> list[Entry]:
    """The results of an evaluation on record, each with the `std_ddof` of its file."""
    evaluation = recorded(name)
    return [{**entry, "std_ddof": evaluation.get("std_ddof", 0)} for entry in evaluation["results"]]


def one_of(
    entries: list[Entry],
    agent: str,
    name: str,
    noise: tuple[float, float] = (0.0, 0.0),
    tasks: str = "evaluation points",
) -> Entry:
    """The result of an agent on a map, within `RADIUS`; there must be just one."""
    wanted = (agent, name, *noise, tasks, RADIUS)
    labels = ("agent", "map", "velocity_noise", "range_noise", "tasks", "goal_radius")
    (entry,) = (each for each in entries if tuple(each[label] for label in labels) == wanted)
    return entry


def mean(entry: Entry) -> str:
    """Success."""
    return f"{entry['success']['mean']:.2f}"


def mean_and_spread(entry: Entry) -> str:
    """Success and its spread."""
    return f"{mean(entry)} ± {spread(entry):.2f}"


def steps(entry: Entry) -> str:
    """Mean time steps of an episode."""
    return f"{entry['time_steps']['mean']:.0f}"
