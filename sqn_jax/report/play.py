"""The page to play on beside a report: its worst episode, to be tried by hand.

It is a file of its own. A report runs no script, and its own Content-Security-Policy lets none in;
that stays so.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.maps import OccupancyMap
from sqn_jax.play.page import PlayTask, play_page
from sqn_jax.policies.run_policies import Policy, of_seed
from sqn_jax.report.content import Content
from sqn_jax.report.episodes import WorstEpisode


@dataclass(frozen=True)
class Playable:
    """A page to play on, and where on it the worst episodes are."""

    html: str
    links: list[str | None]
    """For each of `Content.worst` its address beside the report; None if another policy had it."""


def path_beside(report: Path) -> Path:
    """Where the page to play on is written."""
    return report.with_name(f"{report.stem}-play.html")


def worst_to_play(content: Content, file_name: str) -> Playable:
    """The page for the policy of the worst episode, which begins with that episode's task.

    Args:
        content: of the report.
        file_name: of the page, for the links.

    Raises:
        ValueError: the page does not compute this policy.
    """
    first = content.worst[0]
    policy = _policy_of(first)
    mine = [_is_same_policy(worst, first) for worst in content.worst]
    maps: dict[str, OccupancyMap] = {}
    for worst, is_mine in zip(content.worst, mine, strict=True):
        if is_mine:
            occupancy_map = worst.batch.world.occupancy_map
            maps.setdefault(occupancy_map.name, occupancy_map)
    (run, *_) = (run for run in content.runs if run.policy.name == policy.name)
    source = run.source or run.name
    html = play_page(policy, list(maps.values()), source=source, task=_task_of(first))
    links = [
        _link(worst, file_name) if is_mine else None
        for worst, is_mine in zip(content.worst, mine, strict=True)
    ]
    return Playable(html, links)


def _policy_of(worst: WorstEpisode) -> Policy:
    """The policy of the training seed that ran the episode."""
    seed = worst.batch.training_seed
    agent = cast(TrainedAgent, worst.batch.agent)  # `Content` has no batches of baselines.
    policy = next(policy for policy in agent.policies if seed in policy.training_seeds)
    return of_seed(policy, seed)


def _is_same_policy(worst: WorstEpisode, other: WorstEpisode) -> bool:
    ours, theirs = worst.batch, other.batch
    return (ours.agent.name, ours.training_seed) == (theirs.agent.name, theirs.training_seed)


def _task_of(worst: WorstEpisode) -> PlayTask:
    start = worst.batch.starts[worst.episode].tolist()
    goal = worst.batch.goals[worst.episode].tolist()
    return PlayTask(tuple(start), tuple(goal))


def _link(worst: WorstEpisode, file_name: str) -> str:
    task = _task_of(worst)
    places = [",".join(f"{value:.4f}" for value in place) for place in (task.start, task.goal)]
    name = _quoted(worst.batch.world.occupancy_map.name)
    return f"{_quoted(file_name)}#map={name}&start={places[0]}&goal={places[1]}"


def _quoted(name: str) -> str:
    """A name with percent signs for all that could have a meaning in an address."""
    signs = [chr(byte) for byte in name.encode("utf-8", "replace")]
    return "".join(
        sign if sign.isascii() and (sign.isalnum() or sign in "-._") else f"%{ord(sign):02X}"
        for sign in signs
    )
