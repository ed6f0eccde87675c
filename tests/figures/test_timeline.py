"""The timeline of an episode shows its numbers: read back from the artists."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from drawing import check_texts, drawn, marks
from episodes import episode
from matplotlib import pyplot
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb

from sqn_jax import figures
from sqn_jax.figures import style


def labelled(axes: Any) -> dict[str, Any]:
    return dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))


def test_the_timeline_shows_the_numbers_of_the_episode() -> None:
    one = episode(arrival=20)
    figure = drawn(figures.episode_timeline(one, title="SQN"))
    weights, values, rewards, distance = figure.axes
    assert "SQN\ngoal reached after 20 steps, 2.0 s" in figure.get_suptitle()
    # A quarter more than the way: 25 of the 30 steps.
    assert weights.get_xlim() == (0.0, 2.5)
    values_of = {name: line.get_ydata() for name, line in labelled(values).items()}
    np.testing.assert_allclose(values_of["skill 1"], [max(q[0]) for q in one.skill_q_values[:25]])
    np.testing.assert_allclose(values_of["skill 2"], [max(q[1]) for q in one.skill_q_values[:25]])
    np.testing.assert_allclose(values_of["ensemble"], [max(q) for q in one.q_values[:25]])
    sums = {name: line.get_ydata() for name, line in labelled(rewards).items()}
    for number, name in enumerate(("navigation", "exploration", "time")):
        running, total = [0.0], 0.0
        for part in one.reward_parts[:25, number]:
            total += part
            running.append(total)
        np.testing.assert_allclose(sums[name], running)
    np.testing.assert_allclose(sums["reward"][-1], one.rewards[:25].sum())
    way = labelled(distance)["distance"]
    # Before the first step the robot stood at (0.5, 0.6) m, the goal is at (3.5, 0.6) m.
    np.testing.assert_allclose(way.get_ydata(), [3.0, *one.goal_distances[:25]])
    np.testing.assert_allclose(way.get_xdata(), np.arange(26) * 0.1)


def test_the_weights_are_stacked_to_one_from_the_first_skill_on() -> None:
    one = episode(arrival=20, skills=3)
    weights = figures.episode_timeline(one, title="K = 3").axes[0]
    areas = [child for child in weights.collections if isinstance(child, PolyCollection)]
    assert [area.get_label() for area in areas] == ["skill 1", "skill 2", "skill 3"]
    for skill, area in enumerate(areas):
        corners = area.get_paths()[0].vertices
        # Midway in step 7, where an upright line cuts the area's edge.
        inside = corners[np.abs(corners[:, 0] - 0.7) < 1e-9, 1]
        below = one.skill_weights[7, :skill].sum()
        for height in (below, below + one.skill_weights[7, skill]):
            assert np.abs(inside - height).min() < 1e-6
        assert to_rgb(area.get_facecolor()[0]) == to_rgb(style.COLORS[skill])
    assert weights.get_ylim() == (0.0, 1.0)


def test_reachable_times_are_shaded_and_refused_moves_ticked() -> None:
    reachable, collisions = np.zeros(30, dtype=bool), np.zeros(30, dtype=bool)
    reachable[4:6] = True
    collisions[[2, 9]] = True
    one = episode(reachable=reachable, collisions=collisions, arrival=0)
    axes = figures.episode_timeline(one, title="SQN").axes[-1]
    np.testing.assert_allclose(marks(axes, "|")[:, 0], [0.3, 1.0])
    (shade,) = [child for child in axes.collections if isinstance(child, PolyCollection)]
    corners = shade.get_paths()[0].vertices
    raised = corners[corners[:, 1] > 0, 0]
    # After steps 4 and 5, 0.5 and 0.6 s, until what is known after step 6.
    assert (raised.min(), raised.max()) == pytest.approx((0.5, 0.7))
    unremarkable = figures.episode_timeline(
        episode(reachable=np.zeros(30, dtype=bool)), title="SQN"
    )
    assert not {"goal in sight", "collision"} & labelled(unremarkable.axes[-1]).keys()


@pytest.mark.parametrize("arrival", [12, 0])
def test_the_arrival_is_marked_in_all_panels_if_there_was_one(arrival: int) -> None:
    figure = figures.episode_timeline(episode(arrival=arrival), title="SQN")
    for axes in figure.axes:
        upright = [
            line.get_xdata()[0]
            for line in axes.lines
            if line.get_linestyle() == ":" and len(line.get_xdata()) == 2
        ]
        assert upright == pytest.approx([1.2] if arrival else [])
    if not arrival:
        assert "goal not reached in 30 steps, 3.0 s" in figure.get_suptitle()
        assert figure.axes[0].get_xlim() == (0.0, 3.0)


def test_an_agent_without_skills_has_no_panel_for_them() -> None:
    figure = drawn(figures.episode_timeline(episode(skills=1), title="R2D2"))
    assert len(figure.axes) == 3
    assert set(labelled(figure.axes[0])) == {"Q-value"}


@pytest.mark.usefixtures("full_pixels")
def test_no_text_overlaps_another() -> None:
    check_texts(drawn(figures.episode_timeline(episode(skills=3), title="SQN on a room")))
    assert pyplot.get_fignums() == [], "no figure is left in the list of open windows"
