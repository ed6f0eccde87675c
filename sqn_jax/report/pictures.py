"""The pictures of a report, as bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sqn_jax import figures
from sqn_jax.evaluation.compare import EpisodeBatch, Learnt
from sqn_jax.evaluation.episodes import episode_keys
from sqn_jax.evaluation.recording import Episode, record_episodes
from sqn_jax.evaluation.settings import task_key
from sqn_jax.figures.animation import gif
from sqn_jax.report.content import Content, Run
from sqn_jax.report.episodes import NEAR, HardEpisode, Place

MOST_BYTES = 7_000_000
"""Of all pictures of a page, which is a third larger; pictures of paths beyond it are left out."""

_FRAMES, _FRAME_WIDTH_PX = 100, 560
_INK, _PAPER = "#222222", "white"


@dataclass(frozen=True)
class Illustration:
    """A PNG or GIF file, and what it shows."""

    data: bytes
    text: str
    """In place of the picture, for those who cannot see it."""
    caption: str


@dataclass(frozen=True)
class Illustrations:
    """All pictures of a page."""

    hardest: list[Illustration]
    """One for each of `Content.hardest`."""
    curves: list[Illustration]
    paths: list[Illustration]
    paths_left_out: int
    """How many more there would be."""
    animation: Illustration


def draw(content: Content) -> Illustrations:
    """Draw all that a page shows."""
    hardest = [_hard_picture(hard) for hard in content.hardest]
    training = curves(content)
    animation = _animation(content)
    room = MOST_BYTES - sum(len(each.data) for each in (*hardest, *training, animation))
    first = _first_batches(content.batches)
    paths: list[Illustration] = []
    for batch in first:
        paths.append(_paths(batch))
        room -= len(paths[-1].data)
        if room < 0:
            break
    return Illustrations(hardest, training, paths, len(first) - len(paths), animation)


def _title(batch: EpisodeBatch) -> str:
    return f"{batch.agent.name} on {batch.world.occupancy_map.name}, {batch.world.tasks}"


def _trajectories(batch: EpisodeBatch, chosen: slice, title: str) -> Any:
    """Episodes of a batch over the distance fields of their goals."""
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


def _hard_picture(hard: HardEpisode) -> Illustration:
    """The path, and a circle around the place where the robot was most of the time."""
    episode = slice(hard.episode, hard.episode + 1)
    figure = _trajectories(hard.batch, episode, f"{_title(hard.batch)}, episode {hard.episode}")
    _mark(figure.axes[0], hard.place, stuck=not hard.success and hard.place.is_most)
    return Illustration(
        figures.picture(figure).png,
        "The path of the robot over the distance to its goal, with a circle around the place "
        f"({hard.place.x:.1f}, {hard.place.y:.1f}) m.",
        f"The circle, {NEAR:g} m around ({hard.place.x:.1f}, {hard.place.y:.1f}) m, is the place "
        "where the robot was most of the time.",
    )


def _mark(axes: Any, place: Place, *, stuck: bool) -> None:
    """A circle around a place, with a word above it or, near the upper edge, below it."""
    turn = np.linspace(0, 2 * np.pi, 100)
    for color, width in ((_PAPER, 4.5), (_INK, 2.0)):
        x, y = place.x + NEAR * np.cos(turn), place.y + NEAR * np.sin(turn)
        axes.plot(x, y, color=color, lw=width, zorder=8)
    (left, right), (_, top) = axes.get_xlim(), axes.get_ylim()
    above = place.y + NEAR < 0.9 * top
    across = (place.x - left) / (right - left)
    axes.annotate(
        "stuck here" if stuck else "longest here",
        (place.x, place.y + (NEAR if above else -NEAR)),
        (0, 5 if above else -5),
        textcoords="offset points",
        ha="left" if across < 0.1 else "right" if across > 0.9 else "center",
        va="bottom" if above else "top",
        fontsize=10,
        fontweight="bold",
        color=_INK,
        bbox={"boxstyle": "round,pad=0.2", "fc": _PAPER, "ec": "none", "alpha": 0.85},
        zorder=9,
    )


def curves(content: Content) -> list[Illustration]:
    """How training went: of one run all curves, of several the two that compare them."""
    told = [run for run in content.runs if run.metrics]
    if not told:
        return []
    if len(told) == 1:
        (run,) = told
        figure = figures.learning_curve(run.metrics, title=f"Training of {run.name}")
        return [_curve(figure, "Reward, success, loss and, of several skills, their weights.")]
    rows = {id(run.policy): run.metrics for run in told}
    by_agent = {
        agent.name: [rows[id(p)] for p in agent.policies if id(p) in rows]
        for agent in content.agents
    }
    by_agent = {name: runs for name, runs in by_agent.items() if runs}
    pictures = [
        _curve(
            figures.learning_curves(by_agent, title="Training"),
            "Mean reward and success under exploration noise; where an agent has several training "
            "seeds, the line is their mean and the band a 95 % interval of it.",
        )
    ]
    gated = {run.name: run.metrics for run in told if _tells_of_skills(run)}
    if gated:
        figure = figures.gate_entropy_curves(gated, title="Entropy of the skill decision")
        pictures.append(_curve(figure, "How evenly the skills share the decision."))
    return pictures


def _tells_of_skills(run: Run) -> bool:
    """Whether every row of a run's metrics has what the curve of the skill decision needs."""
    names = {"episodes", "gate_entropy", "skill_usage"}
    config = run.policy.config
    has_skills = config.algo == "sqn" and config.network.num_skills > 1
    return has_skills and all(names <= row.keys() for row in run.metrics)


def _curve(figure: Any, caption: str) -> Illustration:
    return Illustration(
        figures.picture(figure).png, "Curves over the episodes of training.", caption
    )


def _first_batches(batches: Sequence[EpisodeBatch]) -> list[EpisodeBatch]:
    """Of each agent in each world the first training seed under the first evaluation seed."""
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
    """The worst failure; if there is none, the first episode of all."""
    failures = [hard for hard in content.hardest if not hard.success]
    batch, number = content.batches[0], 0
    if failures:
        batch, number = failures[0].batch, failures[0].episode
    episode = _recorded(batch, number)
    outcome = f"not reached within {episode.num_steps:,} steps"
    if episode.success:
        outcome = f"reached after {episode.time_steps:,} steps"
    data = gif(episode, count=_FRAMES, width_px=_FRAME_WIDTH_PX)
    shown = f"{_title(batch)}, episode {number} of evaluation seed {batch.eval_seed}: {outcome}"
    return Illustration(data, f"An animation of {shown}.", f"{shown}.")


def _recorded(batch: EpisodeBatch, number: int) -> Episode:
    """One of the episodes with all that a film of it needs."""
    assert isinstance(batch.agent, Learnt)
    keys = episode_keys(task_key(batch.eval_seed, batch.world.tasks), number + 1)[number:]
    (episode,) = record_episodes(keys, batch.agent, batch.training_seed, batch.world)
    return episode
