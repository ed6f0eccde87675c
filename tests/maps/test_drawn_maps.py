"""Column, Forest and Cave as drawn: their files, and what they ask of a robot.

That the files are what the script draws is tested for all maps in test_maze.py.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from lattice_oracle import steps_between
from map_shapes import cell_of, fill_of_hull, inner_obstacles, is_closed, standing_room
from numpy.typing import NDArray
from scipy import ndimage, spatial

from sqn_jax.maps import OccupancyMap, goal_distance, load_map

NAMES = ("column", "forest", "cave")
FORK = (35.0, 31.0)  # m; from the upper left corner 35 m to the right and 20 m down

loaded = cache(load_map)


def away_from(shape: tuple[int, int], point: tuple[float, float]) -> NDArray[np.float64]:
    """Distance [H, W] in m from every cell's centre to a point (x, y)."""
    row, col = np.mgrid[: shape[0], : shape[1]]
    return np.hypot((col + 0.5) * 0.05 - point[0], (row + 0.5) * 0.05 - point[1])


@pytest.mark.parametrize("name", NAMES)
def test_a_drawn_map_is_one_closed_region_with_its_points_in_it(name: str) -> None:
    drawn = loaded(name)
    side = 1020 if name == "cave" else 340
    assert (drawn.name, drawn.shape, drawn.resolution) == (name, (side, side), 0.05)
    assert drawn.max_steps == (1200 if name == "cave" else 400)
    assert drawn.warnings == ()
    assert is_closed(drawn.occupied)
    free = standing_room(drawn.occupied)
    assert ndimage.label(free)[1] == 1
    assert ndimage.label(~drawn.occupied)[1] == 1
    assert len(drawn.evaluation_points) == 2
    for point in (*drawn.spawn_points, *drawn.evaluation_points):
        assert free[cell_of(point)]


@pytest.mark.parametrize(
    ("name", "count", "widest"), [("column", 40, 3), ("forest", 40, 3), ("cave", 100, 4)]
)
def test_spawn_points_are_spread_over_the_map(name: str, count: int, widest: float) -> None:
    drawn = loaded(name)
    assert len(drawn.spawn_points) == count
    tree = spatial.KDTree(drawn.spawn_points)
    assert tree.query(drawn.spawn_points, 2)[0][:, 1].min() > 1.0
    row, col = np.nonzero(standing_room(drawn.occupied))
    assert tree.query((np.stack([col, row], axis=1)[::7] + 0.5) * 0.05)[0].max() < widest


@pytest.mark.parametrize(
    ("name", "start", "goal", "least"),
    [
        ("column", (1.5, 15.5), (15.5, 1.5), 82),
        ("forest", (1.5, 1.5), (15.5, 15.5), 92),
        ("cave", (5.0, 6.0), (46.0, 46.0), 485),
    ],
)
def test_from_start_to_goal_the_oracle_needs_so_many_steps(
    name: str, start: tuple[float, float], goal: tuple[float, float], least: int
) -> None:
    drawn = loaded(name)
    np.testing.assert_allclose(drawn.evaluation_points, [start, goal], atol=0.06)
    # The oracle's grid may gain or lose a step or two; the ranges are what the map is drawn for.
    fewest, _ = steps_between(drawn, *drawn.evaluation_points)
    low, high = (380, 520) if name == "cave" else (70, 100)
    assert low <= fewest <= high
    assert fewest == pytest.approx(least, abs=3)


def where_greed_ends(drawn: OccupancyMap) -> float:
    """m from the goal to where a robot stops that moves to a cell nearer to the goal while any is.

    It looks 0.25 m ahead, so it slides along walls and round corners but leaves no pocket.
    """
    free = standing_room(drawn.occupied)
    start, goal = (np.array(cell_of(point)) for point in drawn.evaluation_points)
    offsets = np.argwhere(np.ones((11, 11))) - 5
    place = start
    while True:
        near = place + offsets
        near = near[free[near[:, 0], near[:, 1]]]
        best = near[np.hypot(*(near - goal).T).argmin()]
        if np.hypot(*(best - goal)) >= np.hypot(*(place - goal)):
            return float(np.hypot(*(place - goal)) * 0.05)
        place = best


def test_heading_straight_for_the_goal_is_trapped_by_asterisks_not_by_pillars() -> None:
    assert where_greed_ends(loaded("column")) < 0.3
    assert where_greed_ends(loaded("forest")) > 5.0
    assert where_greed_ends(loaded("cave")) > 5.0


