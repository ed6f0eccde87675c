"""Free space, frames, sampled points and the checks of a map."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sqn_jax.maps import (
    OccupancyMap,
    describe,
    distance,
    points_to_cells,
    reachable_cells,
    sample_spawn_points,
    traversable,
    validate,
)
from sqn_jax.maps.check import evaluation_distances
from sqn_jax.maps.distance import goal_distance


def walled(rows: int, cols: int) -> np.ndarray:
    occupied = np.ones((rows, cols), dtype=bool)
    occupied[1:-1, 1:-1] = False
    return occupied


def room_map(**changes: object) -> OccupancyMap:
    """Two rooms, 3 m high, 2.4 m and 3.4 m wide, and a wall between them at x = 2.5 to 2.6 m."""
    occupied = walled(32, 62)
    occupied[:, 25] = True
    room = OccupancyMap(
        name="rooms",
        occupied=occupied,
        resolution=0.1,
        spawn_points=np.array([[0.5, 0.5], [2.0, 2.0]]),
        evaluation_points=np.array([[0.5, 2.5], [2.0, 0.55]]),
    )
    return dataclasses.replace(room, **changes)


def test_traversable_keeps_the_radius_from_every_square() -> None:
    occupied = walled(9, 12)
    # 0.15 m is a cell and a half: the cells next to a wall (0.05 m) are lost, the second are not.
    expected = np.zeros((9, 12), dtype=bool)
    expected[2:-2, 2:-2] = True
    np.testing.assert_array_equal(traversable(occupied, 0.1, 0.15), expected)
    np.testing.assert_array_equal(traversable(occupied, 0.1, 0.0), ~occupied)
    np.testing.assert_array_equal(traversable(occupied, 0.1, 0.05), ~occupied)


@pytest.mark.parametrize("cells", range(1, 60))
def test_a_radius_that_ends_exactly_on_a_square_still_fits(cells: int) -> None:
    # radius / resolution is not exact in binary: 0.15 / 0.05 > 3 - 1e-15 and the like.
    occupied = np.zeros((1, 80), dtype=bool)
    occupied[0, 0] = True
    free = traversable(occupied, 0.05, (cells - 0.5) * 0.05)
    assert free[0].tolist() == [False] * cells + [True] * (80 - cells)


def test_the_map_frame_is_the_grid_turned_then_shifted() -> None:
    turned = room_map(origin=(10.0, -4.0, math.pi / 2))
    # One metre along the grid's x is one metre north in the map.
    np.testing.assert_allclose(turned.to_map_frame([1.0, 0.0]), [10.0, -3.0])
    np.testing.assert_allclose(turned.to_map_frame([[0.0, 2.0]]), [[8.0, -4.0]])
    np.testing.assert_allclose(turned.to_grid_frame([8.0, -3.0]), [1.0, 2.0])


@given(
    st.tuples(*[st.floats(-100, 100)] * 2, st.floats(-7, 7)),
    st.lists(st.tuples(*[st.floats(-50, 50)] * 2), min_size=1),
)
def test_to_grid_frame_undoes_to_map_frame(
    origin: tuple[float, float, float], points: list[tuple[float, float]]
) -> None:
    frame = room_map(origin=origin)
    np.testing.assert_allclose(frame.to_grid_frame(frame.to_map_frame(points)), points, atol=1e-9)


def test_size_and_shape_tell_rows_from_columns() -> None:
    assert room_map().shape == (32, 62)
    assert room_map().size_m == pytest.approx((6.2, 3.2))
    assert points_to_cells([6.15, 0.0], 0.1).tolist() == [0, 61]


def test_a_sound_map_is_accepted() -> None:
    validate(room_map(), 0.1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"spawn_points": [[0.5, 0.5]]}, ["spawn_points", "1 given", "at least 2"]),
        ({"evaluation_points": np.empty((0, 2))}, ["evaluation_points", "0 given"]),
        ({"spawn_points": [[0.5, 0.5], [2.0, 7.0]]}, ["spawn_points[1]", "(2, 7)", "outside"]),
        ({"spawn_points": [[0.5, 0.5], [-0.01, 1.0]]}, ["spawn_points[1]", "outside"]),
        ({"spawn_points": [[1e300, 0.5], [1.0, 1.0]]}, ["spawn_points[0]", "outside"]),
        ({"spawn_points": [[1e308, -1e308], [1.0, 1.0]]}, ["spawn_points[0]", "outside"]),
        ({"spawn_points": [[math.nan, 0.5], [1.0, 1.0]]}, ["spawn_points[0]", "not finite"]),
        ({"evaluation_points": [[0.5, 0.5], [2.55, 1.0]]}, ["evaluation_points[1]", "obstacle"]),
        ({"evaluation_points": [[0.5, 0.5], [2.45, 1.0]]}, ["evaluation_points[1]", "too near"]),
        ({"evaluation_points": [[4.0, 1.0], [1.0, 1.0]]}, ["evaluation_points[0]", "reached from"]),
        ({"occupied": np.ones((32, 62), dtype=bool)}, ["no free space"]),
    ],
)
def test_an_unusable_map_is_refused_with_the_point_named(
    changes: dict[str, object], words: list[str]
) -> None:
    changes = {name: np.asarray(value) for name, value in changes.items()}
    with pytest.raises(ValueError, match="rooms") as caught:
        validate(room_map(**changes), 0.1)
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_a_gap_narrower_than_the_robot_does_not_join_two_rooms() -> None:
    occupied = room_map().occupied.copy()
    occupied[10:12, 25] = False
    both = {"evaluation_points": np.array([[0.5, 0.5], [4.0, 1.0]]), "occupied": occupied}
    validate(room_map(**both), 0.04)
    with pytest.raises(ValueError, match="cannot be reached"):
        validate(room_map(**both), 0.12)


def test_reachable_cells_are_the_room_of_the_spawn_points() -> None:
    expected = np.zeros((32, 62), dtype=bool)
    expected[1:-1, 1:25] = True
    np.testing.assert_array_equal(reachable_cells(room_map(), 0.0), expected)


def test_sampled_points_are_spread_over_the_largest_region() -> None:
    occupied = room_map().occupied
    points = sample_spawn_points(occupied, 0.1, 0.1)
    assert points.shape == (16, 2)
    # The right-hand room is larger: x from 2.6 to 6.1 m.
    assert (points[:, 0] > 2.6).all()
    validate(
        dataclasses.replace(room_map(), spawn_points=points, evaluation_points=points[:4]), 0.1
    )
    gaps = np.linalg.norm(points[:, None] - points[None], axis=-1) + 9 * np.eye(16)
    assert gaps.min() > 0.3
    np.testing.assert_array_equal(points, sample_spawn_points(occupied, 0.1, 0.1))


def test_the_first_sampled_points_lie_at_the_ends_of_a_corridor() -> None:
    points = sample_spawn_points(walled(7, 203), 0.1, 0.1)
    assert sorted(points[:2, 0]) == pytest.approx([0.35, 19.95], abs=0.3)
    assert points[:, 1] == pytest.approx(0.35)


def test_no_room_for_the_robot_is_an_error_not_an_empty_list() -> None:
    with pytest.raises(ValueError, match="no free space"):
        sample_spawn_points(walled(5, 9), 0.1, 0.3)


def test_the_report_names_what_a_person_asks_for() -> None:
    report = describe(room_map(origin=(1.0, 2.0, 0.0), warnings=("grey looks odd",)), 0.1)
    assert "6.20 x 3.20 m" in report
    assert "62 x 32 cells" in report
    assert "components     2" in report
    assert "grey looks odd" in report
    # From (0.5, 2.5) to (2.0, 0.55) the way is straight: hypot(1.5, 1.95) = 2.46 m.
    line = next(line for line in report.splitlines() if line.startswith("  1 - 2"))
    assert float(line.split()[3]) == pytest.approx(2.46, rel=0.02)
    assert float(line.split()[5]) == pytest.approx(2.46, abs=0.005)
    assert "max_steps is" not in report
    assert "max_steps is 5" in describe(room_map(max_steps=5), 0.1)


@pytest.mark.parametrize(("x", "is_warned"), [(1.0, True), (1.25, True), (1.35, False)])
def test_evaluation_points_within_the_goal_radius_of_each_other_are_warned_of(
    x: float, is_warned: bool
) -> None:
    report = describe(room_map(evaluation_points=np.array([[2.0, 2.5], [1.0, 1.0], [x, 1.0]])), 0.1)
    apart = f"evaluation points 2 and 3 are {x - 1:.2f} m apart, less than the goal radius of 0.3 m"
    assert (apart in report) == is_warned
    assert "nan" not in report


def test_the_report_holds_few_distance_fields_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    # Nine points in the open: no way is shorter than the line, and none much longer.
    points = np.stack(np.meshgrid([0.5, 1.2, 2.1], [0.5, 1.5, 2.5]), axis=-1).reshape(-1, 2)
    at_once = []

    def counted(free: np.ndarray, resolution: float, goals: np.ndarray) -> np.ndarray:
        at_once.append(len(goals))
        return goal_distance(free, resolution, goals)

    monkeypatch.setattr(distance, "goal_distance", counted)
    monkeypatch.setattr(distance, "FIELD_CELLS", 2 * 32 * 62)
    geodesic, straight = evaluation_distances(room_map(evaluation_points=points))
    assert at_once == [2, 2, 2, 2, 1]
    expected = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    np.testing.assert_allclose(straight, expected)
    # A way begins at the centre of a cell: up to half its diagonal off.
    np.testing.assert_allclose(geodesic, expected, rtol=0.02, atol=0.08)
