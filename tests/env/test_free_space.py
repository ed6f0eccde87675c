"""The table of free rectangles behind the ray casting."""

from __future__ import annotations

import numpy as np
import pytest
from grid_oracle import open_map
from hypothesis import given
from hypothesis import strategies as st

from sqn_jax.env.free_space import far_sides, free_rectangles

QUADRANTS = ((1, 1), (1, -1), (-1, -1), (-1, 1))  # (step in rows, step in columns)


@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(3, 17),
    columns=st.integers(3, 17),
    density=st.sampled_from([0.0, 0.05, 0.2, 0.6]),
    per_quadrant=st.integers(1, 4),
    reach=st.integers(1, 20),
)
def test_every_rectangle_is_free_and_has_its_cell_in_the_near_corner(
    seed: int, rows: int, columns: int, density: float, per_quadrant: int, reach: int
) -> None:
    blocked = open_map(rows, columns)
    blocked |= np.random.default_rng(seed).random(blocked.shape) < density
    table = free_rectangles(blocked, 4 * per_quadrant, reach)
    assert table.shape == (4 * per_quadrant, rows, columns)
    np.testing.assert_array_equal(table > 0, np.broadcast_to(~blocked, table.shape))
    for sector, row, column in np.argwhere(table):
        width, height = divmod(int(table[sector, row, column]), 256)[::-1]
        assert width >= 1
        assert height >= 1
        step_row, step_column = QUADRANTS[sector // per_quadrant]
        far_row, far_column = row + step_row * (height - 1), column + step_column * (width - 1)
        # Indices below zero would wrap around.
        assert min(far_row, far_column) >= 0
        assert far_row < rows
        assert far_column < columns
        inside = blocked[
            min(row, far_row) : max(row, far_row) + 1,
            min(column, far_column) : max(column, far_column) + 1,
        ]
        assert not inside.any()


@pytest.mark.parametrize(("sector", "step"), list(enumerate(QUADRANTS)))
def test_rectangles_of_an_empty_map_reach_its_walls(sector: int, step: tuple[int, int]) -> None:
    # Free rows 1..38 and columns 1..58; one sector a quadrant, so the rectangles are square.
    table = free_rectangles(open_map(40, 60), 4, 100)
    width, height = divmod(int(table[sector, 10, 15]), 256)[::-1]
    rows_left = 29 if step[0] > 0 else 10
    columns_left = 44 if step[1] > 0 else 15
    assert min(rows_left, columns_left) - 2 <= width <= columns_left
    assert min(rows_left, columns_left) - 2 <= height <= rows_left


def test_rectangles_lie_along_their_sector() -> None:
    # 36 sectors of 10 degrees; towards 5 degrees wide and low, towards 85 degrees the reverse.
    table = free_rectangles(open_map(200, 200), 36, 100)
    width, height = divmod(int(table[0, 50, 50]), 256)[::-1]
    assert width > 5 * height
    width, height = divmod(int(table[8, 50, 50]), 256)[::-1]
    assert height > 5 * width
    # Sector 9, 90 to 100 degrees, is steep too; sector 17, 170 to 180 degrees, is flat.
    width, height = divmod(int(table[9, 50, 150]), 256)[::-1]
    assert height > 5 * width
    width, height = divmod(int(table[17, 50, 150]), 256)[::-1]
    assert width > 5 * height


@pytest.mark.parametrize("per_quadrant", [1, 2, 3])
def test_no_rectangle_takes_rays_less_far_than_the_strip_along_a_wall(per_quadrant: int) -> None:
    blocked = open_map(14, 19)
    blocked |= np.random.default_rng(per_quadrant).random(blocked.shape) < 0.15
    table = free_rectangles(blocked, 4 * per_quadrant, 20)
    # On average over three slopes, in the middle of each third of the sector.
    thirds = (np.array([1, 3, 5]) / 6)[:, None]
    for sector, row, column in np.argwhere(table):
        angles = (sector + thirds) * (np.pi / 2 / per_quadrant)
        cosines, sines = np.abs(np.cos(angles)), np.abs(np.sin(angles))
        step_row, step_column = QUADRANTS[sector // per_quadrant]
        wide = int(np.argmax(blocked[row, column::step_column]))
        high = int(np.argmax(blocked[row::step_row, column]))
        width, height = divmod(int(table[sector, row, column]), 256)[::-1]
        sizes = np.array([[width, wide, 1], [height, 1, high]])
        ours, *strips = np.minimum(sizes[0] / cosines, sizes[1] / sines).sum(axis=0)
        assert ours >= max(strips) - 1e-4


@pytest.mark.parametrize(
    ("sectors", "reach", "message"),
    [(0, 10, "sectors"), (6, 10, "sectors"), (8, 0, "reach"), (8, 251, "reach")],
)
def test_a_table_out_of_bounds_is_refused(sectors: int, reach: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        free_rectangles(open_map(5, 6), sectors, reach)


@pytest.mark.parametrize("cell", [(0, 2), (-1, 2), (2, 0), (2, -1)])
def test_an_open_border_is_refused(cell: tuple[int, int]) -> None:
    blocked = open_map(5, 6)
    blocked[cell] = False
    with pytest.raises(ValueError, match="border"):
        free_rectangles(blocked, 8, 10)


def test_far_sides_are_counted_from_the_cell_in_the_direction_of_the_sector() -> None:
    # One cell, four quadrants: 5 columns wide and 3 rows high, seen from its near corner.
    rectangles = np.full((4, 1, 1), 5 + 256 * 3, np.uint16)
    sides = far_sides(rectangles).astype(np.int16).reshape(4)
    columns, rows = (sides << 8).astype(np.int16) >> 8, sides >> 8
    # Forward, the far side is that many sides on; backward, the cell's own side counts as one.
    assert columns.tolist() == [5, -4, -4, 5]
    assert rows.tolist() == [3, 3, -2, -2]


def test_a_blocked_cell_has_its_near_sides_and_is_zero_in_the_first_sector_alone() -> None:
    sides = far_sides(np.zeros((4, 1, 1), np.uint16)).reshape(4)
    columns, rows = (sides << 8).astype(np.int16) >> 8, sides >> 8
    assert columns.tolist() == [0, 1, 1, 0]
    assert rows.tolist() == [0, 0, 1, 1]
    longest = far_sides(np.full((4, 1, 1), 127 + 256 * 127, np.uint16)).reshape(4)
    assert (longest[0] & 255, longest[0] >> 8) == (127, 127)
    assert ((longest[2] << 8).astype(np.int16) >> 8, longest[2] >> 8) == (-126, -126)
