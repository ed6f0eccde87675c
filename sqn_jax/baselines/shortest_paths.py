"""Reference navigators: the fewest simulator steps to a goal, for a robot that knows the map.

Lattice approximation. Positions are rounded to cells after every move, so a forward step of 0.25 m
is one fixed whole-cell offset for each of the twenty headings. At 0.05 m a cell it is exact on the
axes and on eight more headings, 7.7 % too long on the other eight (3.1 % on average), its direction
off by up to 4 degrees; a backward step of 0.125 m is 11 to 20 % too short. Step counts are
therefore a reference to a few per cent, not a bound.

`Ways` is the cheaper estimate, without a search over headings, that steers `navigators.Oracle`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sqn_jax.env.geometry import wrap_angle
from sqn_jax.maps.distance import clear_moves, goal_fields
from sqn_jax.maps.occupancy import OccupancyMap, points_to_cells, traversable

HEADINGS = 20  # multiples of 18 degrees, the turn of one step
FORWARD_STEP = 0.25  # m
BACKWARD_STEP = -0.125  # m
UNREACHABLE = -1

MOVES = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if math.gcd(i, j) == 1]
"""The 32 moves (d_row, d_col) that make up the ways of `maps.goal_distance`."""
JUMPS = 3
"""The direction of a way is that of its next 2 ** JUMPS moves, 0.4 to 1.4 m together."""
BEND_SLACK = 0.1
"""rad; smaller bends come from the grid's few directions, not from the map."""


def shortest_ways(
    occupancy_map: OccupancyMap,
    starts: NDArray[np.floating],
    goals: NDArray[np.floating],
    *,
    robot_radius: float,
) -> NDArray[np.float64]:
    """Length of the shortest way from each start [E, >= 2] to its goal [E, 2], m."""
    resolution = occupancy_map.resolution
    free = traversable(occupancy_map.occupied, resolution, robot_radius)
    row, col = points_to_cells(starts[:, :2], resolution).T
    lengths = np.empty(len(goals))
    for same, field in goal_fields(free, resolution, goals):
        lengths[same] = field[row[same], col[same]]
    return lengths


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


class Ways:
    """Shortest ways over a map from every free cell to some goals: length, direction, bends."""

    def __init__(
        self, free: NDArray[np.bool_], resolution: float, goals: NDArray[np.float64], turn: float
    ) -> None:
        """Compute the ways to goals [E, 2]; a goal that occurs twice is computed once."""
        self.which = np.empty(len(goals), np.int64)
        self.resolution, self.turn = resolution, turn
        rows, cols = np.nonzero(free)
        self.centres = np.stack([cols + 0.5, rows + 0.5], axis=-1) * resolution
        self.index = np.full(free.shape, -1, np.int64)
        self.index[rows, cols] = np.arange(len(rows))
        self._neighbors = [
            (np.where(clear, self._shifted(i, j), -1), np.hypot(i, j) * resolution)
            for i, j in MOVES
            for clear in [clear_moves(free, i, j)[rows, cols]]
        ]
        size = (len(np.unique(goals, axis=0)), len(rows))
        self.length = np.empty(size, np.float32)
        self.direction = np.empty(size, np.float32)
        self.bends = np.empty(size, np.float32)
        for number, (same, field) in enumerate(goal_fields(free, resolution, goals)):
            self.which[same] = number
            self.length[number] = field[rows, cols]
            self.direction[number], self.bends[number] = self._follow(
                goals[same[0]], self.length[number]
            )

    def _shifted(self, d_row: int, d_col: int) -> NDArray[np.int64]:
        """Number of the cell at an offset from each free cell; wrong beyond the map's border."""
        return np.roll(self.index, (-d_row, -d_col), (0, 1))[self.index >= 0]

    def _follow(
        self, goal: NDArray[np.float64], length: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Direction of the way ahead at each free cell, rad, and the bends on it, turns."""
        onward = np.arange(len(length))
        best = np.full(len(length), np.inf)
        for neighbor, step in self._neighbors:
            through = np.where(neighbor >= 0, length[neighbor] + step, np.inf)
            better = through < best
            best[better], onward[better] = through[better], neighbor[better]
        to_goal = goal - self.centres
        straight = np.hypot(*to_goal.T)
        sees_goal = ~(length > straight + 1e-3 * self.resolution)
        onward = np.where(sees_goal | ~np.isfinite(length), np.arange(len(length)), onward)
        for _ in range(JUMPS):
            onward = onward[onward]
        ahead = np.where(sees_goal[:, None], to_goal, self.centres[onward] - self.centres)
        direction = np.arctan2(ahead[:, 1], ahead[:, 0])
        bend = np.abs(wrap_angle(direction[onward] - direction))
        bends = np.maximum(bend - BEND_SLACK, 0.0) / self.turn
        while True:
            # Each round doubles the part of the way that is summed up.
            bends = bends + bends[onward]
            if (onward[onward] == onward).all():
                return direction, bends
            onward = onward[onward]

    def steps_left(
        self, robots: NDArray[np.int64], pose: NDArray[np.float64], forward: float, backward: float
    ) -> NDArray[np.float64]:
        """Estimated steps from poses [N, 3] to the goals of robots [N]."""
        col, row = np.floor(pose[:, :2] / self.resolution).astype(np.int64).T
        cell, field = self.index[row, col], self.which[robots]
        direction = self.direction[field, cell].astype(np.float64)
        away = pose[:, :2] - self.centres[cell]
        # From the cell's centre to the place itself.
        length = self.length[field, cell] - (
            away[:, 0] * np.cos(direction) + away[:, 1] * np.sin(direction)
        )
        off = np.abs(wrap_angle(pose[:, 2] - direction)) / self.turn
        in_reverse = np.pi / self.turn - off + np.maximum(length, 0) * (1 / backward - 1 / forward)
        return length / forward + np.minimum(off, in_reverse) + self.bends[field, cell]
