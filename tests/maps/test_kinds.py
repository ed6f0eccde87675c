"""Procedural maps whose proportions differ from seed to seed: what each kind promises."""

from __future__ import annotations

import cmath
import hashlib
from functools import cache

import numpy as np
import pytest
from lattice_oracle import steps_between
from map_shapes import cell_of, fill_of_hull, inner_obstacles, is_closed, standing_room
from numpy.typing import NDArray
from scipy import ndimage, spatial

from sqn_jax.maps import validate
from sqn_jax.maps.generate import generate
from sqn_jax.maps.kinds import rooms
from sqn_jax.maps.kinds.plan import grow_tree
from sqn_jax.maps.terrain import boxes

KINDS = ("rooms", "corridors", "track", "clutter", "courtyard")
EACH = [(kind, seed) for kind in KINDS for seed in range(12)]

made = cache(generate)


def square(side: float) -> NDArray[np.bool_]:
    """A square of so many m, as cells."""
    return np.ones((round(side / 0.05),) * 2, dtype=bool)


def free_runs(occupied: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """How long the run of free cells is that each is in, [H, W], along rows and along columns."""
    both = []
    for lines in (occupied, occupied.T):
        lengths = np.zeros(lines.shape, dtype=np.int64)
        for row, line in enumerate(lines):
            ends = np.flatnonzero(np.diff(line.astype(int))) + 1
            for first, last in zip(ends[::2], ends[1::2], strict=True):  # The border is closed.
                lengths[row, first:last] = last - first
        both.append(lengths)
    return [both[0], both[1].T]


def pieces(free: NDArray[np.bool_]) -> int:
    """How many connected pieces there are."""
    return int(ndimage.label(free)[1])


@pytest.mark.parametrize(("kind", "seed"), EACH)
def test_a_map_is_one_closed_region_with_points_all_over(kind: str, seed: int) -> None:
    drawn = made(kind, seed)
    assert drawn.name == f"{kind}-{seed}"
    assert drawn.resolution == 0.05
    assert drawn.shape in ((250, 250), (500, 500))
    assert is_closed(drawn.occupied)
    free = standing_room(drawn.occupied)
    assert ndimage.label(free)[1] == 1
    assert ndimage.label(~drawn.occupied)[1] == 1
    validate(drawn, 0.1)
    # A tenth of a meter more than the robot needs, all around; distances count to cells' centers.
    clear = ndimage.distance_transform_edt(~drawn.occupied) * 0.05
    points = drawn.spawn_points
    assert 16 <= len(points) <= 100
    assert min(clear[cell_of(point)] for point in points) > 0.2
    tree = spatial.KDTree(points)
    assert tree.query(points, 2)[0][:, 1].min() > 0.5
    row, col = np.nonzero(free)
    away, _ = tree.query((np.stack([col, row], axis=1)[::7] + 0.5) * 0.05)
    assert away.max() < 3.5


@pytest.mark.parametrize("kind", ["rooms", "corridors", "track"])
def test_the_goal_is_far_and_can_be_reached_in_half_an_episode(kind: str) -> None:
    drawn = max((made(kind, seed) for seed in range(12)), key=lambda each: each.max_steps)
    start, goal = drawn.evaluation_points
    steps = steps_between(drawn, start, goal)[0]
    assert 150 <= steps <= drawn.max_steps / 2
    assert drawn.max_steps % 100 == 0


@pytest.mark.parametrize("kind", KINDS)
def test_the_seed_decides(kind: str) -> None:
    again = generate(kind, 1)
    assert again.identity() == made(kind, 1).identity()
    assert len({made(kind, seed).occupied.tobytes() for seed in range(12)}) == 12
    # Of both sizes; no episode is shorter than in a maze or longer than in a cave.
    assert {made(kind, seed).shape[0] for seed in range(12)} == {250, 500}
    assert all(400 <= made(kind, seed).max_steps <= 1200 for seed in range(12))


@pytest.mark.parametrize("kind", ["rooms", "corridors"])
def test_a_seed_keeps_its_map(kind: str) -> None:
    # Results name maps by kind and seed. No sines here, so the same everywhere.
    cells = np.packbits(made(kind, 0).occupied).tobytes()
    expected = {"rooms": "7566387be2a292ea", "corridors": "c85d6c64a5758a06"}
    assert hashlib.sha256(cells).hexdigest()[:16] == expected[kind]


@pytest.mark.parametrize("seed", range(12))
def test_doors_are_half_a_meter_to_a_little_more_than_one(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rooms, "furnish", lambda *_: None)
    occupied = generate("rooms", seed).occupied
    across, along = free_runs(occupied)
    narrowest = np.minimum(across, along)[~occupied].min()
    assert 0.5 <= round(narrowest * 0.05, 9) <= 1.2
    # For a square that is wider than all doors it falls into rooms.
    assert pieces(ndimage.binary_erosion(~occupied, square(1.25))) >= 3


@pytest.mark.parametrize("seed", range(12))
def test_a_square_of_half_a_meter_gets_into_all_rooms_and_past_the_furniture(seed: int) -> None:
    assert pieces(ndimage.binary_erosion(~made("rooms", seed).occupied, square(0.5))) == 1


@pytest.mark.parametrize("seed", range(30))
def test_corridors_are_as_wide_as_they_should_be(seed: int) -> None:
    free = ~made("corridors", seed).occupied
    np.testing.assert_array_equal(ndimage.binary_opening(free, square(0.6)), free)
    # Twice as wide as the narrowest at most, and that is at most 2 m: 2.67 m beside 1.33 m.
    assert not ndimage.binary_erosion(free, square(2.75)).any()


@pytest.mark.parametrize("seed", range(12))
def test_a_track_is_a_course_that_is_nowhere_shut_and_nowhere_a_field(seed: int) -> None:
    clear = ndimage.distance_transform_edt(~made("track", seed).occupied) * 0.05
    assert pieces(clear > 0.22) == 1
    assert clear.max() < 2.0


def test_some_tracks_are_loops_and_some_have_ends() -> None:
    rocks = [inner_obstacles(made("track", seed).occupied) for seed in range(12)]
    loops = [any(len(rock) * 0.05**2 > 1.0 for rock in of_track) for of_track in rocks]
    assert 3 <= sum(loops) <= 9


@pytest.mark.parametrize("seed", range(12))
def test_clutter_is_many_small_things_with_a_way_around(seed: int) -> None:
    occupied = made("clutter", seed).occupied
    obstacles = inner_obstacles(occupied)
    assert len(obstacles) >= 10
    assert np.median([len(cells) for cells in obstacles]) * 0.05**2 < 0.5
    ring = np.pad(np.zeros(np.subtract(occupied.shape, 20), dtype=bool), 7, constant_values=True)
    assert not (occupied[3:-3, 3:-3] & ring).any()


def test_most_courtyards_have_yards_that_are_traps() -> None:
    obstacles = [inner_obstacles(made("courtyard", seed).occupied) for seed in range(12)]
    assert min(map(len, obstacles)) >= 4
    assert sum(min(map(fill_of_hull, buildings)) < 0.7 for buildings in obstacles) >= 8


@pytest.mark.parametrize("turn", [0.0, 0.3, 2.0, 4.5])
@pytest.mark.parametrize("margin", [0.0, 0.4])
def test_boxes_turn_about_their_center(turn: float, margin: float) -> None:
    center, sides = (2.1, 1.7), [(-1.0, 0.5, 0.2, 0.6), (0.0, 0.3, -0.9, 0.2)]
    where, cells = boxes(100, center, turn, sides, margin)
    drawn = np.zeros((100, 100), dtype=bool)
    drawn[where] = cells
    expected = np.zeros_like(drawn)
    for row, col in np.ndindex(100, 100):
        # Turned back as a complex number.
        off = complex((col + 0.5) * 0.05 - center[0], (row + 0.5) * 0.05 - center[1])
        own = off * cmath.exp(-1j * turn)
        expected[row, col] = any(
            left - margin <= own.real <= right + margin
            and bottom - margin <= own.imag <= top + margin
            for left, right, bottom, top in sides
        )
    np.testing.assert_array_equal(drawn, expected)


def test_a_tree_that_grows_straight_has_fewer_bends() -> None:
    bends = []
    for straight in (0.0, 0.9):
        bends.append(0)
        for seed in range(10):
            rng = np.random.Generator(np.random.PCG64(seed))
            edges = grow_tree(9, rng, last=1.0, straight=straight)
            assert len(edges) == 80
            joined: dict[int, list[int]] = {place: [] for place in range(81)}
            for first, second in edges:
                joined[first].append(second)
                joined[second].append(first)
            bends[-1] += sum(
                len(ends) == 2 and sum(ends) != 2 * place for place, ends in joined.items()
            )
    assert bends[1] < 0.6 * bends[0]
