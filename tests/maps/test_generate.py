"""Procedural maps: one region, closed, the same for the same seed, and of their kind."""

from __future__ import annotations

import hashlib
import runpy
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from lattice_oracle import steps_between
from map_shapes import cell_of, fill_of_hull, inner_obstacles, is_closed, standing_room
from scipy import ndimage, spatial

from sqn_jax.maps import load_map, validate
from sqn_jax.maps.generate import generate
from sqn_jax.maps.terrain import carve_tunnels, fill_pockets, smooth_path, spread, value_noise

SCRIPT = Path(__file__).resolve().parents[2] / "experiments/draw_maps.py"
SEEDS = {"maze": 30, "column": 30, "forest": 30, "cave": 5}
KINDS = tuple(SEEDS)
EACH = [(kind, seed) for kind in KINDS for seed in range(SEEDS[kind])]

made = cache(generate)


@pytest.mark.parametrize(("kind", "seed"), EACH)
def test_a_generated_map_is_one_closed_region_with_its_points_in_it(kind: str, seed: int) -> None:
    drawn = made(kind, seed)
    side = 1020 if kind == "cave" else 340
    assert drawn.name == f"{kind}-{seed}"
    assert (drawn.shape, drawn.resolution) == ((side, side), 0.05)
    assert drawn.max_steps == (1200 if kind == "cave" else 400)
    assert is_closed(drawn.occupied)
    free = standing_room(drawn.occupied)
    assert ndimage.label(free)[1] == 1
    assert ndimage.label(~drawn.occupied)[1] == 1
    assert free.mean() > (0.1 if kind == "cave" else 0.4)
    assert len(drawn.evaluation_points) == (4 if kind == "maze" else 2)
    for point in (*drawn.spawn_points, *drawn.evaluation_points):
        assert free[cell_of(point)]
    validate(drawn, 0.1)


@pytest.mark.parametrize(("kind", "seed"), EACH)
def test_spawn_points_are_spread_over_the_map(kind: str, seed: int) -> None:
    drawn = made(kind, seed)
    assert len(drawn.spawn_points) == {"maze": 64, "column": 40, "forest": 40, "cave": 100}[kind]
    tree = spatial.KDTree(drawn.spawn_points)
    nearest, _ = tree.query(drawn.spawn_points, 2)
    assert nearest[:, 1].min() > 1.0
    # Nowhere in the free space is the next one far.
    row, col = np.nonzero(standing_room(drawn.occupied))
    away, _ = tree.query((np.stack([col, row], axis=1)[::7] + 0.5) * 0.05)
    assert away.max() < 4.0


@pytest.mark.parametrize("kind", KINDS)
def test_the_seed_decides(kind: str) -> None:
    again = generate(kind, 1)
    first = made(kind, 1)
    np.testing.assert_array_equal(again.occupied, first.occupied)
    np.testing.assert_array_equal(again.spawn_points, first.spawn_points)
    np.testing.assert_array_equal(again.evaluation_points, first.evaluation_points)
    different = {made(kind, seed).occupied.tobytes() for seed in range(SEEDS[kind])}
    assert len(different) == SEEDS[kind]


def test_a_seed_keeps_its_map() -> None:
    # Results name maps by kind and seed. The maze is whole numbers only, so the same everywhere.
    cells = np.packbits(made("maze", 0).occupied).tobytes()
    assert hashlib.sha256(cells).hexdigest()[:16] == "540dc0970f84830f"


@pytest.mark.parametrize("kind", KINDS)
def test_the_goal_can_be_reached_in_half_an_episode(kind: str) -> None:
    drawn = made(kind, 0)
    start, *goals = drawn.evaluation_points
    for goal in goals:
        assert 50 <= steps_between(drawn, start, goal)[0] <= drawn.max_steps / 2


@pytest.mark.parametrize("seed", range(SEEDS["maze"]))
def test_a_maze_has_dead_ends_junctions_and_loops(seed: int) -> None:
    occupied = made("maze", seed).occupied
    middles = np.floor(made("maze", seed).spawn_points / 0.05).astype(int).reshape(8, 8, 2)
    exits = np.zeros((8, 8), dtype=int)
    for row in range(8):
        for col in range(8):
            x, y = middles[row, col]
            if col < 7 and not occupied[y, x : middles[row, col + 1, 0]].any():
                exits[row, col : col + 2] += 1
            if row < 7 and not occupied[y : middles[row + 1, col, 1], x].any():
                exits[row : row + 2, col] += 1
    assert (exits == 1).sum() >= 4
    assert (exits >= 3).sum() >= 8
    # A connected graph has edges - nodes + 1 independent loops.
    assert exits.sum() // 2 - 64 + 1 == 5


@pytest.mark.parametrize("seed", range(SEEDS["column"]))
def test_a_column_map_has_round_pillars_around_an_open_middle(seed: int) -> None:
    occupied = made("column", seed).occupied
    pillars = inner_obstacles(occupied)
    assert len(pillars) >= 15
    assert min(map(fill_of_hull, pillars)) > 0.85
    for cells in pillars:
        height, width = np.ptp(cells, axis=0) + 1
        assert abs(height - width) <= 1
    row, col = np.nonzero(occupied)
    assert np.hypot(row - 169.5, col - 169.5).min() * 0.05 > 3.0
    areas = [len(cells) for cells in pillars]
    assert max(areas) > 4 * min(areas)


