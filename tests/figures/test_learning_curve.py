"""The learning curve shows the rows it is given: read back from the artists, not from pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drawing import check_texts, drawn
from drawing import metrics_row as row

from sqn_jax import figures


def panel(figure, title):
    """The panel whose title contains a text."""
    (found,) = [axes for axes in figure.axes if title in axes.get_title()]
    return found


def curve(axes, label):
    """The data of the labelled curve of a panel."""
    (found,) = [line for line in axes.lines if line.get_label() == label]
    return found


def test_the_curves_are_the_rows():
    rows = [row(chunk) for chunk in range(1, 6)]
    figure = figures.learning_curve(rows, title="a run")
    expected = {
        "reward": [0.1, 0.3, 0.5, 0.7, 0.9],
        "Loss": [0.5, 0.25, 0.5 / 3, 0.125, 0.1],
    }
    for title, values in expected.items():
        (line,) = panel(figure, title).lines
        np.testing.assert_allclose(line.get_ydata(), values)
        np.testing.assert_array_equal(line.get_xdata(), [100, 200, 300, 400, 500])
    success = panel(figure, "Success")
    np.testing.assert_allclose(curve(success, "success").get_ydata(), [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(
        curve(success, "epsilon").get_ydata(), [0.46, 0.42, 0.38, 0.34, 0.30]
    )
    skills = panel(figure, "Skill")
    np.testing.assert_allclose(curve(skills, "skill 1").get_ydata(), [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(curve(skills, "skill 2").get_ydata(), [0.9, 0.8, 0.7, 0.6, 0.5])
    entropy = curve(skills, "gate entropy / log 2").get_ydata()
    np.testing.assert_allclose(entropy[0], 0.6 / 0.6931471805599453)
    assert "a run" in figure.get_suptitle()


def test_training_success_is_said_to_be_under_exploration_noise():
    figure = figures.learning_curve([row(1), row(2)], title="a run")
    axes = panel(figure, "Success")
    assert "exploring" in axes.get_title()
    low, high = axes.get_ylim()
    assert low <= 0
    assert high >= 1


def test_minutes_stand_where_the_clock_says_they_were():
    """30 s a chunk of 100 episodes for 8 chunks: minute m comes with episode 200 m."""
    figure = figures.learning_curve([row(c) for c in range(1, 9)], title="a run")
    (top,) = panel(figure, "reward").child_axes
    assert top.get_xlabel() == "minutes"
    minutes = [float(text.get_text()) for text in top.get_xticklabels()]
    assert len(minutes) >= 3
    np.testing.assert_allclose(top.get_xticks(), [200 * minute for minute in minutes])


def test_one_skill_has_no_panel_for_skills():
    rows = [row(c, skill_usage=[1.0], gate_entropy=0.0) for c in (1, 2)]
    figure = figures.learning_curve(rows, title="R2D2")
    assert len(figure.axes) == 3
    assert not any("Skill" in axes.get_title() for axes in figure.axes)
    assert len(figures.learning_curve([row(1), row(2)], title="SQN").axes) == 4


def seeds_row(chunk, seeds=3):
    """A row of several seeds: lists with one number a seed, whose mean is row(chunk)'s."""
    shift = np.linspace(-0.01, 0.01, seeds)
    single = row(chunk)
    shared = {"episodes", "env_steps", "updates", "wall_seconds", "skill_usage"}
    lists = {k: (v + shift).tolist() for k, v in single.items() if k not in shared}
    usage = [[a + d, b - d] for d in shift for a, b in [single["skill_usage"]]]
    return single | lists | {"skill_usage": usage}


def test_each_seed_is_thin_and_the_mean_is_bold():
    rows = [seeds_row(chunk) for chunk in (1, 2, 3)]
    figure = figures.learning_curve(rows, title="three seeds")
    *thin, bold = panel(figure, "reward").lines
    assert [line.get_linewidth() < bold.get_linewidth() for line in thin] == [True] * 3
    np.testing.assert_allclose(bold.get_ydata(), [0.1, 0.3, 0.5])
    np.testing.assert_allclose(thin[0].get_ydata(), [0.09, 0.29, 0.49])
    np.testing.assert_allclose(thin[2].get_ydata(), [0.11, 0.31, 0.51])
    skills = panel(figure, "Skill")
    np.testing.assert_allclose(curve(skills, "skill 2").get_ydata(), [0.9, 0.8, 0.7])
    assert len(skills.lines) == 3 * (3 + 1)
    assert "3 seeds" in figure.get_suptitle()


@pytest.mark.parametrize("nothing", [math.nan, None], ids=["nan", "null"])
def test_losses_before_the_first_update_leave_a_gap(nothing):
    rows = [row(1, loss=nothing, gate_entropy=nothing), row(2), row(3)]
    (line,) = panel(drawn(figures.learning_curve(rows, title="a run")), "Loss").lines
    np.testing.assert_allclose(line.get_ydata(), [np.nan, 0.25, 0.5 / 3])
    assert line.axes.get_yscale() == "log"


