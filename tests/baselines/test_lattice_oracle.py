"""The lattice oracle that other tests compare with: by hand arithmetic and by a plain search."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from lattice_oracle import HEADINGS, UNREACHABLE, move_offsets, oracle_steps, steps_between

from sqn_jax.maps import OccupancyMap

NO_POINTS = np.empty((0, 2))


def open_room(rows: int, cols: int, resolution: float = 0.05) -> OccupancyMap:
    occupied = np.ones((rows, cols), dtype=bool)
    occupied[1:-1, 1:-1] = False
    return OccupancyMap("room", occupied, resolution, NO_POINTS, NO_POINTS)


@pytest.fixture(scope="module")
def steps() -> np.ndarray:
    """A 4 x 8 m room (80 rows, 160 columns), goal at the centre of row 40, column 130."""
    return oracle_steps(open_room(80, 160), (6.525, 2.025))


@pytest.mark.parametrize(
    ("col", "heading", "expected"),
    [
        (30, 0, 19),  # 5 m, of which 4.7 must be driven: 18.8 steps of 0.25 m
        (30, 10, 29),  # facing away: ten turns of 18 degrees first
        (30, 5, 24),  # facing north: five turns
        (30, 15, 24),  # facing south
        (130, 7, 0),  # there already
        (124, 3, 0),  # 0.3 m away is there
        (123, 0, 1),
        (123, 10, 1),  # 0.35 m, facing away: one step backwards is enough
    ],
)
def test_steps_in_an_empty_room_are_those_counted_by_hand(
    steps: np.ndarray, col: int, heading: int, expected: int
) -> None:
    assert steps[40, col, heading] == expected


def test_heading_zero_points_along_x_and_turns_to_the_left() -> None:
    # A goal straight north: from heading 5 (90 degrees) it lies ahead, from 15 (270) behind.
    north = oracle_steps(open_room(160, 80), (2.025, 6.525))
    assert north.shape == (160, 80, HEADINGS)
    assert north[30, 40, 5] == 19
    assert north[30, 40, 15] == 29


def test_offsets_are_quarter_metres_rounded_to_cells() -> None:
    forward = move_offsets(0.25, 0.05)
    # (row, col) = 5 (sin, cos) rounded: at 18 degrees (1.545, 4.755), at 36 (2.94, 4.05).
    assert forward[:6].tolist() == [[0, 5], [2, 5], [3, 4], [4, 3], [5, 2], [5, 0]]
    np.testing.assert_array_equal(forward[10:], -forward[:10])
    lengths = np.hypot(*forward.T) / 5
    assert lengths.max() == pytest.approx(1.077, abs=1e-3)
    assert lengths.min() == 1.0
    assert lengths.mean() == pytest.approx(1.031, abs=1e-3)


def plain_search(free: np.ndarray, goal: np.ndarray, moves: list[np.ndarray]) -> np.ndarray:
    """Forward breadth-first search from every state, one state at a time, sampling the segment."""
    rows, cols = free.shape

    def touched(offset: np.ndarray) -> set[tuple[int, int]]:
        # A point on an edge lies in the cells of both sides.
        ends = (0.5 + share * offset for share in np.linspace(0, 1, 601))
        sides = [np.array([i, j]) for i in (-1e-9, 1e-9) for j in (-1e-9, 1e-9)]
        points = (np.floor(end + side) for end in ends for side in sides)
        return {(int(r), int(c)) for r, c in points}

    ways = [[touched(offset) for offset in move] for move in moves]

    def drivable(row: int, col: int, way: set[tuple[int, int]]) -> bool:
        cells = [(row + i, col + j) for i, j in way]
        return all(0 <= r < rows and 0 <= c < cols and free[r, c] for r, c in cells)

    targets: dict[tuple[int, int, int], list[tuple[int, int, int]]] = {}
    for row, col in np.argwhere(free):
        for heading in range(HEADINGS):
            state = (int(row), int(col), heading)
            targets[state] = [(*state[:2], (heading + turn) % HEADINGS) for turn in (1, -1)]
            for move, way in zip(moves, ways, strict=True):
                if drivable(*state[:2], way[heading]):
                    end = state[0] + int(move[heading][0]), state[1] + int(move[heading][1])
                    targets[state].append((*end, heading))
    sources: dict[tuple[int, int, int], list[tuple[int, int, int]]] = {}
    for state, ends in targets.items():
        for end in ends:
            sources.setdefault(end, []).append(state)
    result = np.full((rows, cols, HEADINGS), UNREACHABLE)
    queue: deque[tuple[int, int, int]] = deque()
    for state in targets:
        if goal[state[0], state[1]]:
            result[state] = 0
            queue.append(state)
    while queue:
        state = queue.popleft()
        for source in sources.get(state, []):
            if result[source] == UNREACHABLE:
                result[source] = result[state] + 1
                queue.append(source)
    return result


def test_oracle_steps_agree_with_a_plain_search_among_obstacles() -> None:
    rng = np.random.default_rng(5)
    occupied = np.ones((14, 19), dtype=bool)
    occupied[1:-1, 1:-1] = rng.random((12, 17)) < 0.06
    crowded = OccupancyMap("crowded", occupied, 0.1, NO_POINTS, NO_POINTS)
    steps = oracle_steps(crowded, (1.55, 0.75), robot_radius=0.0, goal_radius=0.15)
    row, col = np.mgrid[:14, :19]
    goal = np.hypot((col + 0.5) * 0.1 - 1.55, (row + 0.5) * 0.1 - 0.75) <= 0.15
    moves = [move_offsets(0.25, 0.1), move_offsets(-0.125, 0.1)]
    expected = plain_search(~occupied, goal, moves)
    assert len(np.unique(expected)) > 10
    np.testing.assert_array_equal(steps, expected)


def test_a_thin_wall_is_not_jumped_and_the_far_side_is_unreachable() -> None:
    room = open_room(40, 80)
    room.occupied[:, 40] = True
    steps = oracle_steps(room, (3.0, 1.0), robot_radius=0.0)
    assert (steps[:, :41] == UNREACHABLE).all()
    assert (steps[5:35, 45:75] > UNREACHABLE).all()
    assert steps_between(room, (1.0, 1.0), (3.0, 1.0)) == (UNREACHABLE, float("inf"))


def test_steps_between_gives_the_fewest_and_the_mean_over_headings(steps: np.ndarray) -> None:
    fewest, mean = steps_between(open_room(80, 160), (1.51, 2.04), (6.525, 2.025))
    assert fewest == 19
    assert mean == pytest.approx(steps[40, 30].mean())
    # Turns alone cost 0..10, five on average; rounding the other headings helps a little.
    assert 22 < mean <= 24


def test_cells_too_coarse_for_the_steps_are_refused() -> None:
    with pytest.raises(ValueError, match="resolution 1 m per cell, expected at most"):
        oracle_steps(open_room(10, 12, resolution=1.0), (5.0, 5.0))
