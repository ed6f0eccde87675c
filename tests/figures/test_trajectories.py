"""Trajectories show the episodes they are given: read back from the artists, not from pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drawing import check_texts, drawn, drawn_paths, marks, panels
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle

from sqn_jax import figures
from sqn_jax.maps import OccupancyMap

HEIGHT_M, WIDTH_M = 4.0, 6.0
GOALS = [(0.5, 0.5), (5.5, 0.5), (5.5, 3.5), (0.5, 3.5), (3.1, 1.0), (3.1, 3.1)]


def room():
    """4 x 6 m of 0.1 m cells with a closed border, a wall, and a closed box nobody gets into."""
    occupied = np.zeros((40, 60), dtype=bool)
    occupied[[0, -1]] = True
    occupied[:, [0, -1]] = True
    occupied[10:30, 20] = True
    occupied[15:25, 40:50] = True
    occupied[17:23, 42:48] = False
    points = np.array([[0.5, 0.5], [5.5, 3.5]])
    return OccupancyMap("room", occupied, 0.1, points, points)


def episodes(goals, success, time_steps, length=30, skills=2):
    """Straight drives with random weights; episode e starts at (1 + e / 100, 2)."""
    rng = np.random.default_rng(7)
    count = len(goals)
    steps = np.arange(length + 1)[:, None] * 0.01
    x = 1.0 + np.arange(count) / 100 + steps * np.linspace(0.5, 1.5, count)
    poses = np.stack([x, 2.0 + steps * np.linspace(-1, 1, count), np.zeros_like(x)], axis=-1)
    weights = rng.dirichlet(np.ones(skills), (length, count)) if skills > 1 else None
    return {
        "goals": np.array(goals, dtype=np.float64),
        "poses": poses,
        "skill_weights": np.ones((length, count, 1)) if weights is None else weights,
        "success": np.array(success),
        "time_steps": np.array(time_steps),
    }


def draw(data, **options):
    return figures.trajectories(room(), **data, goal_radius=0.3, title="room", **options)


def start_order(axes):
    """Which episodes a panel draws, read off their starts."""
    return [round(100 * (path.get_segments()[0][0][0] - 1.0)) for path in drawn_paths(axes)]


def colorbar_labels(figure):
    return {axes.get_ylabel() for axes in figure.axes if not axes.get_title()}


def test_a_success_is_drawn_from_its_start_to_its_first_entry():
    data = episodes(GOALS[:1], [True], [12])
    (axes,) = panels(draw(data))
    (path,) = drawn_paths(axes)
    segments = np.array(path.get_segments())
    assert segments.shape == (12, 2, 2)
    # The start is where the robot stood, step 12 ends in pose 12, and no piece is missing.
    np.testing.assert_allclose(segments[0, 0], data["poses"][0, 0, :2])
    np.testing.assert_allclose(segments[-1, 1], data["poses"][12, 0, :2])
    np.testing.assert_allclose(segments[1:, 0], segments[:-1, 1])
    np.testing.assert_allclose(marks(axes, "o"), data["poses"][:1, 0, :2])
    assert len(marks(axes, "x")) == 0


def test_a_failure_is_drawn_whole_and_ends_in_a_cross():
    data = episodes(GOALS[:1], [False], [30])
    figure = draw(data)
    (axes,) = panels(figure)
    (path,) = drawn_paths(axes)
    assert len(path.get_segments()) == 30
    np.testing.assert_allclose(marks(axes, "x"), data["poses"][-1:, 0, :2])
    assert "not reached" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_colour_of_a_step_is_the_weight_of_the_first_skill():
    data = episodes(GOALS[:1] * 2, [True, False], [12, 30], skills=3)
    # Weights from one side only must not stretch the scale.
    data["skill_weights"] = 0.4 + 0.1 * data["skill_weights"]
    figure = draw(data)
    assert any("weight of skill 1" in label for label in colorbar_labels(figure))
    (axes,) = panels(figure)
    for path in drawn_paths(axes):
        assert (path.norm.vmin, path.norm.vmax) == (0.0, 1.0)
    lengths = {len(path.get_array()): path.get_array() for path in drawn_paths(axes)}
    np.testing.assert_allclose(lengths[12], data["skill_weights"][:12, 0, 0])
    np.testing.assert_allclose(lengths[30], data["skill_weights"][:, 1, 0])


def test_the_ends_of_the_weight_scale_differ_in_brightness():
    """So that the picture survives greyscale (luma, Rec. 601)."""
    figure = draw(episodes(GOALS[:1], [True], [12]))
    colours = drawn_paths(panels(figure)[0])[0].get_cmap()(np.linspace(0, 1, 32))[:, :3]
    luma = colours @ [0.299, 0.587, 0.114]
    assert (np.diff(luma) < 0).all()
    assert luma[0] - luma[-1] > 0.4
    assert colours[-1] @ [0, 0, 1] > colours[-1] @ [1, 0, 0], "skill 1 is blue in all pictures"


def test_one_skill_has_one_colour_and_no_scale_for_it():
    figure = draw(episodes(GOALS[:1] * 2, [True, False], [12, 30], skills=1))
    assert colorbar_labels(figure) == {"path to the goal, m"}
    all_paths = [path for axes in panels(figure) for path in drawn_paths(axes)]
    assert all(path.get_array() is None for path in all_paths)
    assert len({to_rgb(colour) for path in all_paths for colour in path.get_colors()}) == 1


def test_titles_count_all_episodes_and_average_the_steps_of_the_successes():
    goals = [GOALS[0]] * 4 + [GOALS[2]] * 2 + [GOALS[4]]
    success = [True, True, False, True, True, True, False]
    figure = draw(episodes(goals, success, [10, 20, 30, 12, 5, 6, 30]))
    assert [axes.get_title() for axes in panels(figure)] == [
        "goal (0.5, 0.5) m: 3 of 4 reached, 14 steps",
        "goal (5.5, 3.5) m: 2 of 2 reached, 6 steps",
        "goal (3.1, 1.0) m: 0 of 1 reached",
    ]
    assert "room\n5 of 7 reached" in figure.get_suptitle()


def test_the_background_is_the_distance_to_the_goal():
    """Rows run upwards, the wall and the closed box have no distance, and the scale is in m."""
    figure = draw(episodes([GOALS[1], GOALS[3]], [True, True], [5, 5]))
    assert "path to the goal, m" in colorbar_labels(figure)
    for axes, goal in zip(panels(figure), [GOALS[1], GOALS[3]], strict=True):
        ground, field = axes.images
        for image in (ground, field):
            assert image.origin == "lower"
            assert tuple(image.get_extent()) == (0.0, WIDTH_M, 0.0, HEIGHT_M)
        np.testing.assert_array_equal(ground.get_array(), room().occupied)
        distance = field.get_array()
        # (1.05, 2.05) m is column 10, row 20, in sight of neither corner's wall.
        straight = math.dist((1.05, 0.55), goal)
        assert straight - 0.01 <= distance[5, 10] <= 1.03 * straight + 0.5
        row_of_least, column = np.unravel_index(distance.argmin(), distance.shape)
        assert (0.1 * (column + 0.5), 0.1 * (row_of_least + 0.5)) == pytest.approx(goal, abs=0.06)
        assert distance.mask[20, 45]
        assert distance.mask[20, 20]
        assert not distance.mask[20, 10]
        assert (axes.get_xlim(), axes.get_ylim()) == ((0.0, WIDTH_M), (0.0, HEIGHT_M))
        assert axes.get_aspect() == 1.0
    scales = {(i.norm.vmin, i.norm.vmax) for axes in panels(figure) for i in axes.images[1:]}
    assert len(scales) == 1


def test_the_goal_is_marked_with_its_radius_to_scale():
    (axes,) = panels(draw(episodes(GOALS[:1], [True], [12])))
    np.testing.assert_allclose(marks(axes, "*"), GOALS[:1])
    (circle,) = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert circle.center == GOALS[0]
    assert circle.radius == 0.3


def test_goals_within_a_micrometre_share_a_panel():
    x, y = GOALS[0]
    goals = [(x, y), (x + 5e-7, y), (x + 1e-3, y)]
    figure = draw(episodes(goals, [True] * 3, [5] * 3))
    assert [len(drawn_paths(axes)) for axes in panels(figure)] == [2, 1]


def test_a_crowded_panel_draws_failures_first_then_successes_from_quick_to_slow():
    """20 episodes: 3 fail (drawn), 5 of the 17 successes at even ranks 0, 4, 8, 12, 16."""
    success = np.ones(20, dtype=bool)
    success[[2, 9, 15]] = False
    steps = np.where(success, 25 - np.arange(20), 30)  # later episodes are quicker
    figure = draw(episodes(GOALS[:1] * 20, success, steps))
    quick_to_slow = [e for e in reversed(range(20)) if success[e]]
    (axes,) = panels(figure)
    assert start_order(axes) == [2, 9, 15] + [quick_to_slow[i] for i in (0, 4, 8, 12, 16)]
    assert "17 of 20 reached" in axes.get_title()
    assert "at most 8 paths" in figure.get_suptitle()


@pytest.mark.parametrize(("failures", "failed_drawn"), [(0, 0), (2, 2), (12, 4), (18, 6), (20, 8)])
def test_eight_paths_are_drawn_and_failures_leave_room_for_successes(failures, failed_drawn):
    success = np.arange(20) >= failures
    figure = draw(episodes(GOALS[:1] * 20, success, np.where(success, 9, 30)))
    (axes,) = panels(figure)
    assert len(drawn_paths(axes)) == 8
    assert len(marks(axes, "x")) == failed_drawn


def test_more_goals_than_panels_show_failures_and_then_the_busiest():
    goals = [GOALS[0]] * 5 + [GOALS[1]] * 3 + [GOALS[2]] + [GOALS[3]] * 2 + [GOALS[4]] * 4
    success = np.ones(len(goals), dtype=bool)
    success[8] = False  # the only episode of GOALS[2]
    figure = draw(episodes(goals, success, [9] * len(goals)), max_panels=3)
    shown = [tuple(marks(axes, "*")[0]) for axes in panels(figure)]
    assert shown == [GOALS[2], GOALS[0], GOALS[4]]
    assert "14 of 15 reached, 3 of 5 goals shown" in figure.get_suptitle()


def test_random_pairs_are_chosen_far_apart():
    """All goals have one success: after the first, each is the farthest from those chosen."""
    goals = [GOALS[0], (0.6, 0.5), (0.5, 0.6), GOALS[2], GOALS[4]]
    figure = draw(episodes(goals, [True] * 5, [5] * 5), max_panels=3)
    shown = [tuple(marks(axes, "*")[0]) for axes in panels(figure)]
    assert shown == [GOALS[0], GOALS[2], GOALS[4]]


@pytest.mark.usefixtures("full_pixels")
@pytest.mark.parametrize("count", [1, 2, 5])
def test_no_text_overlaps_another(count):
    """Titles, tick labels, axis labels and the legend, on rendered boxes at full resolution."""
    goals = [GOALS[i % count] for i in range(2 * count)]
    figure = draw(episodes(goals, [True, False] * count, [5, 30] * count), max_panels=5)
    check_texts(drawn(figure))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("goals", lambda a: a[:1]),
        ("poses", lambda a: a[:-1]),
        ("skill_weights", lambda a: a[..., 0]),
        ("skill_weights", lambda a: a[:, :0]),
        ("success", lambda a: a[None]),
        ("time_steps", lambda a: a[:1]),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused_by_name(name, change):
    data = episodes(GOALS[:2], [True, False], [5, 30])
    with pytest.raises(ValueError, match=f"^{name} has the shape"):
        draw(data | {name: change(data[name])})
