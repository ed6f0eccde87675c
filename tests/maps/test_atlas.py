"""Maps side by side: each is still the one it was."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from sqn_jax.maps import OccupancyMap, load_map, reachable_cells, validate
from sqn_jax.maps.atlas import side_by_side
from sqn_jax.maps.generate import generate


@pytest.fixture(scope="module")
def maps() -> list[OccupancyMap]:
    return [load_map("maze"), *(generate("maze", seed) for seed in range(4))]


@pytest.fixture(scope="module")
def atlas(maps: list[OccupancyMap]) -> OccupancyMap:
    return side_by_side(maps, "five")


def tile(atlas: OccupancyMap, index: int) -> tuple[slice, slice, np.ndarray]:
    """Rows, columns and lower left corner of a tile of 340 x 340 cells, worked out here."""
    row, column = index // 3, index % 3
    rows, columns = slice(340 * row, 340 * row + 340), slice(340 * column, 340 * column + 340)
    return rows, columns, np.array([17.0 * column, 17.0 * row])


def test_every_map_lies_in_its_tile_with_its_points(
    atlas: OccupancyMap, maps: list[OccupancyMap]
) -> None:
    assert atlas.tiles == (3, 2)
    assert atlas.occupied.shape == (680, 1020)
    assert atlas.tile_m == (17.0, 17.0)
    assert atlas.max_steps == 400
    for field in ("spawn_points", "evaluation_points"):
        points = getattr(atlas, field)
        parts = atlas.part_of(points)
        for index, each in enumerate(maps):
            rows, columns, corner = tile(atlas, index)
            np.testing.assert_array_equal(atlas.occupied[rows, columns], each.occupied)
            np.testing.assert_allclose(points[parts == index] - corner, getattr(each, field))
    assert atlas.occupied[340:, 680:].all()  # The sixth tile is empty.
    validate(atlas, 0.1)


def test_no_way_leads_from_one_map_to_another(
    atlas: OccupancyMap, maps: list[OccupancyMap]
) -> None:
    labels, _ = ndimage.label(~atlas.occupied, structure=np.ones((3, 3)))
    kinds = [set(np.unique(labels[tile(atlas, i)[:2]])) - {0} for i in range(len(maps))]
    assert all(kinds[:5])
    assert sum(len(each) for each in kinds) == len(set().union(*kinds))
    reached = reachable_cells(atlas, 0.1)
    for index, each in enumerate(maps):
        rows, columns, _ = tile(atlas, index)
        np.testing.assert_array_equal(reached[rows, columns], reachable_cells(each, 0.1))


def test_a_map_with_an_open_border_is_closed(maps: list[OccupancyMap]) -> None:
    open_map = dataclasses.replace(maps[0], occupied=maps[0].occupied.copy())
    open_map.occupied[:, 0] = False
    two = side_by_side([maps[1], open_map], "two")
    # The wall stands outside: no free cell is lost.
    assert two.occupied[:, 342].all()
    np.testing.assert_array_equal(two.occupied[1:341, 343:683], open_map.occupied)
    points = open_map.spawn_points + np.array([343, 1]) * open_map.resolution
    np.testing.assert_allclose(two.spawn_points[-len(points) :], points)


def test_points_of_one_map_that_do_not_reach_each_other_are_named(
    atlas: OccupancyMap, maps: list[OccupancyMap]
) -> None:
    walled = atlas.occupied.copy()
    row, column = (atlas.spawn_points[70, ::-1] / 0.05).astype(int)
    walled[row - 8 : row + 9, column - 8 : column + 9] = True
    walled[row - 3 : row + 4, column - 3 : column + 4] = False
    with pytest.raises(
        ValueError, match=r"spawn_points\[70\] cannot be reached from spawn_points\[64\]"
    ):
        validate(dataclasses.replace(atlas, occupied=walled), 0.1)


def test_smaller_maps_leave_the_rest_of_their_tile_occupied(maps: list[OccupancyMap]) -> None:
    cave = generate("cave", 0)
    both = side_by_side([maps[0], cave], "both")
    assert both.occupied.shape == (1020, 2040)
    assert both.max_steps == 1200
    np.testing.assert_array_equal(both.occupied[:340, :340], maps[0].occupied)
    assert both.occupied[340:, :1020].all()
    np.testing.assert_array_equal(both.occupied[:, 1020:], cave.occupied)


def test_small_maps_share_the_tiles_of_a_large_one() -> None:
    """Nine mazes of 17 m fit into a tile of 51 m; the tenth begins another."""
    mazes = [generate("maze", seed) for seed in range(10)]
    cave = generate("cave", 0)
    mixed = side_by_side([*mazes[:5], cave, *mazes[5:]], "mixed")
    assert mixed.tiles == (2, 2)
    assert mixed.tile_m == (51.0, 51.0)
    validate(mixed, 0.1)
    kept = []
    for index, each in enumerate([*mazes[:5], cave, *mazes[5:]]):
        left, bottom, right, top = np.round(np.array(mixed.parts[index]) / 0.05).astype(int)
        assert (top - bottom, right - left) == each.shape
        assert left // 1020 == (right - 1) // 1020  # It crosses no border of a tile,
        assert bottom // 1020 == (top - 1) // 1020  # neither way.
        np.testing.assert_array_equal(mixed.occupied[bottom:top, left:right], each.occupied)
        mine = mixed.spawn_points[mixed.part_of(mixed.spawn_points) == index]
        np.testing.assert_allclose(mine - [left * 0.05, bottom * 0.05], each.spawn_points)
        kept.append((bottom // 1020, left // 1020))
    assert len(set(kept[:5] + kept[6:10])) == 1  # Nine mazes in one tile,
    assert len(set(kept)) == 3  # the cave and the tenth maze in others.
    free = sum((~each.occupied).sum() for each in [*mazes, cave])
    assert (~mixed.occupied).sum() == free  # Nothing else is free, nothing lies on another.


def test_the_sheet_is_nearly_square_and_hardly_larger_than_its_maps() -> None:
    small = generate("maze", 0)
    for count in range(2, 40):
        copies = [dataclasses.replace(small, name=str(index)) for index in range(count)]
        columns, rows = side_by_side(copies, "many").tiles
        assert count <= columns * rows <= count + 1 + count // 6
        assert rows <= columns <= 2 * rows


@pytest.mark.parametrize("number", [2, 3])
def test_larger_cells_are_divided_exactly(maps: list[OccupancyMap], number: int) -> None:
    coarse = dataclasses.replace(maps[0], resolution=number * 0.05)
    whole = side_by_side([coarse, maps[1]], "two")
    assert whole.resolution == 0.05
    divided = np.kron(coarse.occupied, np.ones((number, number), dtype=bool))
    np.testing.assert_array_equal(whole.occupied[: 340 * number, : 340 * number], divided)
    np.testing.assert_array_equal(
        whole.spawn_points[: len(coarse.spawn_points)], coarse.spawn_points
    )
    validate(whole, 0.1)


def test_what_cannot_be_laid_out_is_refused(maps: list[OccupancyMap]) -> None:
    with pytest.raises(ValueError, match="no map to lay out"):
        side_by_side([], "none")
    coarse = dataclasses.replace(maps[0], resolution=0.07)
    with pytest.raises(
        ValueError, match=r"maze has cells of 0\.05 m and maze of 0\.07 m.*resample"
    ):
        side_by_side([maps[0], coarse], "two")
    huge = dataclasses.replace(maps[0], resolution=5.0)
    with pytest.raises(ValueError, match=r"34000 x 34000 cells|68000 x 34000 cells"):
        side_by_side([maps[0], huge], "two")
    assert side_by_side(maps[:1], "one").tiles == (1, 1)