def test_a_seed_without_a_loss_does_not_spoil_the_mean_of_the_others():
    rows = [seeds_row(1) | {"loss": [math.nan] * 3}, seeds_row(2) | {"loss": [0.2, math.nan, 0.4]}]
    line = panel(drawn(figures.learning_curve(rows, title="seeds")), "Loss").lines[-1]
    np.testing.assert_allclose(line.get_ydata(), [np.nan, 0.3])


def test_a_run_that_has_not_learned_yet_can_be_drawn():
    rows = [row(c, loss=None, gate_entropy=None) for c in (1, 2)]
    axes = panel(drawn(figures.learning_curve(rows, title="a run")), "Loss")
    assert [text.get_text() for text in axes.texts] == ["no update yet"]


@pytest.mark.parametrize("factor", [1.0, 1.01, 1.4, 2.0, 3.9, 5.0, 9.9, 20.0, 99.0, 1e3, 1e6])
@pytest.mark.parametrize("least", [1e-4, 0.0217, 0.07, 0.95])
def test_a_loss_can_be_read_off_in_plain_numbers(least, factor):
    rows = [row(1, loss=least * factor), row(2, loss=least)]
    axes = panel(drawn(figures.learning_curve(rows, title="a run")), "Loss")
    low, high = axes.get_ylim()
    labels = [
        label.get_text()
        for label, place in zip(axes.get_yticklabels(), axes.get_yticks(), strict=True)
        if low <= place <= high and label.get_text()
    ]
    assert 2 <= len(labels) <= 12
    for label in labels:
        assert low <= float(label.replace("\N{MINUS SIGN}", "-")) <= high


def test_a_loss_that_is_not_positive_has_a_linear_scale():
    rows = [row(1, loss=0.5), row(2, loss=0.0)]
    assert panel(figures.learning_curve(rows, title="a run"), "Loss").get_yscale() == "linear"


@pytest.mark.parametrize("make", [row, seeds_row])
def test_a_single_row_shows_as_points(make):
    figure = drawn(figures.learning_curve([make(1)], title="one row"))
    for axes in figure.axes:
        assert all(line.get_marker() == "o" for line in axes.lines)
        assert axes.get_xlim()[0] < 100 < axes.get_xlim()[1]


def test_a_clock_that_starts_anew_after_a_resume_is_no_error():
    rows = [row(1), row(2), row(3, wall_seconds=5.0), row(4, wall_seconds=35.0)]
    drawn(figures.learning_curve(rows, title="resumed"))
    without = [{k: v for k, v in r.items() if k != "wall_seconds"} for r in rows]
    figure = figures.learning_curve(without, title="no clock")
    assert not panel(figure, "reward").child_axes


@pytest.mark.parametrize(
    ("rows", "named"),
    [
        ([], "0 rows"),
        ([{"mean_reward": 1.0}], "episodes"),
        ([row(1), row(2, success=[0.1, 0.2])], "success"),
        ([row(1), row(2, skill_usage=[1.0])], "skill_usage"),
    ],
    ids=["none", "without episodes", "seeds change", "skills change"],
)
def test_unusable_rows_are_refused_by_name(rows, named):
    with pytest.raises(ValueError, match=named):
        figures.learning_curve(rows, title="a run")


def test_points_in_evaluation_lie_over_the_training_beside_the_paper_s_reward():
    nothing = {"eval_mean_reward": None, "eval_success": None}
    rows = [row(1) | nothing, row(2, eval_mean_reward=1.0, eval_success=0.5), row(3) | nothing]
    rows.append(row(4, eval_mean_reward=1.25, eval_success=0.75))
    figure = drawn(figures.learning_curve(rows, title="a run", paper_reward=1.35))
    reward, success = panel(figure, "reward"), panel(figure, "Success")
    for axes, values in ((reward, [1.0, 1.25]), (success, [0.5, 0.75])):
        np.testing.assert_array_equal(curve(axes, "evaluation").get_xdata(), [200, 400])
        np.testing.assert_array_equal(curve(axes, "evaluation").get_ydata(), values)
    np.testing.assert_allclose(curve(reward, "the paper's").get_ydata(), 1.35)
    assert "evaluation" in success.get_title()
    box, frame = success.get_legend().get_window_extent(), success.get_window_extent()
    assert frame.x0 <= box.x0 < box.x1 <= frame.x1, "the legend is as wide as the panel at most"
    seeds = [
        seeds_row(1),
        seeds_row(2) | {"eval_mean_reward": [1.0] * 3, "eval_success": [0.5] * 3},
    ]
    drawn(figures.learning_curve(seeds, title="the first row is of an older state"))


@pytest.mark.usefixtures("full_pixels")
@pytest.mark.parametrize("skills", [1, 4])
@pytest.mark.parametrize("make", [row, seeds_row])
def test_no_text_of_a_learning_curve_overlaps_another(skills, make):
    rows = [make(chunk) for chunk in range(1, 9)]
    usage = np.broadcast_to(1 / skills, (3, skills)).tolist()
    rows = [r | {"skill_usage": usage if make is seeds_row else usage[0]} for r in rows]
    check_texts(drawn(figures.learning_curve(rows, title="SQN, maze")))
    points = {"eval_mean_reward": 1.0, "eval_success": 0.5}
    rows = [r | points for r in rows]
    check_texts(drawn(figures.learning_curve(rows, title="SQN, maze", paper_reward=1.35)))
