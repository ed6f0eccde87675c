"""What a report says: the runs as they are on the disk, and what comes of their evaluation."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.evaluation.compare import (
    EpisodeBatch,
    Learnt,
    Settings,
    evaluate_agents,
    group_policies,
    load_maps,
    num_episodes,
    with_references,
)
from sqn_jax.policies.pretrained import find_policy, names_a_run
from sqn_jax.policies.run_policies import Policy
from sqn_jax.report.episodes import HardEpisode, hardest
from sqn_jax.runs.progress import episodes_bar
from sqn_jax.storage.run_folder import RunFolder


@dataclass(frozen=True)
class Run:
    """A run folder, or a policy that comes with the package."""

    name: str
    policy: Policy
    metrics: list[dict[str, Any]]
    """The rows of its metrics.jsonl; none for a policy that comes with the package."""
    summary: dict[str, Any]
    """Its summary.json; empty where there is none."""


@dataclass(frozen=True)
class Content:
    """All that a page tells."""

    runs: list[Run]
    agents: list[Learnt]
    """The runs; those that differ in nothing but their seeds are one agent."""
    settings: Settings
    evaluation: dict[str, Any]
    """As `compare.evaluate_agents` returns it, the references among it."""
    batches: list[EpisodeBatch]
    """The episodes of the agents, without those of the references."""
    hardest: list[HardEpisode]
    """Three at most."""


def read_runs(words: Sequence[str], checkpoint: int | str = "newest") -> list[Run]:
    """Runs by the names a user gives: folders, `pretrained:NAME`, or files NAME.npz.

    Folders of the same name in different places are called as the user does.

    Args:
        words: the names.
        checkpoint: which of each run, see `run_policies.load_policy`.

    Raises:
        ValueError: one is not there, or damaged.
    """
    runs = [_read_run(word, checkpoint) for word in words]
    times = Counter(run.name for run in runs)
    return [
        replace(run, name=word, policy=replace(run.policy, name=word))
        if times[run.name] > 1
        else run
        for word, run in zip(words, runs, strict=True)
    ]


def _read_run(word: str, checkpoint: int | str) -> Run:
    policy = find_policy(word, checkpoint)
    if not names_a_run(word):
        return Run(word, policy, [], {})
    folder, _ = RunFolder.open(Path(word))
    return Run(policy.name, policy, folder.read_metrics(), _summary(folder.path))


def _summary(folder: Path) -> dict[str, Any]:
    """A run that was stopped has none."""
    path = folder / "summary.json"
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: holds {type(found).__name__}, expected an object")
    return found


def gather(runs: Sequence[Run], settings: Settings, *, references: bool) -> Content:
    """Evaluate the runs under a progress bar.

    Raises:
        ValueError: a map is unusable for a robot, or runs cannot be told apart.
    """
    learnt = group_policies([run.policy for run in runs])
    for name, times in Counter(agent.name for agent in learnt).items():
        if times > 1:
            raise ValueError(f"{times} runs are called {name!r}, expected different names")
    agents = with_references(learnt, references=references)
    maps = load_maps(agents, settings)
    batches: list[EpisodeBatch] = []

    def keep(batch: EpisodeBatch) -> None:
        if isinstance(batch.agent, Learnt):
            batches.append(batch)

    with episodes_bar(num_episodes(agents, settings)) as bar:
        evaluation, _ = evaluate_agents(
            agents, maps, settings, bar.update, keep, fields=("info", "output")
        )
    print("looking at what went worst, and drawing it ...", flush=True)
    return Content(list(runs), learnt, settings, evaluation, batches, hardest(batches))


def changed_settings(config: TrainConfig) -> tuple[str, list[tuple[str, Any, Any]]]:
    """The preset that a config is nearest to, and where it differs.

    Returns:
        Name of the preset; name, value and the preset's value of each setting that differs.
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
