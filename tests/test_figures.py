"""The figures show the data they are given: read back from the artists, not from pixels."""

from __future__ import annotations

import math
import os

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle
from PIL import Image

from sqn_jax import figures
from sqn_jax.figures import curves, style
from sqn_jax.figures import paths as paths_module
from sqn_jax.maps import OccupancyMap

FULL_DPI = figures.DPI


def set_dpi(monkeypatch, dpi):
    for module in (curves, paths_module, style):
        monkeypatch.setattr(module, "DPI", dpi)


@pytest.fixture(autouse=True)
def _coarse_pixels(monkeypatch):
    """Rendering gets quicker, and only the layout depends on the resolution."""
    set_dpi(monkeypatch, 60)


# ---------------------------------------------------------------------------------- learning curve


def row(chunk, **changes):
    """A row of metrics.jsonl as one seed writes it."""
    plain = {
        "episodes": 100 * chunk,
        "env_steps": 40_000 * chunk,
        "updates": 16 * chunk,
        "wall_seconds": 30.0 * chunk,
        "mean_reward": -0.1 + 0.2 * chunk,
        "success": 0.1 * chunk,
        "time_steps": 400.0 - 20 * chunk,
        "loss": 0.5 / chunk,
        "epsilon": 0.5 - 0.04 * chunk,
        "gate_entropy": 0.6 / chunk,
        "skill_usage": [0.2 * chunk / 2, 1 - 0.2 * chunk / 2],
    }
    return plain | changes


def panel(figure, title):
    """The panel whose title contains a text."""
    (found,) = [axes for axes in figure.axes if title in axes.get_title()]
    return found


def curve(axes, label):
    """The data of the labelled curve of a panel."""
    (found,) = [line for line in axes.lines if line.get_label() == label]
    return found


def drawn(figure):
    """Run everything that only happens when a figure is rendered (warnings are errors)."""
    FigureCanvasAgg(figure).draw()
    return figure


