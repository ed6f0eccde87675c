"""What agents reached on a suite of tasks: per task, per map, over the suite, and side by side.

NumPy on the host. Intervals resample tasks and training seeds, each as a whole: the tries of a task
are no independent evidence for other tasks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sqn_jax.evaluation import statistics
from sqn_jax.evaluation.agents import Agent, bumper_of
from sqn_jax.evaluation.episodes import EpisodeResults
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.settings import SuiteSettings
from sqn_jax.tasks.suite import TaskSuite

METRICS = (
    "success",
    "spl",
    "time_steps",
    "collisions",
    "path_length_m",
    "mean_reward",
    "coverage_m2",
)
WORST_FRACTION = 0.1


@dataclass(frozen=True, eq=False)
class SuiteTable:
    """The numbers of an agent in all episodes of a suite of M tasks."""

    agent: Agent
    values: dict[str, NDArray[np.float64]]
    """By the names of `METRICS`, [S, M, tries] each; NaN where nothing has been run."""
    shortest_paths: NDArray[np.float64]
    """[M] m."""

    def fill(
        self,
        numbers: NDArray[np.int64],
        results: Sequence[EpisodeResults],
        shortest_paths: NDArray[np.float64],
    ) -> None:
        """Enter the episodes of some tasks.

        Args:
            numbers: [n] places of the tasks in the suite.
            results: of each training seed, of the tries of each task, [n * tries].
            shortest_paths: [n] m.
        """
        self.shortest_paths[numbers] = shortest_paths
        for seed, result in enumerate(results):
            metrics = result.metrics[0]
            shape = (len(numbers), -1)
            success = np.asarray(metrics.success).reshape(shape)
            path_length = np.asarray(metrics.path_length, np.float64).reshape(shape)
            entered: dict[str, Any] = {
                "success": success,
                "spl": statistics.success_weighted_path_length(
                    success, path_length, np.broadcast_to(shortest_paths[:, None], success.shape)
                ),
                "time_steps": metrics.time_steps,
                "collisions": metrics.collisions,
                "path_length_m": path_length,
                "mean_reward": metrics.mean_reward,
                "coverage_m2": metrics.covered_area,
            }
            for name, numbers_of_tries in entered.items():
                self.values[name][seed, numbers] = np.asarray(numbers_of_tries).reshape(shape)

    def records(self, suite: TaskSuite, settings: SuiteSettings) -> Iterator[dict[str, Any]]:
        """One flat object per episode, ready for JSON lines."""
        for seed, training_seed in enumerate(self.agent.training_seeds):
            for number, task in enumerate(suite.tasks):
                for index in range(settings.tries):
                    eval_seed = settings.all_eval_seeds[index // settings.episodes]
                    numbers = {name: self.values[name][seed, number, index] for name in METRICS}
                    yield {
                        "agent": self.agent.name,
                        "suite": suite.name,
                        "task": number,
                        "map": task.map_file,
                        "epsilon": self.agent.epsilon,
                        "training_seed": training_seed,
                        "eval_seed": eval_seed,
                        "episode": index % settings.episodes,
                        "success": bool(numbers["success"]),
                        "time_steps": int(numbers["time_steps"]),
                        "collisions": int(numbers["collisions"]),
                        "shortest_path_m": float(self.shortest_paths[number]),
                        **{
                            name: float(value)
                            for name, value in numbers.items()
                            if name not in ("success", "time_steps", "collisions")
                        },
                    }


def empty_table(agent: Agent, suite: TaskSuite, settings: SuiteSettings) -> SuiteTable:
    """A table to be filled."""
    shape = (len(agent.training_seeds), len(suite.tasks), settings.tries)
    values = {name: np.full(shape, np.nan) for name in METRICS}
    return SuiteTable(agent, values, np.full(len(suite.tasks), np.nan))


def contents(
    tables: Sequence[SuiteTable], suite: TaskSuite, settings: SuiteSettings
) -> dict[str, Any]:
    """The contents of the evaluation file, ready for JSON.

    Returns:
        `results`: for each agent the `mean` of each of `METRICS` with `ci95` over tasks and
        training seeds and `std_of_tasks`, the sample standard deviation (n - 1) of the means of the
        tasks; `worst_tenth`, the mean success on the tenth of the maps that have the least (at
        least one map), which reads too low with few tries, see `statistics.worst_mean`;
        `worst_tenth_split`, where maps are ranked by every other try and judged by the rest,
        None with one try of each task; `maps` and `tasks`, the success and SPL on each.
        `comparisons`: for each two agents the difference of success and of SPL on the same tasks,
        see `statistics.paired_comparison`.
    """
    maps = [task.map_file for task in suite.tasks]
    compared = ("success", "spl")
    return {
        "schema": 1,
        "std_ddof": 1,
        "suite": suite.name,
        "num_tasks": len(suite.tasks),
        "num_maps": len(set(maps)),
        "robot": dict(suite.robot),
        "collision_ends": suite.collision_ends,
        "noise": list(settings.noise),
        "eval_seeds": settings.all_eval_seeds,
        "episodes": settings.episodes,
        "results": [_describe(table, maps) for table in tables],
        "comparisons": [
            {
                "first": first.agent.name,
                "second": second.agent.name,
                **{
                    name: statistics.paired_comparison(
                        first.values[name].mean(axis=(0, 2)), second.values[name].mean(axis=(0, 2))
                    )
                    for name in compared
                },
            }
            for index, first in enumerate(tables)
            for second in tables[index + 1 :]
        ],
    }


def _describe(table: SuiteTable, maps: Sequence[str]) -> dict[str, Any]:
    described: dict[str, Any] = {
        "agent": table.agent.name,
        "algorithm": table.agent.algorithm,
        "epsilon": table.agent.epsilon,
        **bumper_of(table.agent),
        "training_seeds": list(table.agent.training_seeds),
    }
    for name, values in table.values.items():
        means = values.mean(axis=2)
        described[name] = {
            "mean": float(values.mean()),
            "ci95": list(statistics.clustered_interval(means, is_rate=name == "success")),
            "std_of_tasks": statistics.sample_std(means.mean(axis=0)),
        }
    of_tasks = {name: table.values[name].mean(axis=(0, 2)) for name in ("success", "spl")}
    of_maps = {
        map_file: np.array([name == map_file for name in maps]) for map_file in dict.fromkeys(maps)
    }
    on_maps = np.array([of_tasks["success"][chosen].mean() for chosen in of_maps.values()])
    described["worst_tenth"] = statistics.worst_mean(on_maps, WORST_FRACTION)
    described["worst_tenth_split"] = _split_worst(table.values["success"], list(of_maps.values()))
    described["maps"] = [
        {
            "map": map_file,
            "success": float(of_tasks["success"][chosen].mean()),
            "spl": float(of_tasks["spl"][chosen].mean()),
        }
        for map_file, chosen in of_maps.items()
    ]
    described["tasks"] = [
        {"success": float(success), "spl": float(spl)}
        for success, spl in zip(of_tasks["success"], of_tasks["spl"], strict=True)
    ]
    return described


def _split_worst(
    success: NDArray[np.float64], of_maps: Sequence[NDArray[np.bool_]]
) -> float | None:
    """`statistics.split_worst_mean` of success [S, M, tries]; None with one try."""
    if success.shape[2] < 2:
        return None
    halves = [success[..., first::2].mean(axis=(0, 2)) for first in range(2)]
    first, second = ([half[chosen].mean() for chosen in of_maps] for half in halves)
    return statistics.split_worst_mean(first, second, WORST_FRACTION)


def worst_tenth(entry: dict[str, Any]) -> float:
    """The number of a result that tables show: judged by other tries where there are several."""
    split = entry.get("worst_tenth_split")
    return float(entry["worst_tenth"] if split is None else split)


def suite_table(evaluation: dict[str, Any]) -> str:
    """The results on a suite as a Markdown table: one row for each agent."""
    header = ["agent", "success", "95 % interval", "worst tenth", "SPL", "steps", "collisions"]
    rows = []
    for entry in evaluation["results"]:
        low, high = entry["success"]["ci95"]
        rows.append(
            [
                entry["agent"],
                f"{entry['success']['mean']:.2f}",
                f"{low:.2f} to {high:.2f}",
                f"{worst_tenth(entry):.2f}",
                f"{entry['spl']['mean']:.2f}",
                f"{entry['time_steps']['mean']:.0f}",
                f"{entry['collisions']['mean']:.1f}",
            ]
        )
    return markdown_table(header, rows)


def table_notes(evaluation: dict[str, Any]) -> Iterator[str]:
    """What the interval and the worst tenth of `suite_table` are."""
    results = evaluation["results"]
    over = "over tasks only, one training seed"
    if any(len(entry["training_seeds"]) > 1 for entry in results):
        over = "over training seeds and tasks, of an agent with one training seed over tasks only"
    yield f"95 % interval: {over}"
    if any(entry["worst_tenth_split"] is None for entry in results):
        yield (
            "worst tenth: the maps with the least success; with one try of each task bad luck is "
            "among them, so it reads too low"
        )
    else:
        yield "worst tenth: the maps that are worst in every other try, judged by the rest"


def comparison_lines(evaluation: dict[str, Any]) -> Iterator[str]:
    """For each agent a line on how its success compares to the wall follower's."""
    for comparison in evaluation["comparisons"]:
        success = comparison["success"]
        if comparison["second"] != "bug" or success["p_value"] is None:
            continue
        low, high = success["ci95"]
        yield (
            f"{comparison['first']} against bug: {success['difference']:+.2f} success, "
            f"95 % interval {low:+.2f} to {high:+.2f}, p = {success['p_value']:.2g}"
        )
