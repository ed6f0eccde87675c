"""What a policy would have commanded on a recorded drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from sqn_jax.figures.style import COLORS, DPI, INK, WIDTH_IN, tidy


def commands(
    times: Sequence[float],
    x: Sequence[float],
    y: Sequence[float],
    yaw: Sequence[float],
    goal_x: Sequence[float],
    goal_y: Sequence[float],
    speeds: Sequence[float],
    turn_rates: Sequence[float],
) -> Figure:
    """Plot the recorded path with its goals, and the commands over time.

    Args:
        times: [T] s.
        x: [T] m; NaN where the pose is unknown.
        y: [T] m.
        yaw: [T] rad.
        goal_x: [T] m; NaN before the first goal.
        goal_y: [T] m.
        speeds: [T] m/s.
        turn_rates: [T] rad/s.

    Returns:
        The path with its headings at the left, speed and turn rate at the right.
    """
    figure = Figure(figsize=(WIDTH_IN, 4), dpi=DPI, layout="constrained")
    ground = figure.add_subplot(1, 2, 1)
    ground.plot(x, y, color=COLORS[0], label="recorded path")
    some = slice(None, None, max(1, len(x) // 20))
    ground.quiver(x[some], y[some], np.cos(yaw[some]), np.sin(yaw[some]), color=INK, width=0.004)
    goals = np.unique(np.stack([goal_x, goal_y], axis=1), axis=0)
    ground.plot(*goals.T, "*", color=COLORS[1], markersize=12, label="goals")
    ground.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    ground.legend(frameon=False)
    tidy(ground)
    for place, values, label in ((2, speeds, "speed (m/s)"), (4, turn_rates, "turn rate (rad/s)")):
        axes = figure.add_subplot(2, 2, place)
        axes.step(times, values, where="post", color=COLORS[0])
        axes.set_ylabel(label)
        tidy(axes)
    axes.set_xlabel("time (s)")
    return figure
