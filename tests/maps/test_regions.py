"""Which region of a map is taken, what is cut off around it, and what is said about both."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from map_files import write_room

from sqn_jax.maps import (
    OccupancyMap,
    load_map,
    points_to_cells,
    reachable_cells,
    step_warning,
    traversable,
)
from sqn_jax.maps.check import evaluation_distances
from sqn_jax.maps.distance import grid_path

Room = Callable[..., Path]

# Two rooms of 8 x 9 m and 3.9 x 9 m with a wall between them at x = 8.0 to 8.1 m.
HALVES = np.full((90, 120), 254, dtype=np.uint8)
HALVES[:, 80] = 0


def x_of_points(path: Path) -> tuple[float, float]:
    """The smallest and the largest x of the sampled points, m in the map frame."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = load_map(path)
    x = loaded.to_map_frame(loaded.spawn_points)[:, 0]
    return float(x.min()), float(x.max())


@pytest.mark.parametrize(
    ("origin", "fields", "is_right"),
    [
        ("[-10.0, -4.0, 0.0]", {}, True),  # (0, 0) lies in the smaller room,
        ("[-4.0, -4.0, 0.0]", {}, False),  # in the larger,
        ("[-8.05, -4.0, 0.0]", {}, False),  # in the wall,
        ("[0.0, 0.0, 0.0]", {}, False),  # in the corner,
        ("[50.0, 50.0, 0.0]", {}, False),  # nowhere.
        ("[-4.0, -4.0, 0.0]", {"region": "[6.0, 1.0]"}, True),
        ("[-10.0, -4.0, 0.0]", {"region": "[-9.0, 1.0]"}, False),
        ("[0.0, 0.0, 0.0]", {"evaluation_points": "[[9.0, 1.0], [10.0, 5.0]]"}, True),
    ],
)
def test_points_are_sampled_in_the_region_that_is_meant(
    room: Room, origin: str, fields: dict[str, str], is_right: bool
) -> None:
    low, high = x_of_points(room(grey=HALVES, origin=origin, **fields))
    wall = float(origin[1:].split(",")[0]) + 8.0
    assert low > wall if is_right else high < wall


def test_a_nook_at_the_origin_is_not_taken(room: Room) -> None:
    grey = HALVES.copy()
    grey[20:41, 95:116] = 0
    grey[25:36, 100:111] = 254  # 1.1 x 1.1 m around (10.55, 5.95).
    assert x_of_points(room(grey=grey, origin="[-10.55, -5.95, 0.0]"))[1] < -2.55


def test_ground_elsewhere_is_worth_a_line_whose_advice_works(room: Room) -> None:
    with pytest.warns(
        UserWarning, match=r"room\.yaml: 32% of the free ground lies outside"
    ) as said:
        load_map(room(grey=HALVES))
    (line,) = (str(warning.message) for warning in said)
    region = line.partition("region: ")[2].partition(" in the YAML")[0]
    assert x_of_points(room(grey=HALVES, region=region))[0] > 8.0


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ("[8.05, 1.0]", "(8.05, 1) is no place"),
        ("[99.0, 1.0]", "(99, 1) is no place"),
        ("[1.0]", "[x m, y m]"),
        ("here", "[x m, y m]"),
        ("[1e300, 1.0]", "1e+09"),
        ("[9.0, 1.0]", "cannot be reached from spawn_points[0]"),
    ],
)
def test_a_region_that_is_none_is_refused(room: Room, region: str, words: str) -> None:
    path = room(grey=HALVES, region=region, spawn_points="[[1, 1], [2, 2]]")
    with pytest.raises(ValueError, match=r"room\.yaml: region") as caught:
        load_map(path)
    assert words in str(caught.value)


