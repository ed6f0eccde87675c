"""Pictures of single episodes and of skills show the data: read back from the artists."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import HEIGHT_M, LATTICE, WIDTH_M, episode, walled_room
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Polygon
from PIL import Image
from test_figures import check_texts

from sqn_jax import figures
from sqn_jax.figures import episode as episode_module
from sqn_jax.figures import ground, skills, style, timeline
from sqn_jax.maps import OccupancyMap
from sqn_jax.recording import Episode

FULL_DPI = figures.DPI
DRAWING = (episode_module, skills, style, timeline)


@pytest.fixture(autouse=True)
def coarse_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in DRAWING:
        monkeypatch.setattr(module, "DPI", 50)


def drawn(figure: Any) -> Any:
    """Run everything that only happens when a figure is rendered (warnings are errors)."""
    FigureCanvasAgg(figure).draw()
    return figure


def panels(figure: Any) -> list[Any]:
    return [axes for axes in figure.axes if axes.get_title()]


def marks(axes: Any, marker: str) -> Any:
    """Places [M, 2] of the marks of one kind."""
    found = [line.get_xydata() for line in axes.lines if line.get_marker() == marker]
    return np.concatenate(found) if found else np.zeros((0, 2))


def polygons(axes: Any, corners: int) -> list[Any]:
    """The corners [corners, 2] of the polygons that have so many."""
    found = [patch.get_xy()[:-1] for patch in axes.patches if isinstance(patch, Polygon)]
    return [xy for xy in found if len(xy) == corners]


def beam_end(one: Episode, index: int, beam: int) -> tuple[float, float]:
    """By hand: 8 beams, 50 degrees apart, the first 175 degrees to the right of the heading."""
    x, y, heading = one.poses[index]
    angle = heading + math.radians(-175 + 50 * beam)
    reach = one.ranges[index, beam]
    return x + reach * math.cos(angle), y + reach * math.sin(angle)


# ---------------------------------------------------------------------------------------- coverage


def area_by_hand(limit: float) -> float:
    """m2 of the points on the map left of `limit`, counted one by one."""
    x, y = LATTICE.points().reshape(-1, 2).T
    return sum(
        LATTICE.cell**2
        for px, py in zip(x, y, strict=True)
        if 0 <= px < min(limit, WIDTH_M) and 0 <= py < HEIGHT_M
    )


def test_the_coverage_is_shown_at_the_start_two_thirds_and_the_arrival() -> None:
    figure = drawn(figures.coverage_example(episode(arrival=12)))
    titles = [axes.get_title() for axes in panels(figure)]
    # Arrival in step 12: the states before steps 0, 4, 8 and 12; x = 1 m and 0.1 m more a step.
    areas = [area_by_hand(1.0 + 0.1 * step) for step in (0, 4, 8, 12)]
    assert titles == [
        f"{seconds:.1f} s: {area:.0f} m² seen"
        for seconds, area in zip((0.0, 0.4, 0.8, 1.2), areas, strict=True)
    ]
    assert areas == pytest.approx([4 * (1.0 + 0.1 * step) for step in (0, 4, 8, 12)], rel=0.06)


def test_a_coverage_panel_shows_the_way_the_scan_and_the_robot_at_its_step() -> None:
    one = episode()
    figure = figures.coverage_example(one, steps=[3, 20])
    for axes, step in zip(panels(figure), (3, 20), strict=True):
        (way,) = [line for line in axes.lines if len(line.get_xdata()) > 1]
        np.testing.assert_allclose(way.get_xydata(), one.poses[: step + 1, :2])
        (scan,) = polygons(axes, 9)
        np.testing.assert_allclose(scan[:8], [beam_end(one, step, beam) for beam in range(8)])
        np.testing.assert_allclose(scan[8], one.poses[step, :2])
        (arrow,) = polygons(axes, 4)
        ahead = arrow[0] - one.poses[step, :2]
        assert math.atan2(ahead[1], ahead[0]) == pytest.approx(one.poses[step, 2])
        np.testing.assert_allclose(marks(axes, "*"), [one.goal])


def test_the_tint_covers_what_was_seen_up_to_the_step_and_obstacles_lie_on_it() -> None:
    one = episode()
    figure = figures.coverage_example(one, steps=[0, 20])
    for axes, limit in zip(panels(figure), (1.0, 3.0), strict=True):
        tint, obstacles = axes.images
        for image in (tint, obstacles):
            assert image.origin == "lower"
            assert tuple(image.get_extent()) == (0.0, WIDTH_M, 0.0, HEIGHT_M)
        # A pixel has the state of the nearest point, at most 0.18 m away and maybe off the map.
        seen = np.asarray(tint.get_array())[2:-2, 2:-2]
        centres = (np.arange(60) + 0.5)[2:-2] * 0.1
        assert seen[:, centres < limit - 0.2].all()
        assert not seen[:, centres > limit + 0.2].any()
        np.testing.assert_array_equal(~obstacles.get_array().mask, one.occupancy_map.occupied)


def test_the_curve_is_the_area_over_seconds_with_a_dot_for_each_panel() -> None:
    figure = figures.coverage_example(episode(arrival=12), steps=[0, 5])
    below = figure.axes[-1]
    curve = below.lines[0]
    np.testing.assert_allclose(curve.get_xdata(), np.arange(13) * 0.1)
    expected = [area_by_hand(1.0 + 0.1 * step) for step in range(13)]
    np.testing.assert_allclose(curve.get_ydata(), expected)
    np.testing.assert_allclose(marks(below, "o"), [[0.0, expected[0]], [0.5, expected[5]]])
    assert below.get_ylabel() == "seen area, m²"


def test_an_episode_of_one_step_has_a_panel_for_each_of_its_moments() -> None:
    figure = figures.coverage_example(episode(arrival=1))
    assert [axes.get_title()[:5] for axes in panels(figure)] == ["0.0 s", "0.1 s"]


@pytest.mark.parametrize(
    ("steps", "named"),
    [([], "0 entries"), (list(range(9)), "9 entries"), ([31], "has 31"), ([-1], "has -1")],
)
def test_steps_outside_the_episode_are_refused(steps: list[int], named: str) -> None:
    with pytest.raises(ValueError, match=f"^steps .*{named}.*expected"):
        figures.coverage_example(episode(), steps=steps)


# ------------------------------------------------------------------------------------ reachability


def moments(**changes: Any) -> Episode:
    """Steps 1 to 6 before the arrival in step 7, the goal straight ahead on the left."""
    distances = np.array([4.0, 3.0, 2.0, 1.5, 3.2, 2.4, 0.2, 0.1])
    reachable = np.array([False, False, False, True, True, True, True, False])
    # The readings tell the state they belong to: 0.8 m or 4.5 m, and 1 cm more for each step.
    reach = np.where(np.concatenate([[False], reachable]), 4.5, 0.8) + 0.01 * np.arange(9)
    ranges = reach[:, None] * np.ones(36)
    poses = np.tile([2.5, 0.6, 0.0], (9, 1))
    values = {"poses": poses, "goal": np.array([5.5, 0.6]), "ranges": ranges}
    return episode(8, **(values | {"goal_distances": distances, "reachable": reachable} | changes))


def test_the_nearest_hidden_moment_stands_beside_a_reachable_one_as_far_away() -> None:
    """Hidden at 4, 3 and 2 m; in sight at 1.5, 3.2 and 2.4 m: 2 m and 2.4 m belong together."""
    hidden, reachable = panels(drawn(figures.reachability_example(moments())))
    assert hidden.get_title() == "goal 2.0 m away, hidden, not reachable"
    assert reachable.get_title() == "goal 2.4 m away, reachable"
    # After steps 3 and 6, counted from 1.
    for axes, solid, reach in ((hidden, False, 0.83), (reachable, True, 4.56)):
        (line,) = [line for line in axes.lines if len(line.get_xdata()) == 2]
        np.testing.assert_allclose(line.get_xydata(), [[2.5, 0.6], [5.5, 0.6]])
        assert line.is_dashed() != solid
        (scan,) = polygons(axes, 37)
        distances = np.linalg.norm(scan[:36] - (2.5, 0.6), axis=1)
        np.testing.assert_allclose(distances, reach)


def test_a_corner_that_hides_the_goal_from_one_beam_only_is_a_last_resort() -> None:
    """Step 3, nearest, becomes doubtful: a beam beside the goal's direction looks past it."""
    one = moments()
    ranges = one.ranges.copy()
    ranges[3, 18] = 4.5  # of 36 beams 10 degrees apart, 5 degrees to the left
    hidden, _ = panels(figures.reachability_example(dataclasses.replace(one, ranges=ranges)))
    assert hidden.get_title().startswith("goal 3.0 m away")
    ranges[1:4, 18] = 4.5
    hidden, _ = panels(figures.reachability_example(dataclasses.replace(one, ranges=ranges)))
    assert hidden.get_title().startswith("goal 2.0 m away"), "all are doubtful, the nearest counts"


