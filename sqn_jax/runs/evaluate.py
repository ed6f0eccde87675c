"""An evaluation with a progress bar, written to a file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sqn_jax.baselines.shortest_paths import require_paths
from sqn_jax.evaluation.agents import Agent, require_robot
from sqn_jax.evaluation.cached_work import cached_work
from sqn_jax.evaluation.compare import (
    RECORD_BYTES,
    OnEvaluated,
    evaluate_agents,
    load_maps,
    memory_bytes,
    num_episodes,
)
from sqn_jax.evaluation.settings import Settings, SuiteSettings
from sqn_jax.evaluation.suites import SuiteMaps, evaluate_suite, robot_for
from sqn_jax.evaluation.suites import num_episodes as num_suite_episodes
from sqn_jax.maps import load_map
from sqn_jax.runs.progress import episodes_bar
from sqn_jax.storage.files import write_json, write_records
from sqn_jax.tasks import TaskSuite, check_tasks
from sqn_jax.training import memory_budget


@cached_work()
def evaluate_session(
    agents: Sequence[Agent],
    settings: Settings,
    out: Path | None = None,
    on_evaluated: OnEvaluated | None = None,
    fields: Sequence[str] = (),
) -> dict[str, Any]:
    """Evaluate agents with a progress bar.

    Args:
        agents: see `compare.evaluate_agents`.
        settings: see `compare.evaluate_agents`.
        out: the JSON file to write; the records of the episodes go beside it, as JSON lines.
        on_evaluated: see `compare.evaluate_agents`.
        fields: see `compare.evaluate_agents`.

    Returns:
        The contents of the evaluation file.

    Raises:
        ValueError: a map is unusable for a robot, or the episodes do not fit into memory; nothing
            has been run.
    """
    maps = load_maps(agents, settings)
    needed = memory_bytes(agents, maps, settings, fields)
    memory_budget.require(needed, "keeping the episodes", "evaluate")
    with episodes_bar(num_episodes(agents, settings)) as bar:
        evaluation, records = evaluate_agents(
            agents, maps, settings, bar.update, on_evaluated, fields
        )
    if out is not None:
        write_json(out, evaluation)
        write_records(out.with_suffix(".jsonl"), records)
    return evaluation


@cached_work()
def evaluate_suite_session(
    agents: Sequence[Agent],
    suite: TaskSuite,
    settings: SuiteSettings,
    out: Path | None = None,
    source: Path | None = None,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Evaluate agents on a suite of tasks with a progress bar.

    Args:
        agents: see `suites.evaluate_suite`.
        suite: the tasks; whether they can be solved is checked first.
        settings: how often each task is tried.
        out: the JSON file to write; the records of the episodes go beside it, as JSON lines.
        source: the file of the suite, for errors.

    Returns:
        The contents of the evaluation file, and the records of the episodes.

    Raises:
        ValueError: an agent cannot control the suite's robot, a map is unusable, a task cannot be
            solved, or the episodes do not fit into memory; nothing has been run.
    """
    episodes = num_suite_episodes(agents, suite, settings)
    memory_budget.require(RECORD_BYTES * episodes, "keeping the episodes", "evaluate")
    maps = suite_maps(agents, suite, source)
    with episodes_bar(episodes) as bar:
        evaluation, records = evaluate_suite(agents, suite, maps, settings, bar.update)
    if out is not None:
        write_json(out, evaluation)
        write_records(out.with_suffix(".jsonl"), records)
    return evaluation, records


def suite_maps(
    agents: Sequence[Agent], suite: TaskSuite, source: Path | None = None
) -> dict[float, SuiteMaps]:
    """What makes the maps of a suite, by the radius of a robot, m; its tasks are checked.

    Raises:
        ValueError: an agent cannot control the suite's robot, a map is unusable, or a task cannot
            be solved.
    """
    for agent in agents:
        require_robot(agent, robot_for(agent.env_config, suite))
    radii = {robot_for(agent.env_config, suite).robot_radius for agent in agents}
    maps = {radius: SuiteMaps(partial(load_map, robot_radius=radius)) for radius in radii}
    for radius in radii:
        check_tasks(
            suite, maps[radius], robot_radius=radius, source=str(source) if source else None
        )
        for task in suite.tasks:
            if task.shortest_path is None or any(agent.algorithm == "oracle" for agent in agents):
                require_paths(maps[radius](task.map_file), "where a shortest path is searched")
    return maps
