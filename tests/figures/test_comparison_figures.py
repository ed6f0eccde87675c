"""Pictures of several agents: the numbers drawn are the numbers given."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from drawing import check_texts, drawn
from episodes import episode, walled_room
from matplotlib.patches import Circle, Polygon
from matplotlib.text import Text

from sqn_jax import figures
from sqn_jax.figures.gallery import spread_steps
from sqn_jax.maps import OccupancyMap, load_map


def rows(rewards: list[Any], successes: list[Any]) -> list[dict[str, Any]]:
    pairs = enumerate(zip(rewards, successes, strict=True), start=1)
    return [{"episodes": 100 * k, "mean_reward": r, "success": s} for k, (r, s) in pairs]


def test_a_line_is_the_mean_over_runs_and_seeds_with_a_band_around_it() -> None:
    two_seeds = rows([[0.0, 2.0], [1.0, 3.0], [4.0, 4.0]], [[0.0, 0.5]] * 3)
    one_seed = rows([4.0, 5.0], [1.0, 1.0])
    figure = figures.learning_curves(
        {"SQN": [two_seeds, one_seed], "DQN": [one_seed]}, title="training"
    )
    reward, success = figure.axes
    sqn, dqn = reward.lines
    # Cut to the two chunks that both runs have; three training seeds in all.
    np.testing.assert_allclose(sqn.get_xdata(), [100, 200])
    np.testing.assert_allclose(sqn.get_ydata(), [(0 + 2 + 4) / 3, (1 + 3 + 5) / 3])
    np.testing.assert_allclose(dqn.get_ydata(), [4.0, 5.0])
    np.testing.assert_allclose(success.lines[0].get_ydata(), [0.5, 0.5])
    assert len(reward.collections) == 1, "one seed has no band"
    # Student's interval of 0, 2, 4 and of 1, 3, 5: the mean, and 4.303 times 2 / sqrt(3).
    band = reward.collections[0].get_paths()[0].vertices
    for episodes, mean in ((100, 2.0), (200, 3.0)):
        ends = band[band[:, 0] == episodes, 1]
        assert ends.min() == pytest.approx(mean - 4.303 * 2 / math.sqrt(3), abs=1e-3)
        assert ends.max() == pytest.approx(mean + 4.303 * 2 / math.sqrt(3), abs=1e-3)
    assert [text.get_text() for text in reward.get_legend().get_texts()] == ["SQN", "DQN"]
    with pytest.raises(ValueError, match="agent SQN: no rows"):
        figures.learning_curves({"SQN": [[]]}, title="nothing")


def test_where_all_runs_were_evaluated_the_line_is_that_of_evaluation() -> None:
    explored = rows([0.0, 0.5], [0.1, 0.2])
    known = [r | {"eval_mean_reward": r["mean_reward"] + 1, "eval_success": 0.9} for r in explored]
    gap = {"episodes": 50, "mean_reward": 9.0, "success": 1.0, "eval_mean_reward": None}
    figure = figures.learning_curves(
        {"SQN": [[gap, *known]], "DQN": [known]}, title="training", paper_rewards={"SQN": 1.35}
    )
    reward, success = figure.axes
    sqn, paper, dqn = reward.lines
    np.testing.assert_array_equal(sqn.get_xdata(), [100, 200])
    np.testing.assert_array_equal(sqn.get_ydata(), [1.0, 1.5])
    np.testing.assert_array_equal(dqn.get_ydata(), [1.0, 1.5])
    np.testing.assert_allclose(paper.get_ydata(), 1.35)
    assert "in evaluation" in success.get_title()
    mixed = figures.learning_curves({"SQN": [known], "DQN": [explored]}, title="training")
    np.testing.assert_array_equal(mixed.axes[0].lines[0].get_ydata(), [0.0, 0.5])
    assert "exploring" in mixed.axes[1].get_title()


def entry(agent: str, velocity: float, ranges: float, success: float) -> dict[str, Any]:
    summary = {"mean": success, "ci95": [success - 0.1, success + 0.05]}
    noise = {"velocity_noise": velocity, "range_noise": ranges}
    units = {"velocity_noise_unit": "relative", "range_noise_unit": "relative"}
    return {"agent": agent, "success": summary, **noise, **units}


def test_each_panel_has_its_noise_and_starts_without_any() -> None:
    results = [
        entry("sqn", 0.2, 0.0, 0.6),
        entry("sqn", 0.0, 0.0, 0.9),
        entry("sqn", 0.0, 0.4, 0.5),
        entry("dqn", 0.0, 0.0, 0.3),
        entry("dqn", 0.2, 0.0, 0.2),
        entry("dqn", 0.0, 0.4, 0.1),
    ]
    figure = figures.robustness(results, title="robustness")
    drawn = [
        [(list(line.get_xdata()), list(line.get_ydata())) for line, *_ in axes.containers]
        for axes in figure.axes
    ]
    assert drawn == [
        [([0.0, 0.2], [0.9, 0.6]), ([0.0, 0.2], [0.3, 0.2])],
        [([0.0, 0.4], [0.9, 0.5]), ([0.0, 0.4], [0.3, 0.1])],
    ]
    bars = figure.axes[0].containers[0][2][0].get_segments()
    np.testing.assert_allclose(np.array(bars)[:, :, 1], [[0.8, 0.95], [0.5, 0.65]])
    assert "fraction of full speed" in figure.axes[0].get_xlabel()
    with pytest.raises(ValueError, match="no results"):
        figures.robustness([], title="nothing")


def test_the_gallery_has_a_panel_a_map_in_metres() -> None:
    maps = [load_map("maze"), load_map("cave")]
    figure = figures.map_gallery(maps)
    assert [axes.get_title() for axes in figure.axes] == ["maze, 17 x 17 m", "cave, 51 x 51 m"]
    assert tuple(figure.axes[1].images[0].get_extent()) == (0, 51, 0, 51)
    marks = [tuple(line.get_xydata()[0]) for line in figure.axes[0].lines]
    assert marks == [tuple(point) for point in maps[0].evaluation_points]
    with pytest.raises(ValueError, match="no maps"):
        figures.map_gallery([])


def test_a_map_is_drawn_in_the_frame_of_its_file_cell_by_cell() -> None:
    """6 x 4 cells of 1 m, turned by 90 degrees about (10, 20)."""
    occupied = np.array(
        [[letter == "#" for letter in row] for row in ("######", "#..#.#", "#..#.#")]
    )
    occupied = np.concatenate([occupied, occupied[:1]])
    unknown = np.zeros_like(occupied)
    unknown[0, 5] = True
    spawn, evaluation = np.array([[1.5, 1.5], [2.5, 2.5]]), np.array([[1.5, 2.5], [2.5, 1.5]])
    turned = OccupancyMap(
        "yard", occupied, 1.0, spawn, evaluation, (10.0, 20.0, math.pi / 2), unknown=unknown
    )
    figure = figures.map_picture(turned, 0.1)
    (axes,), (image,) = figure.axes, figure.axes[0].images
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:4] == ["within reach", "free", "unknown", "occupied"]
    legend = [patch.get_facecolor() for patch in figure.legends[0].get_patches()]
    kinds = np.array(
        [
            [legend.index(color) for color in map(tuple, row)]
            for row in image.cmap(image.norm(image.get_array()))
        ]
    )
    np.testing.assert_array_equal(
        kinds, [[3, 3, 3, 3, 3, 2], [3, 0, 0, 3, 1, 3], [3, 0, 0, 3, 1, 3], [3] * 6]
    )
    # x of the map frame is 10 - y of the grid, y is 20 + x.
    np.testing.assert_allclose(axes.lines[0].get_xydata(), [[8.5, 21.5], [7.5, 22.5]])
    marks = [line.get_xydata()[0] for line in axes.lines[1:]]
    np.testing.assert_allclose(marks, [[7.5, 21.5], [8.5, 22.5]])
    np.testing.assert_allclose([*axes.get_xlim(), *axes.get_ylim()], [6, 10, 20, 26])
    corner = (image.get_transform() - axes.transData).transform((0.0, 4.0))
    np.testing.assert_allclose(corner, [6.0, 20.0], atol=1e-9)


def test_a_pattern_is_the_scan_in_the_robots_frame_with_ahead_to_the_right() -> None:
    """8 beams 50 degrees apart, the first 175 degrees to the right of the heading."""
    one = episode(arrival=20)
    figure = figures.observation_patterns([one], scans=1)
    above, pattern = figure.axes
    (outline,) = [p.get_xy() for p in pattern.patches if isinstance(p, Polygon)][:1]
    angles = [math.radians(-175 + 50 * beam) for beam in range(8)]
    ends = [
        (reach * math.cos(angle), reach * math.sin(angle))
        for reach, angle in zip(one.ranges[0], angles, strict=True)
    ]
    np.testing.assert_allclose(outline[:8], ends)
    np.testing.assert_allclose(outline[8], (0.0, 0.0))
    # Beam 1, 125 degrees to the right, looks back and down; beam 6, to the left, back and up.
    assert outline[1][0] < 0 > outline[1][1]
    assert outline[6][0] < 0 < outline[6][1]
    (circle,) = [patch for patch in pattern.patches if isinstance(patch, Circle)]
    assert circle.radius == 5.0
    assert pattern.get_xlim()[0] < -5 < 5 < pattern.get_xlim()[1]
    assert tuple(above.lines[0].get_xydata()[0]) == (0.5, 0.6)


def test_each_map_has_its_patterns_and_letters_say_where_they_were_taken() -> None:
    episodes = [episode(arrival=20), episode(arrival=30)]
    figure = figures.observation_patterns(episodes, scans=3)
    maps = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in maps] == ["room, 6 x 4 m"] * 2
    assert len(figure.axes) == 2 * (1 + 3)
    for axes, last in zip(maps, (20, 30), strict=True):
        letters = {text.get_text(): text.get_position() for text in axes.texts}
        assert list(letters) == ["A", "B", "C"]
        # 0.1 m a step along a line: the start, midway, and the arrival.
        assert [x for x, _ in letters.values()] == pytest.approx(
            [0.5, 0.5 + last / 20, 0.5 + last / 10]
        )
    check_texts(drawn(figure))


@pytest.mark.parametrize("count", [1, 2, 4])
def test_places_are_spread_as_a_search_through_all_of_them_spreads_them(count: int) -> None:
    rng = np.random.default_rng(0)
    one = episode(poses=rng.uniform(0, 5, size=(31, 3)), arrival=25)
    chosen = [0]
    while len(chosen) < count:
        gaps = [
            min(math.dist(one.poses[i, :2], one.poses[j, :2]) for j in chosen) for i in range(26)
        ]
        chosen.append(gaps.index(max(gaps)))
    assert spread_steps(one, count) == sorted(chosen)


@pytest.mark.parametrize("scans", [0, 7])
def test_patterns_without_episodes_or_with_too_many_scans_are_refused(scans: int) -> None:
    with pytest.raises(ValueError, match=f"scans is {scans}, expected 1 to 6"):
        figures.observation_patterns([episode()], scans=scans)
    with pytest.raises(ValueError, match="no episodes"):
        figures.observation_patterns([])


def gate_rows(entropies: list[Any], skills: int = 2, **more: list[Any]) -> list[dict[str, Any]]:
    rows = [
        {"episodes": 100 * k, "gate_entropy": entropy, "skill_usage": [1 / skills] * skills}
        for k, entropy in enumerate(entropies, start=1)
    ]
    for name, values in more.items():
        rows = [row | {name: value} for row, value in zip(rows, values, strict=True)]
    return rows


@pytest.mark.usefixtures("full_pixels")
def test_the_entropy_is_a_share_of_what_the_number_of_skills_allows() -> None:
    """log 2 = 0.6931 and log 4 = 1.3863 nat are 1; NaN, before the first update, leaves a gap."""
    runs = {
        "two": gate_rows([math.nan, 0.69314718, 0.34657359], skill_distance=[None, 0.2, 0.4]),
        "four": gate_rows([1.38629436, 0.69314718], skills=4),
    }
    figure = figures.gate_entropy_curves(runs, title="gates")
    drawn(figure)
    entropy, distance = figure.axes
    np.testing.assert_allclose(entropy.lines[0].get_ydata(), [np.nan, 1.0, 0.5])
    np.testing.assert_allclose(entropy.lines[1].get_ydata(), [1.0, 0.5])
    np.testing.assert_allclose(entropy.lines[1].get_xdata(), [100, 200])
    (line,) = distance.lines
    np.testing.assert_allclose(line.get_ydata(), [np.nan, 0.2, 0.4])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["two", "four"]
    check_texts(figure)


def test_runs_that_do_not_know_the_distance_have_one_panel_and_seeds_are_thin() -> None:
    rows = gate_rows([[0.2, 0.4], [0.1, 0.3]])
    (axes,) = figures.gate_entropy_curves({"SQN": rows}, title="gates").axes
    *thin, bold = axes.lines
    assert len(thin) == 2
    np.testing.assert_allclose(bold.get_ydata(), np.array([0.3, 0.2]) / 0.6931471805599453)


@pytest.mark.parametrize(
    ("runs", "named"),
    [
        ({}, "no runs"),
        ({"a": []}, "run a: 0 rows"),
        ({"a": [{"episodes": 1, "skill_usage": [1, 0]}]}, "run a: 1 rows.*gate_entropy"),
        ({"a": gate_rows([0.0], skills=1)}, "run a has 1 skill"),
    ],
)
def test_runs_without_a_skill_decision_are_refused_by_name(runs: Any, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        figures.gate_entropy_curves(runs, title="none")


def test_names_with_dollar_signs_are_no_formulas() -> None:
    """Half a formula would end every drawing with an error."""
    name = r"$\frac{$ and $x^2$"
    skilled = [row | {"gate_entropy": 0.5, "skill_usage": [0.5, 0.5]} for row in rows([0.0], [0.5])]
    driven = episode(occupancy_map=walled_room(name), agent=name)
    drawn = [
        figures.map_gallery([walled_room(name)]),
        figures.learning_curve(skilled, title=name),
        figures.learning_curves({name: [skilled]}, title=name),
        figures.gate_entropy_curves({name: skilled}, title=name),
        figures.robustness([entry(name, 0.0, 0.0, 0.5)], title=name),
        figures.observation_patterns([driven], title=name),
        figures.coverage_example(driven, title=name),
        figures.episode_timeline(driven, title=name),
        figures.skill_trajectories([driven], title=name),
        figures.agents_side_by_side({name: [driven]}, title=name),
    ]
    for figure in drawn:
        assert figures.picture(figure).png
        shown = " ".join(text.get_text() for text in figure.findobj(Text))
        assert name.replace("$", r"\$") in shown
        assert name not in shown
    assert figures.gif(driven, count=2, width_px=320)


def test_no_agents_are_refused() -> None:
    with pytest.raises(ValueError, match="no runs"):
        figures.learning_curves({}, title="nothing")
    with pytest.raises(ValueError, match="6 agents, expected at most 5"):
        figures.agents_side_by_side({str(n): [episode()] for n in range(6)}, title="many")