def test_goals_behind_the_robot_or_beyond_the_sensor_are_not_called_hidden() -> None:
    one = moments()
    poses = one.poses.copy()
    poses[3, 2] = math.pi  # the goal lies in the blind angle of step 3
    turned = dataclasses.replace(one, poses=poses)
    hidden, _ = panels(figures.reachability_example(turned))
    assert hidden.get_title().startswith("goal 3.0 m away")
    far = moments(goal_distances=np.array([5.5, 6.0, 7.0, 1.5, 3.2, 2.4, 0.2, 0.1]))
    with pytest.raises(ValueError, match="1 episode: the goal is never near but hidden"):
        figures.reachability_example(far)


def test_moments_are_looked_for_in_all_episodes_and_their_lack_is_said() -> None:
    open_world = moments(reachable=np.ones(8, dtype=bool))
    with pytest.raises(ValueError, match="2 episodes: the goal is never near but hidden"):
        figures.reachability_example([open_world, open_world])
    closed = moments(reachable=np.zeros(8, dtype=bool))
    with pytest.raises(ValueError, match="the goal is never reachable"):
        figures.reachability_example(closed)
    hidden, reachable = panels(figures.reachability_example([open_world, closed]))
    assert "hidden" in hidden.get_title()
    assert "hidden" not in reachable.get_title()
    with pytest.raises(ValueError, match="no episodes"):
        figures.reachability_example([])


