"""What becomes of failed episodes, on episodes made up by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from experiments.failures import failures
from sqn_jax.agent import Trajectory

POINTS = np.array([[1.0, 1.0], [9.0, 1.0], [9.0, 9.0]])


def batch_of(metrics: Any, poses: Any, goals: Any, collisions: Any) -> Any:
    trajectory = Trajectory(poses=poses, info={"collision": collisions})
    return SimpleNamespace(
        main_metrics=metrics, starts=poses[0], goals=goals, trajectory=trajectory
    )


def test_failures_are_told_apart_by_their_last_steps() -> None:
    """A success; one that pushes, one that turns on the spot, one that goes up and down 3 m, and
    one that pushed for long but was driving at its end."""
    steps = 300
    poses = np.zeros((steps + 1, 5, 3))
    poses[:, :, :2] = [[1.1, 1.0], [1.0, 1.2], [9.0, 1.0], [9.0, 9.1], [9.0, 9.0]]
    poses[:, 3, 0] += np.linspace(0, 3, steps + 1)
    poses[-200:, 4, 1] -= np.linspace(0, 2, 200)
    collisions = np.zeros((steps, 5), bool)
    collisions[:, 1] = True
    collisions[:150, 2] = True
    collisions[: steps - 90, 4] = True
    goals = POINTS[[1, 1, 0, 0, 0]]
    summary = SimpleNamespace(success=np.array([True, False, False, False, False]))
    told = failures(batch_of(summary, poses, goals, collisions), POINTS)
    assert (told["episodes"], told["failures"], told["success"]) == (5, 4, 0.2)
    assert told["stand_still_pushing"] == 1
    assert told["stand_still_otherwise"] == 1
    assert told["pairs"] == {
        "1 to 2": {"episodes": 2, "success": 0.5},
        "2 to 1": {"episodes": 1, "success": 0.0},
        "3 to 1": {"episodes": 2, "success": 0.0},
    }


def test_where_none_failed_there_is_nothing_to_tell() -> None:
    poses = np.zeros((31, 1, 3))
    summary = SimpleNamespace(success=np.array([True]))
    told = failures(batch_of(summary, poses, POINTS[:1], np.zeros((30, 1), bool)), POINTS)
    assert (told["failures"], told["stand_still_pushing"], told["stand_still_otherwise"]) == (
        0,
        0,
        0,
    )
