"""Distance fields against brute force over all cells, and against the straight line."""

from __future__ import annotations

import heapq
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sqn_jax.maps.distance import (
    clear_moves,
    goal_distance,
    is_clear,
    obstacle_distance,
    segment_cells,
)


def random_grid(seed: int, share: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = rng.integers(2, 14), rng.integers(15, 25)
    return rng.random(shape) < share


def brute_obstacle_distance(occupied: np.ndarray, resolution: float) -> np.ndarray:
    """Point to square, one pair at a time, in metres."""
    result = np.full(occupied.shape, math.inf)
    squares = [(c * resolution, r * resolution) for r, c in np.argwhere(occupied)]
    for row, col in np.ndindex(occupied.shape):
        x, y = (col + 0.5) * resolution, (row + 0.5) * resolution
        for left, bottom in squares:
            dx = max(left - x, 0.0, x - left - resolution)
            dy = max(bottom - y, 0.0, y - bottom - resolution)
            result[row, col] = min(result[row, col], math.hypot(dx, dy))
    return result


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), share=st.floats(0.005, 0.4))
def test_obstacle_distance_is_the_distance_to_the_nearest_square(seed: int, share: float) -> None:
    occupied = random_grid(seed, share)
    expected = brute_obstacle_distance(occupied, 0.07)
    np.testing.assert_allclose(obstacle_distance(occupied, 0.07), expected, rtol=1e-6)


def test_the_nearest_centre_is_not_always_the_nearest_square() -> None:
    # Seen from (0, 0): centres at 7.071 (5, 5) and 7 (7, 0) cells, squares at 6.364 and 6.5.
    occupied = np.zeros((9, 8), dtype=bool)
    occupied[5, 5] = occupied[0, 7] = True
    assert obstacle_distance(occupied, 1.0)[0, 0] == pytest.approx(4.5 * math.sqrt(2))


@settings(max_examples=80)
@given(seed=st.integers(0, 10**6), share=st.floats(0, 0.4), radius=st.floats(-1, 40))
def test_cells_are_clear_that_are_free_and_far_enough(
    seed: int, share: float, radius: float
) -> None:
    occupied = random_grid(seed, share)
    expected = ~occupied & (brute_obstacle_distance(occupied, 1.0) >= radius)
    np.testing.assert_array_equal(is_clear(occupied, radius), expected)


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.5, math.hypot(1.5, 0.5), 2.5, math.hypot(2.5, 2.5)])
def test_a_cell_exactly_as_far_away_is_clear(radius: float) -> None:
    """Exact ties, which a search among random radii hardly ever meets."""
    occupied = np.zeros((9, 11), dtype=bool)
    occupied[4, 5] = True
    away = brute_obstacle_distance(occupied, 1.0)
    assert (away == radius).any()
    np.testing.assert_array_equal(is_clear(occupied, radius), ~occupied & (away >= radius))


def touches(x0: float, y0: float, x1: float, y1: float, row: int, col: int) -> bool:
    """Whether a segment meets the closed unit square centred on (col, row): clipping by slabs."""
    low, high = 0.0, 1.0
    for start, end, middle in ((x0, x1, col), (y0, y1, row)):
        if start == end:
            if abs(start - middle) > 0.5:
                return False
            continue
        a, b = (middle - 0.5 - start) / (end - start), (middle + 0.5 - start) / (end - start)
        low, high = max(low, min(a, b)), min(high, max(a, b))
    return low <= high + 1e-12


@pytest.mark.parametrize("d_row", range(-5, 6))
@pytest.mark.parametrize("d_col", [-5, -2, 0, 1, 3])
def test_a_segment_touches_the_cells_that_clipping_finds(d_row: int, d_col: int) -> None:
    expected = {
        (row, col)
        for row in range(-7, 8)
        for col in range(-7, 8)
        if touches(0, 0, d_col, d_row, row, col)
        and min(0, d_row) <= row <= max(0, d_row)
        and min(0, d_col) <= col <= max(0, d_col)
    }
    found = segment_cells(d_row, d_col)
    assert len(found) == len(set(found))
    assert set(found) == expected


def test_a_move_off_the_map_or_past_a_corner_is_not_clear() -> None:
    free = np.ones((3, 5), dtype=bool)
    free[1, 2] = False
    clear = clear_moves(free, 1, 1)
    # From (0, 1) and (1, 1) the diagonal touches (1, 2); row 2 and column 4 lead off the map.
    expected = [[1, 0, 0, 1, 0], [1, 0, 0, 1, 0], [0, 0, 0, 0, 0]]
    np.testing.assert_array_equal(clear, np.array(expected, dtype=bool))