# ---------------------------------------------------------------------------------------- timeline


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
        assert to_rgb(area.get_facecolor()[0]) == to_rgb(style.COLOURS[skill])
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
    assert not {"goal reachable", "move refused"} & labelled(unremarkable.axes[-1]).keys()


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


# ------------------------------------------------------------------------------------------ skills


def paths(axes: Any) -> list[Any]:
    return [child for child in axes.collections if isinstance(child, LineCollection)]


def test_a_path_has_the_weights_of_its_steps_until_the_goal() -> None:
    one = episode(arrival=12)
    figure = drawn(figures.skill_trajectories([one], title="SQN"))
    (axes,) = panels(figure)
    (path,) = paths(axes)
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
    assert len(paths(axes)[0].get_segments()) == 30
    np.testing.assert_allclose(marks(axes, "x"), one.poses[-1:, :2])
    assert axes.get_title() == "room: 0 of 1 reached"


def test_the_scale_has_two_ends_with_a_light_middle_and_paths_a_dark_edge() -> None:
    """The ends are the colours that the skills have elsewhere; all is to be seen on the ground."""
    one = episode()
    (axes,) = panels(figures.skill_trajectories([one], title="SQN"))
    (path,) = paths(axes)
    colours = path.get_cmap()(np.linspace(0, 1, 255))[:, :3]
    np.testing.assert_allclose(colours[0], to_rgb(style.COLOURS[1]), atol=0.01)
    np.testing.assert_allclose(colours[-1], to_rgb(style.COLOURS[0]), atol=0.01)
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
    expected = [to_rgb(style.COLOURS[int(np.argmax(w))]) for w in one.skill_weights[:12]]
    assert len(set(expected)) == 3
    assert [to_rgb(colour) for colour in paths(axes)[0].get_colors()] == expected
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[-3:] == ["mostly skill 1", "mostly skill 2", "mostly skill 3"]


