"""Weights of skills by situation, against counts by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from experiments.skills import variants, weights_by_situation
from sqn_jax.agent import QOutput, Trajectory
from sqn_jax.policies.pretrained import load_pretrained


def trajectory(steps: list[tuple[float, float, bool, float]]) -> Trajectory:
    """One robot, a row a step: distance to goal, newly seen area, refused, weight of skill 2."""
    distance, area, refused, second = (np.array(x)[:, None] for x in zip(*steps, strict=True))
    weights: Any = np.stack([1 - second, second], axis=-1)
    info = {"goal_distance": distance, "covered_area": area, "collision": refused.astype(bool)}
    return Trajectory(info=info, output=QOutput(weights, weights, weights))


def test_each_step_counts_where_it_belongs() -> None:
    found = weights_by_situation(
        trajectory(
            [
                (5.0, 1.0, False, 0.2),  # New ground,
                (5.0, 0.5, False, 0.4),  # and again.
                (5.0, 0.05, False, 0.9),  # Known ground.
                (5.0, 0.0, True, 0.7),  # Refused,
                (0.5, 0.0, True, 0.0),  # but not at the goal,
                (0.5, 1.0, False, 0.1),  # where new ground does not count, either.
                (0.9, 0.0, False, 0.2),
                (1.1, 0.0, False, 0.7),  # Known ground.
            ]
        )
    )
    expected = {
        "at the goal": (3 / 8, 0.1),
        "new ground": (2 / 8, 0.3),
        "known ground": (2 / 8, 0.8),
        "refused": (1 / 8, 0.7),
    }
    assert found.keys() == expected.keys()
    for name, (share, second) in expected.items():
        assert found[name]["share"] == pytest.approx(share)
        assert found[name]["weights"] == pytest.approx([1 - second, second])


def test_a_situation_that_never_came_is_not_told() -> None:
    assert list(weights_by_situation(trajectory([(5.0, 1.0, False, 0.5)]))) == ["new ground"]


def test_every_skill_is_tried_alone() -> None:
    names = list(variants(load_pretrained("sqn")))
    assert names == ["as it is", "skill 1 alone", "skill 2 alone", "exchanged"]