def vast(free: tuple[slice, slice]) -> np.ndarray:
    """30 x 25 m of unknown ground, of which a part is free."""
    grey = np.full((250, 300), 205, dtype=np.uint8)
    grey[free] = 254
    return grey


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_what_no_robot_can_see_is_cut_off_and_coordinates_stay(room: Room, yaw: float) -> None:
    # Free: x 8.0 to 12.0 m, y 25 - 9.0 = 16.0 to 18.0 m of the grid; 5 m around them stay.
    grey = vast((slice(70, 90), slice(80, 120)))
    path = room(grey=grey, origin=f"[-3.0, 7.0, {yaw!r}]")
    with pytest.warns(UserWarning, match="300 x 250 cells cut to the 140 x 120 within 5 m"):
        cut = load_map(path)
    whole = OccupancyMap("", grey[::-1] < 254, 0.1, *[np.empty((0, 2))] * 2, (-3.0, 7.0, yaw))
    rng = np.random.default_rng(0)
    for point in rng.uniform((3.05, 11.05), (16.95, 22.95), (200, 2)):
        in_map = whole.to_map_frame(point)
        cell = tuple(points_to_cells(cut.to_grid_frame(in_map), 0.1))
        assert cut.occupied[cell] == whole.occupied[tuple(points_to_cells(point, 0.1))]
    assert (~cut.occupied).sum() == 20 * 40
    np.testing.assert_array_equal(cut.unknown, cut.occupied)
    np.testing.assert_allclose(cut.to_grid_frame(whole.to_map_frame([3.0, 11.0])), 0, atol=1e-9)


def test_another_region_is_cut_off_but_not_what_can_be_seen_through_a_gap(room: Room) -> None:
    grey = vast((slice(10, 40), slice(10, 40)))
    grey[200:240, 250:290] = 254
    with pytest.warns(UserWarning, match="100 x 100 within|of the free ground lies") as said:
        assert load_map(room(grey=grey)).shape == (100, 100)
    elsewhere, cut = (str(warning.message) for warning in said)
    assert "of the free ground lies outside" in elsewhere
    assert "cut to the 100 x 100 within" in cut
    # A slit that is too narrow for the robot, but not for its rays.
    grey[220, 20:250] = grey[30:221, 20] = 254
    with pytest.warns(UserWarning, match="of the free ground lies outside"):
        assert load_map(room(grey=grey)).shape == (250, 300)


def test_a_point_of_the_file_that_cannot_be_seen_lies_in_an_obstacle_not_outside(
    room: Room,
) -> None:
    grey = vast((slice(70, 90), slice(80, 120)))
    path = room(grey=grey, evaluation_points="[[10.0, 17.0], [28.0, 2.0]]")
    with pytest.raises(ValueError, match=r"evaluation_points\[1\].*28.*2.*obstacle"):
        load_map(path)


def test_a_map_of_which_half_is_left_is_not_cut(room: Room) -> None:
    assert load_map(room(grey=vast((slice(30, 220), slice(30, 270))))).shape == (250, 300)


def maze_like(seed: int) -> np.ndarray:
    free = np.random.default_rng(seed).random((17, 23)) < 0.7
    free[8] = True
    return free


@pytest.mark.parametrize("seed", range(4))
def test_a_path_along_rows_and_columns_is_the_shortest(seed: int) -> None:
    free = maze_like(seed)
    start = np.array([8, 3])
    # Relaxation until nothing changes.
    steps = np.full(free.shape, np.inf)
    steps[tuple(start)] = 0
    for _ in range(free.size):
        padded = np.pad(steps, 1, constant_values=np.inf)
        around = [padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]]
        steps = np.where(free, np.minimum(steps, np.min(around, axis=0) + 1), np.inf)
    cells = np.argwhere(free)
    expected = np.where(np.isfinite(steps), steps, 0)[tuple(cells.T)]
    np.testing.assert_array_equal(grid_path(free, start, cells), expected)


def test_a_limit_too_short_for_the_longest_path_is_named() -> None:
    occupied = np.ones((32, 202), dtype=bool)
    occupied[1:-1, 1:-1] = False
    points = np.array([[0.55, 0.55], [19.55, 2.55]])
    corridor = OccupancyMap("hall", occupied, 0.1, points, points, max_steps=0)
    geodesic, _ = evaluation_distances(corridor)
    # Less 0.3 m, where the goal is reached.
    steps = math.ceil((geodesic.max() - 0.3) / 0.25)
    for limit, is_short in ((steps - 1, True), (steps, False), (steps + 20, False)):
        line = step_warning(
            OccupancyMap("hall", occupied, 0.1, points, points, max_steps=limit), 0.1, 0.25, 0.3
        )
        assert (line is not None) == is_short
        if line is not None:
            assert f"max_steps is {limit}," in line
            assert f"at least {steps} steps" in line


def test_the_taken_region_is_one_a_robot_fits_in(tmp_path: Path) -> None:
    loaded = load_map(write_room(tmp_path, grey=HALVES, region="[9.0, 1.0]"))
    free = traversable(loaded.occupied, 0.1, 0.1)
    used = reachable_cells(loaded, 0.1)
    assert used.sum() < free.sum() / 2