def test_agents_without_skills_have_one_colour_that_is_no_skills() -> None:
    figure = figures.skill_trajectories([episode(skills=1)], title="R2D2")
    (axes,) = figure.axes
    (colour,) = {to_rgb(colour) for colour in paths(axes)[0].get_colors()}
    assert colour not in {to_rgb(skill) for skill in style.COLOURS[:2]}
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
    assert [len(paths(axes)) for axes in panels(figure)] == [2, 1]
    for axes, room in zip(panels(figure), (walled_room(), other_room()), strict=True):
        np.testing.assert_array_equal(axes.images[0].get_array(), room.occupied)
    with pytest.raises(ValueError, match="no episodes"):
        figures.skill_trajectories([], title="none")


# -------------------------------------------------------------------------------------- comparison


def two_tasks(skills: int, arrival: int) -> list[Episode]:
    second = np.array([5.0, 3.3])
    first = episode(skills=skills, arrival=arrival)
    return [first, episode(skills=skills, arrival=0, goal=second)]


def test_rows_are_tasks_and_columns_are_agents() -> None:
    agents = {"SQN": two_tasks(2, 12), "R2D2": two_tasks(1, 15)}
    figure = drawn(figures.agents_side_by_side(agents, title="side by side"))
    told = [axes.get_title() for axes in panels(figure)]
    assert told == ["SQN: 12 steps", "R2D2: 15 steps", "SQN: not reached", "R2D2: not reached"]
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
    return dataclasses.replace(one, poses=poses)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda tasks: [change_start(tasks[0]), tasks[1]], "agent B, episode 0: another map"),
        (lambda tasks: [tasks[0], tasks[0]], "agent B, episode 1: another map"),
        (
            lambda tasks: [tasks[0], dataclasses.replace(tasks[1], occupancy_map=other_room())],
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


# ------------------------------------------------------------------------------------------ layout


def everything() -> Iterator[Any]:
    two = [episode(), episode(arrival=0, occupancy_map=other_room())]
    yield figures.coverage_example(episode())
    yield figures.coverage_example(episode(), steps=[0, 5, 9, 12, 20])
    yield figures.reachability_example(moments())
    yield figures.episode_timeline(episode(skills=3), title="SQN on a room")
    yield figures.skill_trajectories([*two, episode(skills=3)], title="SQN")
    yield figures.agents_side_by_side({"SQN": two_tasks(2, 12), "R2D2": two_tasks(1, 9)}, title="S")


def test_no_text_overlaps_another(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in DRAWING:
        monkeypatch.setattr(module, "DPI", FULL_DPI)
    for figure in everything():
        check_texts(drawn(figure))
    assert pyplot.get_fignums() == [], "no figure is left in the list of open windows"


def test_a_picture_is_the_png_that_would_be_saved(tmp_path: Path) -> None:
    def figure() -> Any:
        return figures.skill_trajectories([episode()], title="SQN")

    shown = figures.picture(figure())
    figures.save(figure(), tmp_path / "a.png")
    assert shown._repr_png_() == shown.png == (tmp_path / "a.png").read_bytes()
    with Image.open(io.BytesIO(shown.png)) as image:
        image.load()
        assert image.format == "PNG"
        assert image.width == round(style.WIDTH_IN * style.DPI)
    assert len(repr(shown)) < 100


def test_an_arrowhead_points_along_its_heading() -> None:
    tip = ground.arrowhead((1.0, 2.0, math.pi / 2), 1.0).get_xy()[0]
    np.testing.assert_allclose(tip, (1.0, 2.6))
