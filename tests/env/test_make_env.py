"""Making an environment: what it refuses, in one line that names the culprit."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import open_map, wrap_map

from sqn_jax.config import EnvConfig
from sqn_jax.env import free_space, make_env, prepare
from sqn_jax.env.dynamics import move
from sqn_jax.maps import OccupancyMap, save_map
from sqn_jax.maps.occupancy import close_border


def refused(make, *parts: str) -> None:
    """`make` raises ValueError in one line that holds all the parts."""
    with pytest.raises(ValueError, match=r"\S") as caught:
        make()
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def small_map() -> OccupancyMap:
    """3 m x 2 m, free."""
    return wrap_map(open_map(rows=40, columns=60), [(1.0, 1.0), (2.0, 1.0)], max_steps=33)


def test_an_unknown_map_is_named_with_those_that_are_known() -> None:
    refused(lambda: make_env("labyrinth"), "labyrinth", "maze")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    refused(lambda: make_env(tmp_path / "none.yaml"), "none.yaml")


def test_a_map_may_come_from_a_file_or_from_memory_and_is_the_same(tmp_path: Path) -> None:
    save_map(small_map(), tmp_path / "small.yaml")
    from_file, from_memory = make_env(tmp_path / "small.yaml"), make_env(small_map())
    assert from_file.max_steps == from_memory.max_steps == 33
    np.testing.assert_array_equal(from_file.sight.far_sides, from_memory.sight.far_sides)
    np.testing.assert_array_equal(from_file.spawn_positions, from_memory.spawn_positions)


def test_the_tables_of_a_map_are_made_once_for_all_its_kinds_of_tasks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prepare._table.cache_clear()
    made = []
    far_sides = free_space.far_sides
    monkeypatch.setattr(free_space, "far_sides", lambda x: made.append(x.shape) or far_sides(x))
    turned = wrap_map(open_map(rows=60, columns=40), [(1.0, 1.0), (1.0, 2.0)], max_steps=33)
    for occupancy_map in (small_map(), turned):
        make_env(occupancy_map, spawn="training")
        make_env(occupancy_map, spawn="evaluation")
    # One for the beams and one for the body.
    assert made == [(8, 40, 60), (8, 40, 60), (8, 60, 40), (8, 60, 40)]


def test_a_robot_too_large_for_the_map_is_refused(tmp_path: Path) -> None:
    save_map(small_map(), tmp_path / "small.yaml")
    config = EnvConfig(robot_radius=1.5)
    refused(lambda: make_env(tmp_path / "small.yaml", config), "small.yaml", "1.5")
    refused(lambda: make_env(small_map(), config), "test", "1.5")


def test_a_point_in_an_obstacle_is_named() -> None:
    spoilt = dataclasses.replace(small_map(), spawn_points=np.array([[1.0, 1.0], [0.01, 1.0]]))
    refused(lambda: make_env(spoilt), "spawn_points[1]", "0.01")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_beams", 1),
        ("field_of_view_deg", 0.0),
        ("field_of_view_deg", 360.0),
        ("field_of_view_deg", math.nan),
        ("max_range", 0.0),
        ("max_range", math.inf),
        ("time_step", -0.1),
        ("forward_speed", -1.0),
        ("backward_speed", math.nan),
        ("turn_rate", math.inf),
        ("robot_radius", -0.1),
        ("goal_radius", 0.0),
        ("max_goal_distance", 0.0),
        ("max_steps", -1),
        ("coverage_cell", 0.0),
        ("ray_sectors", 6),
        ("ray_iterations", 0),
        ("velocity_noise", -0.1),
        ("range_noise", math.nan),
        ("reward_time", math.inf),
    ],
)
def test_an_invalid_setting_is_named_with_its_value(name: str, value: float) -> None:
    refused(lambda: EnvConfig(**{name: value}), f"env.{name}", repr(value), "expected")


@pytest.mark.parametrize("name", ["heading_encoding", "velocity_noise_unit", "range_noise_unit"])
def test_an_unknown_word_in_a_setting_is_named(name: str) -> None:
    refused(lambda: EnvConfig(**{name: "polar"}), f"env.{name}", "polar", "expected")


def test_an_unknown_kind_of_spawn_is_named() -> None:
    refused(lambda: make_env(small_map(), spawn="test"), "spawn", "test", "expected")


def test_a_robot_that_starts_on_the_border_of_a_cell_can_move() -> None:
    # Free are columns 1 to 5, up to x = 0.3 m: the evaluation point lies on the wall's face.
    occupied = np.ones((20, 30), bool)
    occupied[1:-1, 1:6] = False
    try:
        params = make_env(
            wrap_map(occupied, [(0.3, 0.5), (0.2, 0.7)]),
            EnvConfig(robot_radius=0.0),
            spawn="evaluation",
        )
    except ValueError:
        return  # Refusing the point would do as well.
    start = jnp.append(params.spawn_positions[0, 0], 0.0)
    pose, refused = jax.jit(move, static_argnames="iterations")(
        start, params.commands[2], params.body, time_step=params.time_step, iterations=12
    )
    # Backward, 0.125 m: a whole step forward would need more than the 0.25 m there are.
    assert not refused
    assert pose[0] < 0.2


def test_maps_too_large_to_prepare_are_refused_by_what_is_too_large(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before anything of that size is allocated."""
    monkeypatch.setattr(prepare, "MAX_CELLS_TOGETHER", 17_000_000)
    occupied = np.zeros((40, 40), dtype=bool)
    points = np.array([[0.3, 0.3], [0.7, 0.7]])
    room = OccupancyMap("room", close_border(occupied), 0.05, 2 * points, 2 * points)
    make_env(room)
    wide = dataclasses.replace(
        room, resolution=100.0, spawn_points=4000 * points, evaluation_points=4000 * points
    )
    many = dataclasses.replace(
        room, spawn_points=np.tile(2 * points, (12_000, 1)), spawn_radius=1e6
    )
    vast = dataclasses.replace(room, occupied=close_border(np.zeros((4200, 4200), dtype=bool)))
    several = dataclasses.replace(vast, parts=((0.0, 0.0, 2.0, 2.0),))
    for large, fault in (
        (wide, r"4,000 x 4,000 m with env\.coverage_cell 0\.325 m are 151,"),
        (many, r"24000 spawn points with spawn_radius 1e\+06 m are 38,400,000 places"),
        (vast, r"4200 x 4200 cells, expected at most 16,777,216: coarser ones"),
        (several, r"4200 x 4200 cells, expected at most 17,000,000: fewer maps"),
    ):
        with pytest.raises(ValueError, match=fault):
            make_env(large)


