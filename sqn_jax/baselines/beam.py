"""The poses of a beam search, and the way back from the last of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Beam(NamedTuple):
    """The poses that the search continues from, `P` for each of N robots, best first.

    All have taken equally many steps. Rows of equal length make the search fast; those of a robot
    with fewer poses are filled up with what is not valid.
    """

    parent: Ints
    """[N, P] where in the row before they came from."""
    action: NDArray[np.int8]
    """[N, P] what led here; `STAND` at the start."""
    pose: Floats
    """[3, N, P] x, y, m, and heading, rad."""
    turns: Ints
    """[N, P] turns to the left since the start, less whole circles: the heading unrounded."""
    cell: Ints
    """[N, P] number of the cell: row times columns plus column."""
    valid: NDArray[np.bool_]
    """[N, P]."""


def trace_back(beams: list[tuple[Ints, Beam]], robot: int) -> tuple[Ints, Floats]:
    """Actions of a robot, and the poses before them, that led to its best pose at last.

    Args:
        beams: for each step whose rows the beam has, ascending, and the beam.
        robot: whose actions.
    """
    last = next(i for i in range(len(beams) - 1, -1, -1) if robot in beams[i][0])
    actions, poses, index = [], [], 0
    for step in range(last, 0, -1):
        row, row_before = (np.searchsorted(beams[i][0], robot) for i in (step, step - 1))
        actions.append(beams[step][1].action[row, index])
        index = beams[step][1].parent[row, index]
        poses.append(beams[step - 1][1].pose[:, row_before, index])
    return np.array(actions[::-1], np.int64), np.array(poses[::-1]).reshape(-1, 3)
