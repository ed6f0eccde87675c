"""The Maze: its files are what the script draws, and it asks of a robot what it should."""

from __future__ import annotations

import importlib.util
from itertools import permutations
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from lattice_oracle import oracle_steps
from PIL import Image

from sqn_jax.maps import (
    OccupancyMap,
    connected_components,
    known_maps,
    load_map,
    points_to_cells,
    save_map,
    traversable,
)
from sqn_jax.maps.check import evaluation_distances

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def drawing() -> ModuleType:
    spec = importlib.util.spec_from_file_location("draw_maps", ROOT / "experiments/draw_maps.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def maze() -> OccupancyMap:
    return load_map("maze")


def test_the_committed_maps_are_what_the_script_draws(drawing: ModuleType, tmp_path: Path) -> None:
    assert sorted(drawing.MAPS) == sorted(known_maps())
    for name, draw in drawing.MAPS.items():
        save_map(draw(), tmp_path / f"{name}.yaml")
        committed = known_maps()[name]
        assert (tmp_path / f"{name}.yaml").read_bytes() == committed.read_bytes()
        # Pixels, not bytes: another version of zlib packs the same picture differently.
        with (
            Image.open(tmp_path / f"{name}.png") as new,
            Image.open(committed.with_suffix(".png")) as old,
        ):
            np.testing.assert_array_equal(np.asarray(new), np.asarray(old))
        first = [path.read_bytes() for path in sorted(tmp_path.iterdir())]
        save_map(draw(), tmp_path / f"{name}.yaml")
        assert [path.read_bytes() for path in sorted(tmp_path.iterdir())] == first


def test_a_plan_becomes_walls_posts_and_cells(drawing: ModuleType) -> None:
    plan = "+--+--+\n| *   |\n+  +--+\n|  |  |\n+--+--+\n"
    occupied, (marked, middles) = drawing.parse_plan(plan, 23)
    # Edges at 0, 10 and 20, walls three cells thick: interiors are rows 3..9 and 13..19.
    expected = np.ones((23, 23), dtype=bool)
    expected[3:10, 3:10] = expected[13:20, 3:20] = expected[10:13, 3:10] = False
    expected[3:10, 13:20] = False
    np.testing.assert_array_equal(occupied, expected)
    np.testing.assert_allclose(marked, [[6.5 * 0.05, 16.5 * 0.05]])
    assert len(middles) == 4


def test_the_maze_is_seventeen_metres_a_side_and_one_region(maze: OccupancyMap) -> None:
    assert maze.shape == (340, 340)
    assert maze.size_m == pytest.approx((17.0, 17.0))
    assert maze.max_steps == 400
    assert connected_components(traversable(maze.occupied, maze.resolution, 0.1))[1] == 1
    assert connected_components(~maze.occupied)[1] == 1
    assert len(maze.spawn_points) == 64
    assert len(maze.evaluation_points) == 4


def test_spawn_points_leave_room_for_the_spawn_radius(maze: OccupancyMap) -> None:
    free = traversable(maze.occupied, maze.resolution, 0.1)
    row, col = np.mgrid[:340, :340]
    for x, y in maze.spawn_points:
        near = np.hypot((col + 0.5) * 0.05 - x, (row + 0.5) * 0.05 - y) <= maze.spawn_radius
        assert free[near].all()


def test_the_maze_has_junctions_dead_ends_and_loops(drawing: ModuleType) -> None:
    # Passages counted in the plan itself: between the cells left and right of, above and below.
    lines = drawing.MAZE.strip("\n").splitlines()
    exits = np.zeros((8, 8), dtype=int)
    for row in range(8):
        for col in range(8):
            middle = lines[2 * row + 1]
            exits[row, col] += middle[3 * col] == " "
            exits[row, col] += middle[3 * col + 3] == " "
            exits[row, col] += lines[2 * row][3 * col + 1] == " "
            exits[row, col] += lines[2 * row + 2][3 * col + 1] == " "
    assert (exits == 1).sum() >= 6
    assert (exits >= 3).sum() >= 8
    # A connected graph has edges - nodes + 1 independent loops.
    assert exits.sum() // 2 - 64 + 1 >= 3


def test_evaluation_points_are_far_apart_by_path_not_by_sight(maze: OccupancyMap) -> None:
    geodesic, straight = evaluation_distances(maze)
    np.testing.assert_allclose(geodesic, geodesic.T, rtol=0.01, atol=1e-6)
    pairs = np.triu_indices(4, 1)
    ratio = geodesic[pairs] / straight[pairs]
    assert (ratio >= 1.5).sum() >= 4
    assert (ratio >= 1.4).all()


def test_between_evaluation_points_the_oracle_needs_90_to_150_steps(maze: OccupancyMap) -> None:
    cells = points_to_cells(maze.evaluation_points, maze.resolution)
    fields = [oracle_steps(maze, goal) for goal in maze.evaluation_points]
    for start, goal in permutations(range(4), 2):
        steps = fields[goal][tuple(cells[start])]
        assert 90 <= steps.min() <= steps.max() <= 150