def test_neighbours_are_the_nearest_points_and_of_two_as_near_the_first() -> None:
    rng = np.random.default_rng(4)
    points = rng.integers(0, 6, (40, 2)).astype(float)
    groups = np.repeat([[0, 25], [25, 15]], [25, 15], axis=0)
    found = prepare._nearest(points, groups)
    for index in range(40):
        group = range(25) if index < 25 else range(25, 40)
        others = [other for other in group if other != index]
        others.sort(key=lambda other: math.dist(points[other], points[index]))
        assert found[index].tolist() == others[:4]


def test_on_fine_cells_the_far_sides_fit_their_bytes() -> None:
    """5 m are 200 cells of 25 mm, more than a signed byte holds."""
    occupied = open_map(290, 310)
    fine = make_env(wrap_map(occupied, [(1.0, 1.0), (2.0, 2.0)], resolution=0.025))
    sides = np.asarray(fine.sight.far_sides).reshape(290, 310, -1)[1:-1, 1:-1]
    columns, rows = (sides << 8).astype(np.int16) >> 8, sides >> 8
    # The sectors of the first quadrant look toward +x, +y, those of the third toward -x, -y.
    quarter = sides.shape[-1] // 4
    assert min(columns[..., :quarter].min(), rows[..., :quarter].min()) >= 1
    assert (
        max(columns[..., 2 * quarter : -quarter].max(), rows[..., 2 * quarter : -quarter].max())
        <= 0
    )
    assert max(columns.max(), rows.max()) > 120