def test_column_has_round_pillars_of_many_sizes_and_an_open_middle() -> None:
    occupied = loaded("column").occupied
    pillars = inner_obstacles(occupied)
    assert len(pillars) == 26
    for cells in pillars:
        assert fill_of_hull(cells) > 0.85
        height, width = np.ptp(cells, axis=0) + 1
        assert abs(height - width) <= 1
        assert len(cells) == pytest.approx(np.pi / 4 * height * width, rel=0.15)
    assert len({len(cells) // 40 for cells in pillars}) >= 6
    assert away_from(occupied.shape, (8.5, 8.5))[occupied].min() > 3.5


def test_forest_has_asterisks_with_pockets() -> None:
    asterisks = inner_obstacles(loaded("forest").occupied)
    assert len(asterisks) == 14
    for cells in asterisks:
        assert fill_of_hull(cells) < 0.65
        assert np.ptp(cells, axis=0).min() * 0.05 > 1.5


def test_the_cave_forks_into_the_way_to_the_goal_and_a_long_dead_end() -> None:
    cave = loaded("cave")
    free = standing_room(cave.occupied)
    assert free[cell_of(FORK)]
    start, goal = (cell_of(point) for point in cave.evaluation_points)
    away = away_from(cave.shape, FORK)
    labels, _ = ndimage.label(free & (away > 3.0))
    # The three ways off the fork, not the crannies that the disc cuts off.
    rim = labels[(away > 3.0) & (away < 3.2) & free]
    ways = [label for label in np.unique(rim) if (labels == label).sum() * 0.05**2 > 5]
    assert len(ways) == 3
    assert labels[start] in ways
    assert labels[goal] in ways
    assert labels[start] != labels[goal]
    (dead_end,) = set(ways) - {labels[start], labels[goal]}
    from_fork = goal_distance(free, 0.05, FORK)
    from_goal = away_from(cave.shape, tuple(cave.evaluation_points[1]))
    deepest = np.where(labels == dead_end, from_fork, 0).argmax()
    assert from_fork.flat[deepest] > 15
    # It leads towards the goal, but for the rock between; the way that gets there leads off.
    assert from_goal.flat[deepest] < 8 < from_goal[cell_of(FORK)]
    right_way = (labels == labels[goal]) & (from_fork < 8)
    wrong_way = (labels == dead_end) & (from_fork < 8)
    assert from_goal[wrong_way].mean() < from_goal[right_way].mean()


def test_the_cave_is_a_network_of_tunnels_with_rough_walls() -> None:
    cave = loaded("cave")
    clearance = ndimage.distance_transform_edt(~cave.occupied) * 0.05
    assert clearance.max() < 3.5
    ridge = (clearance == ndimage.maximum_filter(clearance, 21)) & (clearance > 0.4)
    assert 1.0 <= np.median(clearance[ridge]) <= 2.0
    # From end to end there is room for a body more than ten cells wide.
    wide, _ = ndimage.label(clearance > 0.3)
    start, goal = (cell_of(point) for point in cave.evaluation_points)
    assert wide[start] == wide[goal] > 0
    # Rough: the walls are well longer than those of the same tunnels seen through a 0.8 m blur.
    blurred = ndimage.gaussian_filter(cave.occupied.astype(float), 0.8 / 0.05) > 0.5
    assert wall_length(cave.occupied) > 1.2 * wall_length(blurred)


def wall_length(occupied: NDArray[np.bool_]) -> int:
    """Sides of cells between an occupied and a free one."""
    return sum(int(np.abs(np.diff(occupied.astype(int), axis=axis)).sum()) for axis in (0, 1))


def test_the_cave_has_many_ends() -> None:
    cave = loaded("cave")
    free = standing_room(cave.occupied)
    from_start = goal_distance(free, 0.05, cave.evaluation_points[0])
    from_start = np.where(free, from_start, -1)[::4, ::4]
    ends = 0
    for least in np.arange(0, from_start.max(), 2.0):
        labels, count = ndimage.label(from_start > least, np.ones((3, 3)))
        farthest = ndimage.maximum(from_start, labels, range(1, count + 1))
        # Going on, each end stands alone for its last few metres, and is counted at one of them.
        ends += ((farthest - least >= 4) & (farthest - least < 6)).sum()
    # The goal and five dead ends.
    assert ends == 6
