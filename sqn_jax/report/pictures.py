"""The pictures of a report, as PNG and GIF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sqn_jax import figures
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent
from sqn_jax.evaluation.episodes import episode_keys
from sqn_jax.evaluation.paper_results import paper_reward
from sqn_jax.evaluation.recording import Episode, record_episodes
from sqn_jax.evaluation.settings import task_key
from sqn_jax.figures.animation import gif
from sqn_jax.report.content import Content, Run
from sqn_jax.report.episodes import NEAR, Place, WorstEpisode

MOST_BYTES = 7_000_000
"""Of all pictures of a page, which is a third larger; further pictures of paths are left out."""

_FRAMES, _FRAME_WIDTH_PX = 100, 560
_INK, _PAPER = "#222222", "white"


@dataclass(frozen=True)
class Illustration:
    """A PNG or GIF file, and what it shows."""

    data: bytes
    text: str
    """Alternative text of the picture."""
    caption: str


@dataclass(frozen=True)
class Illustrations:
    """All pictures of a page."""

    worst: list[Illustration]
    """One for each of `Content.worst`."""
    curves: list[Illustration]
    paths: list[Illustration]
    paths_left_out: int
    """Number of pictures of paths that were left out."""
    animation: Illustration


def draw_pictures(content: Content) -> Illustrations:
    """Draw all pictures of a page."""
    worst = [_worst_picture(episode) for episode in content.worst]
    training = curves(content)
    animation = _animation(content)
    pictures = (*worst, *training, animation)
    bytes_left = MOST_BYTES - sum(len(picture.data) for picture in pictures)
    first = _first_batches(content.batches)
    paths: list[Illustration] = []
    for batch in first:
        paths.append(_paths(batch))
        bytes_left -= len(paths[-1].data)
        if bytes_left < 0:
            break
    return Illustrations(worst, training, paths, len(first) - len(paths), animation)


def _title(batch: EpisodeBatch) -> str:
    return f"{batch.agent.name}, {batch.world.occupancy_map.name}, {batch.world.tasks}"


def _trajectories(batch: EpisodeBatch, chosen: slice, title: str) -> Any:
    """The paths of some episodes of a batch over the distance fields of their goals."""
    env_params, trajectory = batch.world.env_params, batch.trajectory
    return figures.trajectories(
        batch.world.occupancy_map,
        batch.goals[chosen],
        trajectory.poses[:, chosen],
        trajectory.output.skill_weights[:, chosen],
        batch.main_metrics.success[chosen],
        batch.main_metrics.time_steps[chosen],
        goal_radius=float(env_params.goal_radius),
        robot_radius=env_params.config.robot_radius,
        title=title,
    )


def _worst_picture(worst: WorstEpisode) -> Illustration:
    """The path, and a circle around the place where the robot was most of the time."""
    chosen, place = slice(worst.episode, worst.episode + 1), worst.place
    figure = _trajectories(worst.batch, chosen, f"{_title(worst.batch)}, episode {worst.episode}")
    _mark(figure.axes[0], place, is_stuck=not worst.success and place.is_most)
    return Illustration(
        figures.picture(figure).png,
        "The path of the robot over the distance to its goal, with a circle around the place "
        f"({place.x:.1f}, {place.y:.1f}) m.",
        f"The circle, {NEAR:g} m around ({place.x:.1f}, {place.y:.1f}) m, is the place "
        "where the robot was most of the time.",
    )


def _mark(axes: Any, place: Place, *, is_stuck: bool) -> None:
    """Draw a circle around a place, with a label above it or, near the upper edge, below it."""
    angles = np.linspace(0, 2 * np.pi, 100)
    for color, width in ((_PAPER, 4.5), (_INK, 2.0)):
        x, y = place.x + NEAR * np.cos(angles), place.y + NEAR * np.sin(angles)
        axes.plot(x, y, color=color, lw=width, zorder=8)
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    edge = 1.1 * NEAR  # Near the border of the map the panel grows, so that no circle is cut.
    left, right = min(left, place.x - edge), max(right, place.x + edge)
    bottom, top = min(bottom, place.y - edge), max(top, place.y + edge)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    is_above = place.y + NEAR < 0.9 * top
    fraction = (place.x - left) / (right - left)
    axes.annotate(
        "stuck here" if is_stuck else "longest here",
        (place.x, place.y + (NEAR if is_above else -NEAR)),
        (0, 5 if is_above else -5),
        textcoords="offset points",
        ha="left" if fraction < 0.1 else "right" if fraction > 0.9 else "center",
        va="bottom" if is_above else "top",
        fontsize=10,
        fontweight="bold",
        color=_INK,
        bbox={"boxstyle": "round,pad=0.2", "fc": _PAPER, "ec": "none", "alpha": 0.85},
        zorder=9,
    )


def curves(content: Content) -> list[Illustration]:
    """The curves of training: all curves of one run, or those that compare several runs."""
    runs = [run for run in content.runs if run.metrics]
    if not runs:
        return []
    if len(runs) == 1:
        (run,) = runs
        reward = paper_reward(run.policy.config)
        figure = figures.learning_curve(run.metrics, title=run.name, paper_reward=reward)
        return [_curve(figure, "Reward, success, loss and, with several skills, their weights.")]
    rows = {id(run.policy): run.metrics for run in runs}
    by_agent = {
        agent.name: [rows[id(p)] for p in agent.policies if id(p) in rows]
        for agent in content.agents
    }
    by_agent = {name: rows_of_runs for name, rows_of_runs in by_agent.items() if rows_of_runs}
    pictures = [
        _curve(
            figures.learning_curves(by_agent, title="All agents"),
            "Mean reward and success, in evaluation if all runs have it, else under exploration "
            "noise; if an agent has several training seeds, the line is their mean and the band "
            "its 95 % interval.",
        )
    ]
    by_run = {run.name: run.metrics for run in runs if _has_skill_metrics(run)}
    if by_run:
        figure = figures.gate_entropy_curves(by_run, title="Entropy of the skill decision")
        pictures.append(_curve(figure, "How evenly the skills share the decision."))
    return pictures


def _has_skill_metrics(run: Run) -> bool:
    """Whether all rows of metrics of a run have what the curve of the skill decision needs."""
    names = {"episodes", "gate_entropy", "skill_usage"}
    config = run.policy.config
    has_skills = config.algo == "sqn" and config.network.num_skills > 1
    return has_skills and all(names <= row.keys() for row in run.metrics)


def _curve(figure: Any, caption: str) -> Illustration:
    return Illustration(
        figures.picture(figure).png, "Curves over the episodes of training.", caption
    )


def _first_batches(batches: Sequence[EpisodeBatch]) -> list[EpisodeBatch]:
    """For each agent in each world, the first training seed under the first evaluation seed."""
    first: dict[tuple[str, int], EpisodeBatch] = {}
    for batch in batches:
        first.setdefault((batch.agent.name, id(batch.world)), batch)
    return list(first.values())


def _paths(batch: EpisodeBatch) -> Illustration:
    return Illustration(
        figures.picture(_trajectories(batch, slice(None), _title(batch))).png,
        f"Paths of {_title(batch)}, over the distance to the goal.",
        f"{_title(batch)}: training seed {batch.training_seed}, {len(batch.goals)} episodes under "
        f"evaluation seed {batch.eval_seed}.",
    )


def _animation(content: Content) -> Illustration:
    """An animation of the worst failure; without failures, of the first episode."""
    failures = [worst for worst in content.worst if not worst.success]
    batch, index = content.batches[0], 0
    if failures:
        batch, index = failures[0].batch, failures[0].episode
    episode = _recorded(batch, index)
    outcome = f"not reached within {episode.num_steps:,} steps"
    if episode.success:
        outcome = f"reached after {episode.time_steps:,} steps"
    data = gif(episode, count=_FRAMES, width_px=_FRAME_WIDTH_PX)
    description = (
        f"{_title(batch)}, episode {index} of evaluation seed {batch.eval_seed}: {outcome}"
    )
    return Illustration(data, f"An animation of {description}.", f"{description}.")


def _recorded(batch: EpisodeBatch, index: int) -> Episode:
    """Record one episode of a batch again, for an animation."""
    assert isinstance(batch.agent, TrainedAgent)
    keys = episode_keys(task_key(batch.eval_seed, batch.world.tasks), index + 1)[index:]
    (episode,) = record_episodes(keys, batch.agent, batch.training_seed, batch.world)
    return episode
