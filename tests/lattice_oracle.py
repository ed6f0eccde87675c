"""A second oracle, by an exhaustive search on a lattice: what the package's own is compared with.

Lattice approximation. Positions are rounded to cells after every move, so a forward step of 0.25 m
is one fixed whole-cell offset for each of the twenty headings. At 0.05 m a cell it is exact on the
axes and on eight more headings, 7.7 % too long on the other eight (3.1 % on average), its direction
off by up to 4 degrees; a backward step of 0.125 m is 11 to 20 % too short. Step counts are
therefore a reference to a few per cent, not a bound.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sqn_jax.maps.distance import clear_moves
from sqn_jax.maps.occupancy import OccupancyMap, points_to_cells, traversable

HEADINGS = 20  # multiples of 18 degrees, the turn of one step
FORWARD_STEP = 0.25  # m
BACKWARD_STEP = -0.125  # m
UNREACHABLE = -1


def move_offsets(step: float, resolution: float) -> NDArray[np.int64]:
    """The whole-cell offset (d_row, d_col) [HEADINGS, 2] nearest to a move of `step` m."""
    angle = np.arange(HEADINGS) * (2 * np.pi / HEADINGS)
    # Rounding first keeps 2.5000000000000004 and 2.5 alike, so that the four axes agree.
    exact = np.round(np.stack([np.sin(angle), np.cos(angle)], axis=-1) * step / resolution, 9)
    return np.round(exact).astype(np.int64)


def oracle_steps(
    occupancy_map: OccupancyMap,
    goal: ArrayLike,
    *,
    robot_radius: float = 0.1,
    goal_radius: float = 0.3,
) -> NDArray[np.int32]:
    """Fewest steps from every cell and heading to within `goal_radius` of a goal.

    Breadth-first search backwards from the goal over (heading, row, col) with the actions forward,
    backward and turn by 18 degrees left and right; a move needs every cell its segment touches to
    be traversable. See the module's head for how far the lattice departs from the simulator.

    Args:
      occupancy_map: the map; its resolution must be fine enough for a 0.25 m step.
      goal: (x, y) in the grid frame, m.
      robot_radius: m.
      goal_radius: m; a cell is at the goal if its centre is this near.

    Returns:
      int32 [H, W, 20], heading h * 18 degrees counter-clockwise from +x; `UNREACHABLE` (-1) where
      no sequence of actions leads to the goal, and in cells that are not traversable.

    Raises:
      ValueError: the cells are too coarse for the steps.
    """
    resolution = occupancy_map.resolution
    if resolution > FORWARD_STEP / 2:
        raise ValueError(
            f"map {occupancy_map.name!r}: resolution {resolution:g} m per cell, "
            f"expected at most {FORWARD_STEP / 2:g} to plan steps of {FORWARD_STEP:g} m"
        )
    free = traversable(occupancy_map.occupied, resolution, robot_radius)
    rows, cols = free.shape
    x = (np.arange(cols) + 0.5) * resolution - np.asarray(goal, dtype=np.float64)[0]
    y = (np.arange(rows) + 0.5) * resolution - np.asarray(goal, dtype=np.float64)[1]
    at_goal = free & (np.hypot(x[None, :], y[:, None]) <= goal_radius + 1e-9)
    moves = [_Move(free, move_offsets(step, resolution)) for step in (FORWARD_STEP, BACKWARD_STEP)]
    steps = np.full((HEADINGS, rows * cols), UNREACHABLE, dtype=np.int32)
    steps[:, at_goal.ravel()] = 0
    heading, cell = np.nonzero(steps == 0)
    count = 0
    while cell.size:
        count += 1
        reached = [((heading + 1) % HEADINGS, cell), ((heading - 1) % HEADINGS, cell)]
        reached += [move.predecessors(heading, cell) for move in moves]
        heading = np.concatenate([h for h, _ in reached])
        cell = np.concatenate([c for _, c in reached])
        new = steps[heading, cell] == UNREACHABLE
        state = np.unique(heading[new] * (rows * cols) + cell[new])
        heading, cell = np.divmod(state, rows * cols)
        steps[heading, cell] = count
    return np.moveaxis(steps.reshape(HEADINGS, rows, cols), 0, -1)


class _Move:
    """One action that changes the place: its offset in each heading, and where it is possible."""

    def __init__(self, free: NDArray[np.bool_], offsets: NDArray[np.int64]) -> None:
        self._clear = np.stack([clear_moves(free, int(i), int(j)).ravel() for i, j in offsets])
        self._flat = offsets[:, 0] * free.shape[1] + offsets[:, 1]

    def predecessors(
        self, heading: NDArray[np.intp], cell: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The states from which the move ends in the given (heading, flat cell) states."""
        before = cell - self._flat[heading]
        inside = (before >= 0) & (before < self._clear.shape[1])
        heading, before = heading[inside], before[inside]
        # `_clear` is looked up at the start, so an index that wrapped round a row is no danger: a
        # clear move from there ends in the same flat cell.
        possible = self._clear[heading, before]
        return heading[possible], before[possible]


def steps_between(
    occupancy_map: OccupancyMap,
    start: ArrayLike,
    goal: ArrayLike,
    *,
    robot_radius: float = 0.1,
    goal_radius: float = 0.3,
) -> tuple[int, float]:
    """Oracle steps from one point to another: (fewest, mean) over the twenty start headings.

    Args:
      start, goal: (x, y) in the grid frame, m.

    Returns:
      The fewest steps and their mean; (-1, inf) if the goal cannot be reached.
    """
    steps = oracle_steps(occupancy_map, goal, robot_radius=robot_radius, goal_radius=goal_radius)
    row, col = points_to_cells(start, occupancy_map.resolution)
    from_start = steps[row, col]
    if (from_start == UNREACHABLE).any():
        return UNREACHABLE, float("inf")
    return int(from_start.min()), float(from_start.mean())