def test_the_curves_are_the_rows():
    rows = [row(chunk) for chunk in range(1, 6)]
    figure = figures.learning_curve(rows, title="a run")
    expected = {
        "reward": [0.1, 0.3, 0.5, 0.7, 0.9],
        "loss": [0.5, 0.25, 0.5 / 3, 0.125, 0.1],
    }
    for title, values in expected.items():
        (line,) = panel(figure, title).lines
        np.testing.assert_allclose(line.get_ydata(), values)
        np.testing.assert_array_equal(line.get_xdata(), [100, 200, 300, 400, 500])
    success = panel(figure, "success")
    np.testing.assert_allclose(curve(success, "success").get_ydata(), [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(
        curve(success, "random actions").get_ydata(), [0.46, 0.42, 0.38, 0.34, 0.30]
    )
    skills = panel(figure, "skills")
    np.testing.assert_allclose(curve(skills, "skill 1").get_ydata(), [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(curve(skills, "skill 2").get_ydata(), [0.9, 0.8, 0.7, 0.6, 0.5])
    entropy = curve(skills, "gate entropy / log 2").get_ydata()
    np.testing.assert_allclose(entropy[0], 0.6 / 0.6931471805599453)
    assert "a run" in figure.get_suptitle()


def test_training_success_is_said_to_be_under_exploration_noise():
    figure = figures.learning_curve([row(1), row(2)], title="a run")
    axes = panel(figure, "success")
    assert "exploration noise" in axes.get_title()
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
    assert not any("skill" in axes.get_title() for axes in figure.axes)
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
    skills = panel(figure, "skills")
    np.testing.assert_allclose(curve(skills, "skill 2").get_ydata(), [0.9, 0.8, 0.7])
    assert len(skills.lines) == 3 * (3 + 1)
    assert "3 seeds" in figure.get_suptitle()


@pytest.mark.parametrize("nothing", [math.nan, None], ids=["nan", "null"])
def test_losses_before_the_first_update_leave_a_gap(nothing):
    rows = [row(1, loss=nothing, gate_entropy=nothing), row(2), row(3)]
    (line,) = panel(drawn(figures.learning_curve(rows, title="a run")), "loss").lines
    np.testing.assert_allclose(line.get_ydata(), [np.nan, 0.25, 0.5 / 3])
    assert line.axes.get_yscale() == "log"


def test_a_seed_without_a_loss_does_not_spoil_the_mean_of_the_others():
    rows = [seeds_row(1) | {"loss": [math.nan] * 3}, seeds_row(2) | {"loss": [0.2, math.nan, 0.4]}]
    line = panel(drawn(figures.learning_curve(rows, title="seeds")), "loss").lines[-1]
    np.testing.assert_allclose(line.get_ydata(), [np.nan, 0.3])


def test_a_run_that_has_not_learned_yet_can_be_drawn():
    rows = [row(c, loss=None, gate_entropy=None) for c in (1, 2)]
    axes = panel(drawn(figures.learning_curve(rows, title="a run")), "loss")
    assert [text.get_text() for text in axes.texts] == ["no update yet"]


def test_a_loss_that_is_not_positive_has_a_linear_scale():
    rows = [row(1, loss=0.5), row(2, loss=0.0)]
    assert panel(figures.learning_curve(rows, title="a run"), "loss").get_yscale() == "linear"


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


# ------------------------------------------------------------------------------------ trajectories

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


def panels(figure):
    return [axes for axes in figure.axes if axes.get_title()]


def paths(axes):
    return [child for child in axes.collections if isinstance(child, LineCollection)]


def marks(axes, marker):
    """Places [M, 2] of the marks of one kind."""
    found = [line.get_xydata() for line in axes.lines if line.get_marker() == marker]
    return np.concatenate(found) if found else np.zeros((0, 2))


def start_order(axes):
    """Which episodes a panel draws, read off their starts."""
    return [round(100 * (path.get_segments()[0][0][0] - 1.0)) for path in paths(axes)]


def colorbar_labels(figure):
    return {axes.get_ylabel() for axes in figure.axes if not axes.get_title()}


def test_a_success_is_drawn_from_its_start_to_its_first_entry():
    data = episodes(GOALS[:1], [True], [12])
    (axes,) = panels(draw(data))
    (path,) = paths(axes)
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
    (path,) = paths(axes)
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
    for path in paths(axes):
        assert (path.norm.vmin, path.norm.vmax) == (0.0, 1.0)
    lengths = {len(path.get_array()): path.get_array() for path in paths(axes)}
    np.testing.assert_allclose(lengths[12], data["skill_weights"][:12, 0, 0])
    np.testing.assert_allclose(lengths[30], data["skill_weights"][:, 1, 0])


def test_the_ends_of_the_weight_scale_differ_in_brightness():
    """So that the picture survives greyscale (luma, Rec. 601)."""
    figure = draw(episodes(GOALS[:1], [True], [12]))
    colours = paths(panels(figure)[0])[0].get_cmap()(np.linspace(0, 1, 32))[:, :3]
    luma = colours @ [0.299, 0.587, 0.114]
    assert (np.diff(luma) < 0).all()
    assert luma[0] - luma[-1] > 0.4
    assert colours[-1] @ [0, 0, 1] > colours[-1] @ [1, 0, 0], "skill 1 is blue in all pictures"


def test_one_skill_has_one_colour_and_no_scale_for_it():
    figure = draw(episodes(GOALS[:1] * 2, [True, False], [12, 30], skills=1))
    assert colorbar_labels(figure) == {"distance to the goal, m"}
    drawn_paths = [path for axes in panels(figure) for path in paths(axes)]
    assert all(path.get_array() is None for path in drawn_paths)
    assert len({to_rgb(colour) for path in drawn_paths for colour in path.get_colors()}) == 1


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
    assert "distance to the goal, m" in colorbar_labels(figure)
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
    assert [len(paths(axes)) for axes in panels(figure)] == [2, 1]


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
    assert len(paths(axes)) == 8
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


@pytest.mark.parametrize("count", [1, 2, 5])
def test_no_text_overlaps_another(count, monkeypatch):
    """Titles, tick labels, axis labels and the legend, on rendered boxes at full resolution."""
    set_dpi(monkeypatch, FULL_DPI)
    goals = [GOALS[i % count] for i in range(2 * count)]
    figure = draw(episodes(goals, [True, False] * count, [5, 30] * count), max_panels=5)
    check_texts(drawn(figure))


@pytest.mark.parametrize("skills", [1, 4])
@pytest.mark.parametrize("make", [row, seeds_row])
def test_no_text_of_a_learning_curve_overlaps_another(skills, make, monkeypatch):
    set_dpi(monkeypatch, FULL_DPI)
    rows = [make(chunk) for chunk in range(1, 9)]
    usage = np.broadcast_to(1 / skills, (3, skills)).tolist()
    rows = [r | {"skill_usage": usage if make is seeds_row else usage[0]} for r in rows]
    check_texts(drawn(figures.learning_curve(rows, title="SQN on maze")))


def tick_labels(axis):
    """Those within the axis; Matplotlib keeps labels beyond its ends and does not draw them."""
    low, high = sorted(axis.get_view_interval())
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    inside = [tick for tick in ticks if low <= tick.get_loc() <= high]
    return [label for tick in inside for label in (tick.label1, tick.label2)]


def check_texts(figure):
    """Every visible text lies on the page and apart from all others; legends leave panels free."""
    renderer = figure.canvas.get_renderer()
    for legend in figure.legends:
        frame = legend.get_window_extent(renderer).padded(-1)
        assert not any(frame.overlaps(axes.get_tightbbox(renderer)) for axes in figure.axes)
    texts = [figure._suptitle, *(text for legend in figure.legends for text in legend.get_texts())]
    for axes in [a for parent in figure.axes for a in (parent, *parent.child_axes)]:
        texts += [axes.title, axes.xaxis.label, axes.yaxis.label, *axes.texts]
        texts += [label for axis in (axes.xaxis, axes.yaxis) for label in tick_labels(axis)]
        if axes.get_legend():
            texts += axes.get_legend().get_texts()
    seen = [text for text in texts if text.get_visible() and text.get_text().strip()]
    boxes = [text.get_window_extent(renderer).padded(-1) for text in seen]
    width, height = figure.canvas.get_width_height()
    for number, box in enumerate(boxes):
        inside = box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height
        assert inside, f"{seen[number].get_text()!r} leaves the page"
        for other in range(number):
            pair = f"{seen[number].get_text()!r} and {seen[other].get_text()!r}"
            assert not box.overlaps(boxes[other]), f"{pair} overlap"


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


# -------------------------------------------------------------------------------------------- save


def test_a_saved_figure_is_a_png_of_the_figures_size_and_nothing_else_is_left(tmp_path):
    figure = figures.learning_curve([row(1), row(2)], title="a run")
    path = tmp_path / "run" / "figures" / "curve.png"
    figures.save(figure, path)
    with Image.open(path) as image:
        image.load()
        assert image.format == "PNG"
        assert image.width == round(style.WIDTH_IN * style.DPI)
    assert [p.name for p in path.parent.iterdir()] == ["curve.png"]


def test_the_same_figure_gives_the_same_bytes(tmp_path):
    for name in ("a.png", "b.png"):
        figures.save(draw(episodes(GOALS[:1], [True], [9])), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_save_that_breaks_off_leaves_the_old_picture(tmp_path, monkeypatch):
    path = tmp_path / "curve.png"
    path.write_bytes(b"old")
    figure = figures.learning_curve([row(1)], title="a run")

    def half_written(target, **_):
        with open(target, "wb") as file:
            file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(figure, "savefig", half_written)
    with pytest.raises(ValueError, match=r"curve\.png: cannot be written \(No space left"):
        figures.save(figure, path)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["curve.png"]


def test_an_unusable_path_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    figure = figures.learning_curve([row(1)], title="a run")
    with pytest.raises(ValueError, match="cannot be written"):
        figures.save(figure, tmp_path / "file" / "curve.png")
    with pytest.raises(ValueError, match=r"expected \.png"):
        figures.save(figure, tmp_path / "curve.pdf")


def test_no_figure_is_left_in_the_list_of_open_windows():
    figures.learning_curve([row(1)], title="a run")
    draw(episodes(GOALS[:1], [True], [9]))
    assert pyplot.get_fignums() == []