@pytest.mark.parametrize("seed", range(SEEDS["forest"]))
def test_a_forest_has_asterisks(seed: int) -> None:
    asterisks = inner_obstacles(made("forest", seed).occupied)
    assert len(asterisks) >= 9
    assert max(map(fill_of_hull, asterisks)) < 0.7


def test_what_cannot_be_reached_is_filled() -> None:
    occupied = np.zeros((60, 60), dtype=bool)
    # A shut room, a room whose door is too narrow for the robot, and one with a wide door.
    for left, door in ((5, 0), (20, 3), (35, 5)):
        occupied[10:22, left : left + 12] = True
        occupied[11:21, left + 1 : left + 11] = False
        occupied[21, left + 5 : left + 5 + door] = False
    filled = fill_pockets(occupied)
    assert is_closed(filled)
    assert filled[12:20, 7:15].all()
    assert filled[12:20, 22:30].all()
    assert not filled[12:20, 37:45].any()
    np.testing.assert_array_equal(fill_pockets(filled), filled)


def test_fill_pockets_ends_where_nobody_can_stand() -> None:
    assert fill_pockets(np.ones((9, 9), dtype=bool)).all()
    narrow = np.ones((9, 9), dtype=bool)
    narrow[4, 2:7] = False
    fill_pockets(narrow)


def test_spread_takes_the_farthest_next() -> None:
    line = np.stack([np.zeros(11, dtype=np.int64), np.arange(11)], axis=1)
    np.testing.assert_array_equal(spread(line, 4)[:, 1], [0, 10, 5, 2])
    assert len(spread(line, 50)) == 11


def test_noise_is_smooth_and_within_its_amplitude() -> None:
    rng = np.random.Generator(np.random.PCG64(0))
    noise = value_noise(200, ((2.0, 0.5), (1.0, 0.25)), rng)
    assert 0.3 < np.abs(noise).max() <= 0.75
    # The steepest slope of an interpolation by 3 t^2 - 2 t^3 is 1.5 a wavelength.
    steepest = 1.5 * 2 * (0.5 / 2.0 + 0.25 / 1.0) * 0.05
    assert np.abs(np.diff(noise, axis=0)).max() <= steepest
    assert np.abs(np.diff(noise, axis=1)).max() <= steepest


def test_a_smooth_path_keeps_its_ends_and_leaves_no_gap() -> None:
    path = smooth_path([(0.0, 0.0, 1.0), (2.0, 0.0, 2.0), (2.0, 3.0, 1.0)])
    np.testing.assert_allclose(path[[0, -1]], [(0.0, 0.0, 1.0), (2.0, 3.0, 1.0)])
    assert np.abs(np.diff(path[:, :2], axis=0)).max() <= 0.05 + 1e-12
    # The corner is cut, but not far from it.
    assert 0.1 < np.hypot(*(path[:, :2] - (2.0, 0.0)).T).min() < 1.0


@pytest.mark.parametrize("seed", range(3))
def test_a_tunnel_is_never_shut(seed: int) -> None:
    rng = np.random.Generator(np.random.PCG64(seed))
    paths = [[(3.0, 3.0, 0.6), (12.0, 4.0, 0.6), (14.0, 13.0, 0.6)], [(3, 3, 0.6), (4, 14, 0.6)]]
    occupied = carve_tunnels(340, paths, rng)
    labels, _ = ndimage.label(ndimage.distance_transform_edt(~occupied) > 0.4 / 0.05)
    sizes = np.bincount(labels.ravel())[1:]
    long = np.flatnonzero(sizes > 50) + 1
    assert len(long) == 1
    row, col = np.nonzero(labels == long[0])
    assert np.ptp(row) * 0.05 > 8
    assert np.ptp(col) * 0.05 > 9


@pytest.mark.parametrize(
    ("kind", "seed", "parts"),
    [
        ("labyrinth", 0, ("labyrinth", "maze, column, forest, cave")),
        ("maze", -1, ("seed", "-1", "whole number")),
        ("maze", 1.5, ("seed", "1.5", "whole number")),
        ("maze", "1", ("seed", "'1'", "whole number")),
    ],
)
def test_wrong_arguments_are_named(kind: str, seed: int, parts: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=".*".join(parts)):
        generate(kind, seed)


def test_the_script_writes_generated_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--generate", "forest", "--seeds", "3", "5", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    assert capsys.readouterr().out.split() == [
        str(tmp_path / f"forest-{seed}.yaml") for seed in (3, 5)
    ]
    for seed in (3, 5):
        loaded = load_map(tmp_path / f"forest-{seed}.yaml")
        drawn = made("forest", seed)
        np.testing.assert_array_equal(loaded.occupied, drawn.occupied)
        np.testing.assert_allclose(loaded.spawn_points, drawn.spawn_points)
        np.testing.assert_allclose(loaded.evaluation_points, drawn.evaluation_points)
        assert (loaded.spawn_radius, loaded.max_steps) == (0.5, 400)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--generate", "maze"],
        ["--seeds", "1"],
        ["cave", "--generate", "maze"],
        ["--generate", "maze", "--seeds", "-1"],
    ],
)
def test_the_script_refuses_what_it_cannot_do(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments, "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert caught.value.code == 2
    assert not list(tmp_path.iterdir())
