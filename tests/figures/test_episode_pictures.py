"""Pictures of what an episode saw show its data: read back from the artists."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from drawing import check_texts, drawn, marks, panels
from episodes import HEIGHT_M, LATTICE, WIDTH_M, changed, episode
from matplotlib import pyplot
from matplotlib.patches import Polygon

from sqn_jax import figures
from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures import ground


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


# Coverage.


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


# Reachability.


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
    assert hidden.get_title() == "Goal 2.0 m away, hidden"
    assert reachable.get_title() == "Goal 2.4 m away, in sight"
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
    hidden, _ = panels(figures.reachability_example(changed(one, ranges=ranges)))
    assert hidden.get_title().startswith("Goal 3.0 m away")
    ranges[1:4, 18] = 4.5
    hidden, _ = panels(figures.reachability_example(changed(one, ranges=ranges)))
    assert hidden.get_title().startswith("Goal 2.0 m away"), "all are doubtful, the nearest counts"


def test_goals_behind_the_robot_or_beyond_the_sensor_are_not_called_hidden() -> None:
    one = moments()
    poses = one.poses.copy()
    poses[3, 2] = math.pi  # the goal lies in the blind angle of step 3
    turned = changed(one, poses=poses)
    hidden, _ = panels(figures.reachability_example(turned))
    assert hidden.get_title().startswith("Goal 3.0 m away")
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


# Layout.


@pytest.mark.usefixtures("full_pixels")
def test_no_text_overlaps_another() -> None:
    check_texts(drawn(figures.coverage_example(episode())))
    check_texts(drawn(figures.coverage_example(episode(), steps=[0, 5, 9, 12, 20])))
    check_texts(drawn(figures.reachability_example(moments())))
    assert pyplot.get_fignums() == [], "no figure is left in the list of open windows"


def test_an_arrowhead_points_along_its_heading() -> None:
    tip = ground.arrowhead((1.0, 2.0, math.pi / 2), 1.0).get_xy()[0]
    np.testing.assert_allclose(tip, (1.0, 2.6))
