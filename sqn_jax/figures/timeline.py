"""One episode over time: skill weights, Q-values, rewards, distance to the goal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures.episode import REWARD_TERMS, reward_sums
from sqn_jax.figures.ground import mark_arrival, skill_color
from sqn_jax.figures.style import COLORS, DPI, INK, WIDTH_IN, plain, tidy


def episode_timeline(episode: Episode, *, title: str) -> Figure:
    """Plot an episode over time: skill weights, Q-values, rewards and the distance to the goal.

    The panels, from top to bottom: the skill weights, stacked (omitted for an agent without
    skills); the value of the best action of each skill and of their weighted sum; cumulative sums
    of the weighted terms of the reward; the straight-line distance to the goal, shaded while the
    goal was reachable (paper, eq. 8), with a tick for each collision (a refused move). A dotted
    line in all panels marks the arrival; the time axis extends beyond it by a quarter of the time
    before.

    Args:
        episode: the episode.
        title: above all panels, followed by the outcome.

    Returns:
        Four panels, or three for an agent without skills.
    """
    episode = episode.first_steps(math.ceil(1.25 * episode.time_steps))
    skills = episode.skill_weights.shape[1]
    count = 4 if skills > 1 else 3
    size = (WIDTH_IN, 1.75 * count + 0.9)
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    panels = list(figure.subplots(count, 1, sharex=True))
    if skills > 1:
        _draw_weights(panels[0], episode)
    _draw_values(panels[-3], episode)
    _draw_rewards(panels[-2], episode)
    _draw_distance(panels[-1], episode)
    for axes in panels:
        tidy(axes)
        if episode.success:
            mark_arrival(axes, episode)
        axes.set_xlim(0, episode.num_steps * episode.time_step)
        axes.yaxis.label.set_fontsize(9.5)
        axes.legend(loc="center left", bbox_to_anchor=(1.005, 0.5), frameon=False, fontsize=9)
    panels[-1].set_xlabel("time, s")
    figure.align_ylabels(panels)
    seconds = episode.time_steps * episode.time_step
    outcome = f"{episode.time_steps} steps, {seconds:.1f} s"
    verb = "reached after" if episode.success else "not reached in"
    figure.suptitle(plain(f"{title}\ngoal {verb} {outcome}"), fontsize=12)
    return figure


def _draw_weights(axes: Axes, episode: Episode) -> None:
    """The weights [T, K], stacked from skill 1 at the bottom, constant during each step."""
    edges = np.arange(episode.num_steps + 1) * episode.time_step
    weights = np.concatenate([episode.skill_weights, episode.skill_weights[-1:]])
    tops = np.cumsum(weights, axis=1)
    for skill in range(weights.shape[1]):
        low, high = tops[:, skill] - weights[:, skill], tops[:, skill]
        options: dict[str, Any] = {"color": skill_color(skill), "label": f"skill {skill + 1}"}
        axes.fill_between(edges, low, high, step="post", alpha=0.8, lw=0, **options)
    axes.set(ylim=(0, 1), ylabel="skill weight", axisbelow=True)


def _draw_values(axes: Axes, episode: Episode) -> None:
    """The value of the best action, for each skill and for the ensemble."""
    times = np.arange(episode.num_steps) * episode.time_step
    best = episode.skill_q_values.max(axis=2)
    if best.shape[1] > 1:
        for skill, values in enumerate(best.T):
            axes.plot(times, values, color=skill_color(skill), lw=1.3, label=f"skill {skill + 1}")
    name = "ensemble" if best.shape[1] > 1 else "Q-value"
    axes.plot(times, episode.q_values.max(axis=1), color=INK, lw=1.3, label=name)
    axes.set_ylabel("Q-value,\nbest action")


def _draw_rewards(axes: Axes, episode: Episode) -> None:
    """Cumulative sums of the weighted terms of the reward, and of the reward."""
    times = np.arange(episode.num_steps + 1) * episode.time_step
    sums = reward_sums(episode)
    for values, (name, color, style) in zip(sums.T, REWARD_TERMS, strict=False):
        axes.plot(times, values, color=color, ls=style, lw=1.8, label=name)
    axes.plot(times, sums.sum(axis=1), color=INK, lw=1.2, label="reward")
    axes.set_ylabel("reward\nup to here")


def _draw_distance(axes: Axes, episode: Episode) -> None:
    """The distance [T + 1] m to the goal, when the goal was reachable, and the collisions."""
    times = np.arange(episode.num_steps + 1) * episode.time_step
    first = np.linalg.norm(episode.poses[0, :2] - episode.goal)
    distances = np.concatenate([[first], episode.goal_distances])
    high = 1.08 * float(distances.max())
    if episode.reachable.any():
        # A value measured after a step is shown until after the next step.
        shade = np.where(np.concatenate([[False], episode.reachable]), high, 0.0)
        options: dict[str, Any] = {"step": "post", "color": COLORS[2], "alpha": 0.25, "lw": 0}
        axes.fill_between(times, 0, shade, label="goal in sight", **options)
    axes.plot(times, distances, color=COLORS[0], lw=1.8, label="distance")
    axes.axhline(episode.goal_radius, color="0.45", lw=0.9, ls="--", label="goal radius")
    if episode.collisions.any():
        collisions = times[1:][episode.collisions]
        bottom = np.full(collisions.shape, 0.03 * high)
        axes.plot(collisions, bottom, "|", color=COLORS[1], ms=9, mew=1.3, label="collision")
    if episode.success:
        axes.plot([], [], color=INK, ls=":", lw=1.4, label="goal radius entered")
    axes.set(ylim=(0, high), ylabel="to the goal, m")
