"""Where skills have the weight, and agents side by side: read back from the artists."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from drawing import check_texts, drawn, drawn_paths, marks, panels
from episodes import changed, episode, walled_room
from matplotlib import pyplot
from matplotlib.colors import to_rgb

from sqn_jax import figures
from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures import style
from sqn_jax.maps import OccupancyMap

# Skills.


def test_a_path_has_the_weights_of_its_steps_until_the_goal() -> None:
    one = episode(arrival=12)
    figure = drawn(figures.skill_trajectories([one], title="SQN"))
    (axes,) = panels(figure)
    (path,) = drawn_paths(axes)
    segments = np.array(path.get_segments())
    np.testing.assert_allclose(segments[:, 0], one.poses[:12, :2])
    np.testing.assert_allclose(segments[:, 1], one.poses[1:13, :2])
    np.testing.assert_allclose(path.get_array(), one.skill_weights[:12, 0])
    assert (path.norm.vmin, path.norm.vmax) == (0.0, 1.0)
    assert axes.get_title() == "room: 1 of 1 reached"
    assert marks(axes, "x").shape == (0, 2)
    np.testing.assert_allclose(marks(axes, "o"), one.poses[:1, :2])


def test_a_failed_path_is_whole_and_ends_in_a_cross() -> None:
    one = episode(arrival=0)
    (axes,) = panels(figures.skill_trajectories([one], title="SQN"))
    assert len(drawn_paths(axes)[0].get_segments()) == 30
    np.testing.assert_allclose(marks(axes, "x"), one.poses[-1:, :2])
    assert axes.get_title() == "room: 0 of 1 reached"


def test_the_scale_has_two_ends_with_a_light_middle_and_paths_a_dark_edge() -> None:
    """The ends are the colours that the skills have elsewhere; all is to be seen on the ground."""
    one = episode()
    (axes,) = panels(figures.skill_trajectories([one], title="SQN"))
    (path,) = drawn_paths(axes)
    colours = path.get_cmap()(np.linspace(0, 1, 255))[:, :3]
    np.testing.assert_allclose(colours[0], to_rgb(style.COLORS[1]), atol=0.01)
    np.testing.assert_allclose(colours[-1], to_rgb(style.COLORS[0]), atol=0.01)
    luma = colours @ [0.299, 0.587, 0.114]
    assert 110 < luma.argmax() < 144
    (edge,) = [line for line in axes.lines if len(line.get_xdata()) > 2]
    np.testing.assert_allclose(edge.get_xydata(), one.poses[:13, :2])
    assert edge.get_linewidth() > path.get_linewidths()[0] + 0.8
    assert edge.get_zorder() < path.get_zorder()
    assert np.dot(to_rgb(edge.get_color()), [0.299, 0.587, 0.114]) < 0.3


def test_more_than_two_skills_have_the_colour_of_the_largest_weight() -> None:
    one = episode(skills=3)
    figure = figures.skill_trajectories([one], title="K = 3")
    (axes,) = figure.axes  # and no scale
    expected = [to_rgb(style.COLORS[int(np.argmax(w))]) for w in one.skill_weights[:12]]
    assert len(set(expected)) == 3
    assert [to_rgb(colour) for colour in drawn_paths(axes)[0].get_colors()] == expected
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[-3:] == ["mostly skill 1", "mostly skill 2", "mostly skill 3"]


def test_agents_without_skills_have_one_colour_that_is_no_skills() -> None:
    figure = figures.skill_trajectories([episode(skills=1)], title="R2D2")
    (axes,) = figure.axes
    (colour,) = {to_rgb(colour) for colour in drawn_paths(axes)[0].get_colors()}
    assert colour not in {to_rgb(skill) for skill in style.COLORS[:2]}
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["start", "goal", "agent without skills"]


def other_room() -> OccupancyMap:
    room = walled_room("another")
    occupied = room.occupied.copy()
    occupied[20:25, 40:45] = True
    return dataclasses.replace(room, occupied=occupied)


def test_each_map_has_a_panel_with_its_own_episodes() -> None:
    away = episode(occupancy_map=other_room(), arrival=0)
    one = episode()
    # The same map loaded twice is one map.
    again = episode(occupancy_map=walled_room())
    figure = drawn(figures.skill_trajectories([one, away, again], title="two maps"))
    assert [axes.get_title() for axes in panels(figure)] == [
        "room: 2 of 2 reached",
        "another: 0 of 1 reached",
    ]
    assert [len(drawn_paths(axes)) for axes in panels(figure)] == [2, 1]
    for axes, room in zip(panels(figure), (walled_room(), other_room()), strict=True):
        np.testing.assert_array_equal(axes.images[0].get_array(), room.occupied)
    with pytest.raises(ValueError, match="no episodes"):
        figures.skill_trajectories([], title="none")


# Agents side by side.


def two_tasks(skills: int, arrival: int) -> list[Episode]:
    second = np.array([5.0, 3.3])
    first = episode(skills=skills, arrival=arrival)
    return [first, episode(skills=skills, arrival=0, goal=second)]


def test_rows_are_tasks_and_columns_are_agents() -> None:
    agents = {"SQN": two_tasks(2, 12), "R2D2": two_tasks(1, 15)}
    figure = drawn(figures.agents_side_by_side(agents, title="side by side"))
    titles = [axes.get_title() for axes in panels(figure)]
    assert titles == ["SQN: 12 steps", "R2D2: 15 steps", "SQN: not reached", "R2D2: not reached"]
    boxes = [axes.get_window_extent() for axes in panels(figure)]
    assert boxes[0].x0 < boxes[1].x0
    assert boxes[0].y0 > boxes[2].y0
    assert [len(marks(axes, "x")) for axes in panels(figure)] == [0, 0, 1, 1]
    goals = [tuple(marks(axes, "*")[0]) for axes in panels(figure)]
    assert goals == [(3.5, 0.6), (3.5, 0.6), (5.0, 3.3), (5.0, 3.3)]


def test_the_ground_is_the_way_to_the_goal_around_the_wall() -> None:
    """The wall ends at y = 1 m and at y = 3.4 m; in its shadow the way is longer than the line."""
    task = episode(goal=np.array([3.5, 2.05]))
    figure = figures.agents_side_by_side({"SQN": [task]}, title="one")
    (axes,) = panels(figure)
    field = axes.images[1].get_array()
    assert axes.images[1].origin == "lower"
    row, column = np.unravel_index(field.argmin(), field.shape)
    assert (0.1 * (column + 0.5), 0.1 * (row + 0.5)) == pytest.approx((3.5, 2.05), abs=0.06)
    # From (1.05, 2.05) m round the wall's end, 0.1 m away from it, at (2.05, 0.9) m or above.
    around = math.dist((1.05, 2.05), (2.05, 0.9)) + math.dist((2.05, 0.9), (3.5, 2.05))
    assert field[20, 10] == pytest.approx(around, rel=0.06)
    assert field[20, 40] == pytest.approx(math.dist((4.05, 2.05), (3.5, 2.05)), abs=0.06)


def change_start(one: Episode) -> Episode:
    poses = one.poses.copy()
    poses[0, 2] += 0.1
    return changed(one, poses=poses)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda tasks: [change_start(tasks[0]), tasks[1]], "agent B, episode 0: another map"),
        (lambda tasks: [tasks[0], tasks[0]], "agent B, episode 1: another map"),
        (
            lambda tasks: [tasks[0], changed(tasks[1], occupancy_map=other_room())],
            "agent B, episode 1: another map",
        ),
        (lambda tasks: tasks[:1], "agent B has 1 episodes, expected 2 as A"),
        (lambda tasks: tasks * 3, "agent B has 6 episodes, expected 1 to 4"),
        (lambda tasks: [], "agent B has 0 episodes, expected 1 to 4"),
    ],
    ids=["start", "goal", "map", "fewer", "too many", "none"],
)
def test_agents_with_other_tasks_are_refused_by_name(change: Any, named: str) -> None:
    tasks = two_tasks(2, 12)
    with pytest.raises(ValueError, match=named):
        figures.agents_side_by_side({"A": tasks, "B": change(tasks)}, title="unequal")
    with pytest.raises(ValueError, match="no agents"):
        figures.agents_side_by_side({}, title="none")


# Layout.


@pytest.mark.usefixtures("full_pixels")
def test_no_text_overlaps_another() -> None:
    three = [episode(), episode(arrival=0, occupancy_map=other_room()), episode(skills=3)]
    check_texts(drawn(figures.skill_trajectories(three, title="SQN")))
    agents = {"SQN": two_tasks(2, 12), "R2D2": two_tasks(1, 9)}
    check_texts(drawn(figures.agents_side_by_side(agents, title="S")))
    assert pyplot.get_fignums() == [], "no figure is left in the list of open windows"
