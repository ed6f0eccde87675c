"""Shortest paths over a map: how long they are, and how many steps a robot needs along them.

Nothing is searched over headings here: what is left of a path is estimated from its length, the
turn toward it and its bends, which steers the search of `oracle.Oracle`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sqn_jax.env.geometry import wrap_angle
from sqn_jax.maps.distance import clear_moves, goal_fields, is_searchable, require_searchable
from sqn_jax.maps.occupancy import OccupancyMap, points_to_cells, traversable

MOVES = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if math.gcd(i, j) == 1]
"""The 32 moves (d_row, d_col) that make up the paths of `maps.goal_distance`."""
JUMPS = 3
"""The direction of a path is that of its next 2 ** JUMPS moves, 0.4 to 1.4 m together."""
BEND_SLACK = 0.1
"""rad; smaller bends come from the grid's few directions, not from the map."""


def shortest_path_lengths(
    occupancy_map: OccupancyMap,
    starts: NDArray[np.floating],
    goals: NDArray[np.floating],
    *,
    robot_radius: float,
) -> NDArray[np.float64]:
    """Length of the shortest path from each start [E, >= 2] to its goal [E, 2], m.

    Raises:
        ValueError: the map is too large, see `has_paths`.
    """
    require_paths(occupancy_map, "to search paths on")
    resolution = occupancy_map.resolution
    free = traversable(occupancy_map.occupied, resolution, robot_radius)
    row, col = points_to_cells(starts[:, :2], resolution).T
    lengths = np.empty(len(goals))
    for same, field in goal_fields(free, resolution, goals):
        lengths[same] = field[row[same], col[same]]
    return lengths


def has_paths(occupancy_map: OccupancyMap) -> bool:
    """Whether a map has few enough free cells for paths to be searched on it."""
    return is_searchable(~occupancy_map.occupied)


def require_paths(occupancy_map: OccupancyMap, what: str) -> None:
    """Refuse what needs paths on a map that is too large for that.

    Raises:
        ValueError: one line naming the map.
    """
    require_searchable(~occupancy_map.occupied, occupancy_map.name, what)


class ShortestPaths:
    """Shortest paths over a map from every free cell to some goals: length, direction, bends."""

    def __init__(
        self, free: NDArray[np.bool_], resolution: float, goals: NDArray[np.float64], turn: float
    ) -> None:
        """Compute the paths to goals [E, 2]; a goal that occurs twice is computed once."""
        self.which = np.empty(len(goals), np.int64)
        self.resolution, self.turn = resolution, turn
        rows, cols = np.nonzero(free)
        self.centers = np.stack([cols + 0.5, rows + 0.5], axis=-1) * resolution
        self.index = np.full(free.shape, -1, np.int64)
        self.index[rows, cols] = np.arange(len(rows))
        self._neighbors = [
            (np.where(clear, self._shifted(i, j), -1), np.hypot(i, j) * resolution)
            for i, j in MOVES
            for clear in [clear_moves(free, i, j)[rows, cols]]
        ]
        # What is known of a cell lies together: it is looked up together.
        self._table = np.empty((len(np.unique(goals, axis=0)), len(rows), 3), np.float32)
        self.length, self.direction, self.bends = np.moveaxis(self._table, -1, 0)
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
        """Direction of the path ahead at each free cell, rad, and the bends on it, turns."""
        onward = np.arange(len(length))
        best = np.full(len(length), np.inf)
        for neighbor, step in self._neighbors:
            through = np.where(neighbor >= 0, length[neighbor] + step, np.inf)
            better = through < best
            best[better], onward[better] = through[better], neighbor[better]
        to_goal = goal - self.centers
        straight = np.hypot(*to_goal.T)
        sees_goal = ~(length > straight + 1e-3 * self.resolution)
        onward = np.where(sees_goal | ~np.isfinite(length), np.arange(len(length)), onward)
        for _ in range(JUMPS):
            onward = onward[onward]
        ahead = np.where(sees_goal[:, None], to_goal, self.centers[onward] - self.centers)
        direction = np.arctan2(ahead[:, 1], ahead[:, 0])
        bend = np.abs(wrap_angle(direction[onward] - direction))
        bends = np.maximum(bend - BEND_SLACK, 0.0) / self.turn
        while True:
            # Each round doubles the part of the path that is summed up.
            bends = bends + bends[onward]
            if (onward[onward] == onward).all():
                return direction, bends
            onward = onward[onward]

    def steps_left(
        self, robots: NDArray[np.int64], pose: NDArray[np.float64], forward: float, backward: float
    ) -> NDArray[np.float64]:
        """Estimated steps from poses [N, 3] to the goals of robots [N]."""
        return self.steps_left_in(self.cells_of(pose.T[:2]), robots, pose.T, forward, backward)

    def cells_of(self, place: NDArray[np.float64]) -> NDArray[np.int64]:
        """The cells of places [2, ...], m: row times columns plus column."""
        col, row = np.floor(place / self.resolution).astype(np.int64)
        return np.asarray(row * len(self.index[0]) + col)

    def steps_left_in(
        self,
        cell: NDArray[np.int64],
        robots: NDArray[np.int64],
        pose: NDArray[np.float64],
        forward: float,
        backward: float,
    ) -> NDArray[np.float64]:
        """`steps_left` from poses [3, ...] whose cells are known."""
        free_cell = self.index.reshape(-1)[cell]
        ahead = self._table.reshape(-1, 3)[self.which[robots] * len(self.centers) + free_cell]
        length, direction, bends = np.moveaxis(ahead, -1, 0).astype(np.float64)
        row, col = np.divmod(cell, len(self.index[0]))
        # From the cell's center to the place itself.
        away_x = pose[0] - (col + 0.5) * self.resolution
        away_y = pose[1] - (row + 0.5) * self.resolution
        length -= away_x * np.cos(direction) + away_y * np.sin(direction)
        off = np.abs(wrapped_once(pose[2] - direction)) / self.turn
        in_reverse = np.pi / self.turn - off + np.maximum(length, 0) * (1 / backward - 1 / forward)
        return length / forward + np.minimum(off, in_reverse) + bends


def wrapped_once(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """`wrap_angle` of angles within one turn of its range, to the bit; division takes longer."""
    angle = angle + math.pi
    angle = np.where(angle >= 2 * math.pi, angle - 2 * math.pi, angle)
    return np.where(angle < 0, angle + 2 * math.pi, angle) - math.pi
