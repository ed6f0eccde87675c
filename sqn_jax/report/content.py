"""The content of a report: the runs as they are on the disk, and their evaluation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sqn_jax import config as configs
from sqn_jax.baselines.shortest_paths import require_paths
from sqn_jax.config import TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.evaluation.agents import (
    EpisodeBatch,
    TrainedAgent,
    group_policies,
    with_baselines,
    with_epsilons,
)
from sqn_jax.evaluation.compare import evaluate_agents, load_maps, memory_bytes, num_episodes
from sqn_jax.evaluation.settings import Settings
from sqn_jax.outside.messages import say
from sqn_jax.policies.pretrained import find_policy, names_a_run
from sqn_jax.policies.run_policies import Policy, WhichParams, with_bumper
from sqn_jax.report.episodes import WorstEpisode, worst_episodes
from sqn_jax.runs.progress import episodes_bar
from sqn_jax.storage.run_folder import RunFolder
from sqn_jax.training import memory_budget


@dataclass(frozen=True)
class Run:
    """A run folder, or a policy that is shipped with the package."""

    name: str
    policy: Policy
    metrics: list[dict[str, Any]]
    """The rows of its metrics.jsonl; none for a shipped policy."""
    summary: dict[str, Any]
    """Its summary.json; empty if there is none."""
    source: str = ""
    """What a command takes to find it: the name that the user gave."""


@dataclass(frozen=True)
class Content:
    """The content of a page."""

    runs: list[Run]
    agents: list[TrainedAgent]
    """The runs; those that differ only in their seeds are one agent."""
    settings: Settings
    evaluation: dict[str, Any]
    """From `compare.evaluate_agents`, including the baselines."""
    batches: list[EpisodeBatch]
    """The episodes of the agents, without those of the baselines."""
    worst: list[WorstEpisode]
    """At most three, the worst first."""


def read_runs(
    names: Sequence[str],
    checkpoint: int | str = "newest",
    params: WhichParams = "shipped",
    bumper: float | None = None,
) -> list[Run]:
    """Read runs by the names that a user gives: folders, `pretrained:NAME`, or files NAME.npz.

    If folders in different places have the same name, the runs get the full names that were given.

    Args:
        names: the names.
        checkpoint: of each run, see `run_policies.load_policy`.
        params: of each run, see `run_policies.load_policy`.
        bumper: of its robot, see `run_policies.with_bumper`.

    Raises:
        ValueError: a run is missing or damaged, or the bumper is out of range.
    """
    runs = [_read_run(name, checkpoint, params, bumper) for name in names]
    counts = Counter(run.name for run in runs)
    return [
        replace(run, name=name, policy=replace(run.policy, name=name))
        if counts[run.name] > 1
        else run
        for name, run in zip(names, runs, strict=True)
    ]


def _read_run(name: str, checkpoint: int | str, params: WhichParams, bumper: float | None) -> Run:
    policy = with_bumper(find_policy(name, checkpoint, params), bumper)
    if not names_a_run(name):
        return Run(name, policy, [], {}, name)
    folder, _ = RunFolder.open(Path(name))
    return Run(policy.name, policy, folder.read_metrics(), folder.read_summary(), name)


def gather_content(
    runs: Sequence[Run], settings: Settings, *, baselines: bool, epsilon: float = 0.0
) -> Content:
    """Evaluate the runs with a progress bar.

    Raises:
        ValueError: a map is unusable for a robot, two runs have the same name, or epsilon is not in
            0..1.
    """
    trained = with_epsilons(group_policies([run.policy for run in runs]), [epsilon])
    for name, count in Counter(agent.name for agent in trained).items():
        if count > 1:
            raise ValueError(f"{count} runs are called {name!r}, expected different names")
    agents = with_baselines(trained, baselines=baselines)
    maps = load_maps(agents, settings)
    for occupancy_map in maps.values():
        require_paths(occupancy_map, "for a report, whose pictures show the way left")
    fields = ("info", "output")
    needed = memory_bytes(agents, maps, settings, fields)
    memory_budget.require(needed, "keeping the episodes", "evaluate")
    batches: list[EpisodeBatch] = []

    def collect(batch: EpisodeBatch) -> None:
        if isinstance(batch.agent, TrainedAgent):
            batches.append(batch)

    with episodes_bar(num_episodes(agents, settings)) as bar:
        evaluation, _ = evaluate_agents(agents, maps, settings, bar.update, collect, fields)
    say("drawing the worst episodes ...", flush=True)
    return Content(list(runs), trained, settings, evaluation, batches, worst_episodes(batches))


def changed_settings(config: TrainConfig) -> tuple[str, list[tuple[str, Any, Any]]]:
    """The preset that is nearest to a config, and the settings that differ.

    Returns:
        Name of the preset; for each setting that differs its name, value and value in the preset.
    """
    ours = configs.flat(configs.to_dict(config))
    changes = {}
    for preset, defaults in PRESETS.items():
        theirs = configs.flat(configs.to_dict(defaults))
        changes[preset] = [
            (name, ours[name], theirs[name]) for name in ours if ours[name] != theirs[name]
        ]
    nearest = min(changes, key=lambda preset: len(changes[preset]))
    return nearest, changes[nearest]