@pytest.mark.parametrize("goal", [(1.025, 0.525), (3.7, 1.2), (0.06, 0.06), (2.0, 1.0)])
def test_goal_distance_in_an_empty_room_is_within_two_per_cent_of_the_straight_line(
    goal: tuple[float, float],
) -> None:
    free = np.ones((40, 90), dtype=bool)
    distance = goal_distance(free, 0.05, goal)
    row, col = np.mgrid[:40, :90]
    straight = np.hypot((col + 0.5) * 0.05 - goal[0], (row + 0.5) * 0.05 - goal[1])
    assert (distance >= straight - 1e-6).all()
    assert (distance <= 1.02 * straight + 1e-6).all()


def brute_visibility_distance(free: np.ndarray, goal: tuple[int, int]) -> np.ndarray:
    """Shortest way between cell centres that see each other: Dijkstra over all pairs, in cells."""
    cells = [tuple(cell) for cell in np.argwhere(free)]
    blocked = [tuple(cell) for cell in np.argwhere(~free)]

    def sees(a: tuple[int, int], b: tuple[int, int]) -> bool:
        return not any(
            min(a[0], b[0]) <= r <= max(a[0], b[0])
            and min(a[1], b[1]) <= c <= max(a[1], b[1])
            and touches(a[1], a[0], b[1], b[0], r, c)
            for r, c in blocked
        )

    best = np.full(free.shape, math.inf)
    best[goal] = 0.0
    queue = [(0.0, goal)]
    while queue:
        length, cell = heapq.heappop(queue)
        if length > best[cell]:
            continue
        for other in cells:
            further = length + math.dist(cell, other)
            if further < best[other] - 1e-12 and sees(cell, other):
                best[other] = further
                heapq.heappush(queue, (further, other))
    return best


@pytest.mark.parametrize("seed", range(6))
def test_goal_distance_is_close_to_the_shortest_way_between_obstacles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    free = rng.random((7, 12)) > 0.25
    goal = tuple(np.argwhere(free)[rng.integers(free.sum())])
    expected = brute_visibility_distance(free, goal)
    distance = goal_distance(free, 0.2, [(goal[1] + 0.5) * 0.2, (goal[0] + 0.5) * 0.2]) / 0.2
    np.testing.assert_array_equal(np.isinf(distance), np.isinf(expected))
    reached = np.isfinite(expected)
    assert (distance[reached] >= expected[reached] - 1e-5).all()
    # One way in tight clutter may be off by more than the grid is in the open; all in all little.
    assert (distance[reached] <= 1.1 * expected[reached] + 1e-5).all()
    assert distance[reached].sum() <= 1.03 * expected[reached].sum()


def test_goal_distance_goes_round_a_wall_and_never_through_a_corner() -> None:
    free = np.ones((6, 9), dtype=bool)
    free[:5, 4] = False
    distance = goal_distance(free, 1.0, (2.5, 0.5))
    # By hand: up from (2, 0) to (3, 5), across to (5, 5), down to (6, 0), each end a cell centre.
    assert distance[0, 6] == pytest.approx(2 * math.hypot(1, 5) + 2, rel=0.02)
    free[5, 4] = False
    assert np.isinf(goal_distance(free, 1.0, (2.5, 0.5))[:, 5:]).all()
    # Two free cells that meet at a corner are not joined.
    diagonal = np.eye(2, dtype=bool)
    assert np.isinf(goal_distance(diagonal, 1.0, (0.5, 0.5))[1, 1])


def test_several_goals_give_what_each_gives_alone() -> None:
    free = ~random_grid(3, 0.1)
    goals = (np.argwhere(free)[[4, 40, 90]][:, ::-1] + 0.3) * 0.05
    together = goal_distance(free, 0.05, goals)
    assert together.shape == (3, *free.shape)
    assert together.dtype == np.float32
    for goal, distance in zip(goals, together, strict=True):
        np.testing.assert_allclose(distance, goal_distance(free, 0.05, goal))


@pytest.mark.parametrize("goal", [(-0.1, 0.2), (0.2, 9.0), (0.25, 0.25), (math.nan, 0.2)])
def test_a_goal_off_the_map_or_in_an_obstacle_is_refused(goal: tuple[float, float]) -> None:
    free = np.ones((10, 12), dtype=bool)
    free[2, 2] = False
    with pytest.raises(ValueError, match=r"goal .* expected"):
        goal_distance(free, 0.1, goal)
