"""Pictures of several agents: the numbers drawn are the numbers given."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sqn_jax import figures
from sqn_jax.maps import load_map


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
    band = reward.collections[0].get_paths()[0].vertices[:, 1]
    assert band.min() >= 0
    assert band.max() <= 5
    assert [text.get_text() for text in reward.get_legend().get_texts()] == ["SQN", "DQN"]
    with pytest.raises(ValueError, match="agent SQN: no rows"):
        figures.learning_curves({"SQN": [[]]}, title="nothing")


def entry(agent: str, velocity: float, ranges: float, success: float) -> dict[str, Any]:
    told = {"mean": success, "ci95": [success - 0.1, success + 0.05]}
    noise = {"velocity_noise": velocity, "range_noise": ranges}
    units = {"velocity_noise_unit": "relative", "range_noise_unit": "relative"}
    return {"agent": agent, "success": told, **noise, **units}


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
    assert "share of full speed" in figure.axes[0].get_xlabel()
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
