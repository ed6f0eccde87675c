"""Procedural maps: from a kind and an integer seed, one more map like the project's own.

    from sqn_jax.maps.generate import generate
    occupancy_map = generate("maze", 7)

The same kind and seed give the same map bit for bit. Every map has a closed border, and all that a
robot of 0.1 m radius can stand on is one connected region.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from sqn_jax.config.map_names import KINDS
from sqn_jax.maps.occupancy import OccupancyMap, cells_to_points
from sqn_jax.maps.terrain import (
    CAVE_SIZE,
    RESOLUTION,
    SMALL_SIZE,
    WALL,
    Window,
    asterisk,
    carve_tunnels,
    disc,
    fill_pockets,
    finish_map,
    round_crooks,
    wall_edges,
    walled_square,
)

_GAP = 0.7  # m, at least, between two obstacles in the open
_TRIES = 400  # places tried for obstacles in the open
_MAZE_SIDE = 8  # cells of the plan
_MAZE_LOOPS = 5  # walls taken out of a maze that has only one path
_CAVE_SIDE = 6  # places a side where tunnels may meet
_CAVE_LOOPS = 3
_CAVE_LEFT_OUT = 8  # places of the cave that stay rock
_CAVE_MARGIN = 4.0  # m; no nearer to the border lies the course of a tunnel
_CAVE_PATH = 115.0  # m, about the longest path from start to goal

Edge = tuple[int, int]


def generate(kind: str, seed: int) -> OccupancyMap:
    """The map of a kind that belongs to a seed.

    Args:
        kind: "maze" (17 x 17 m, corridors about 2 m wide), "column" (17 x 17 m, round pillars
            around an open middle), "forest" (17 x 17 m, asterisks) or "cave" (51 x 51 m, rough
            tunnels).
        seed: any whole number >= 0.

    Returns:
        The map, named kind-seed: 0.05 m a cell, spawn points all over, four evaluation points in a
        maze and two (start, goal) in the others, 400 steps an episode, 1200 in a cave.

    Raises:
        ValueError: an unknown kind, or a seed that is not a whole number >= 0.

    Example:
        >>> generate("column", 3).size_m
        (17.0, 17.0)
    """
    if kind not in KINDS:
        raise ValueError(f"kind: {kind!r}, expected one of {', '.join(KINDS)}")
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if number < 0:
        raise ValueError(f"seed: {seed!r}, expected a whole number >= 0")
    makers: dict[str, Callable[[str, np.random.Generator], OccupancyMap]] = {
        "maze": _maze,
        "column": _column,
        "forest": _forest,
        "cave": _cave,
    }
    return makers[kind](f"{kind}-{number}", np.random.Generator(np.random.PCG64(number)))


def _grow_tree(side: int, rng: np.random.Generator) -> set[Edge]:
    """A random tree over a square of side x side places: edges (a, b), a < b, row * side + col.

    Grown from the place reached last (long paths) or from any reached so far (short dead ends).
    """
    edges: set[Edge] = set()
    active = [int(rng.integers(side * side))]
    reached = set(active)
    while active:
        index = len(active) - 1 if rng.random() < 0.6 else int(rng.integers(len(active)))
        place = active[index]
        new = [other for other in _beside(place, side) if other not in reached]
        if not new:
            active.pop(index)
            continue
        other = new[int(rng.integers(len(new)))]
        edges.add((min(place, other), max(place, other)))
        reached.add(other)
        active.append(other)
    return edges


def _beside(place: int, side: int) -> list[int]:
    """The places left of, right of, below and above a place."""
    row, col = divmod(place, side)
    beside = [(row, col - 1), (row, col + 1), (row - 1, col), (row + 1, col)]
    return [r * side + c for r, c in beside if 0 <= r < side and 0 <= c < side]


def _add_loops(
    edges: set[Edge], places: set[int], side: int, count: int, rng: np.random.Generator
) -> set[Edge]:
    """The edges and `count` more (or all there are) between neighbors among the places."""
    absent = [
        (place, other)
        for place in sorted(places)
        for other in _beside(place, side)
        if place < other and other in places and (place, other) not in edges
    ]
    order = np.argsort(rng.random(len(absent)), kind="stable")
    return edges | {absent[index] for index in order[:count]}


def _path_lengths(edges: set[Edge], lengths: dict[Edge, float], count: int) -> NDArray[np.float64]:
    """Length of the shortest path [count, count] between all places; inf where there is none."""
    pairs = np.array(sorted(edges))
    data = np.array([lengths[edge] for edge in sorted(edges)])
    graph = coo_array((data, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    path_lengths: NDArray[np.float64] = dijkstra(graph.tocsr(), directed=False)
    return path_lengths


def _maze(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Corridors; evaluation points far from each other by path, spawn points in every cell."""
    side = _MAZE_SIDE
    count = side * side
    edges = _add_loops(_grow_tree(side, rng), set(range(count)), side, _MAZE_LOOPS, rng)
    walls = wall_edges(side, SMALL_SIZE)
    occupied = np.ones((SMALL_SIZE, SMALL_SIZE), dtype=bool)
    spans = [slice(walls[k] + WALL, walls[k + 1]) for k in range(side)]
    for place in range(count):
        row, col = divmod(place, side)
        occupied[spans[row], spans[col]] = False
    for place, other in edges:
        (row, col), (other_row, other_col) = divmod(place, side), divmod(other, side)
        rows = slice(spans[row].start, spans[other_row].stop)
        occupied[rows, spans[col].start : spans[other_col].stop] = False
    steps = _path_lengths(edges, dict.fromkeys(edges, 1.0), count)
    marked = [int(steps[0].argmax())]
    while len(marked) < 4:
        marked.append(int(steps[marked].min(axis=0).argmax()))
    middle = np.array([(span.start + span.stop - 1) / 2 for span in spans])
    points = cells_to_points(
        np.stack([np.repeat(middle, side), np.tile(middle, side)], axis=-1), RESOLUTION
    ).round(3)
    return OccupancyMap(
        name=name,
        occupied=fill_pockets(occupied),
        resolution=RESOLUTION,
        spawn_points=points,
        evaluation_points=points[marked],
        spawn_radius=0.5,
        max_steps=400,
    )


def _uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(rng.random())


def _place_obstacles(
    occupied: NDArray[np.bool_],
    keep_free: NDArray[np.bool_],
    draw: Callable[[], Callable[[float], Window]],
    most: int,
) -> None:
    """Add up to `most` obstacles to `occupied`, `_GAP` apart and none on `keep_free`.

    `draw` gives an obstacle at random: from a margin in m, its cells with so much around them.
    """
    placed = 0
    for _ in range(_TRIES):
        obstacle = draw()
        where, wide = obstacle(_GAP)
        if (occupied[where] & wide).any():
            continue
        where, cells = obstacle(0.0)
        if (keep_free[where] & cells).any():
            continue
        occupied[where] |= cells
        placed += 1
        if placed == most:
            return


def _column(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Round pillars of all sizes around an open middle; from the upper left to the lower right."""
    occupied = walled_square(SMALL_SIZE)
    keep_free = np.zeros_like(occupied)
    where, cells = disc(SMALL_SIZE, (8.5, 8.5), 3.2)
    keep_free[where] = cells

    def draw() -> Callable[[float], Window]:
        center = (_uniform(rng, 1, 16), _uniform(rng, 1, 16))
        radius = _uniform(rng, 0.25, 1.0)
        return lambda margin: disc(SMALL_SIZE, center, radius + margin)

    _place_obstacles(occupied, keep_free, draw, 26)
    return finish_map(name, occupied, [(1.5, 15.5), (15.5, 1.5)], spawn_count=40, clearance=0.6)


def _forest(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Asterisks, close to each other; from the lower left to the upper right."""
    occupied = walled_square(SMALL_SIZE)
    keep_free = np.zeros_like(occupied)

    def draw() -> Callable[[float], Window]:
        center = (_uniform(rng, 1.2, 15.8), _uniform(rng, 1.2, 15.8))
        arms = 5 + int(rng.integers(3))
        turn = _uniform(rng, 0, 2 * math.pi)
        angles = [turn + 2 * math.pi * (k + _uniform(rng, -0.2, 0.2)) / arms for k in range(arms)]
        lengths = [_uniform(rng, 0.8, 1.9) for _ in range(arms)]
        half_width = _uniform(rng, 0.08, 0.14)
        return lambda margin: asterisk(SMALL_SIZE, center, angles, lengths, half_width + margin)

    _place_obstacles(occupied, keep_free, draw, 20)
    occupied = round_crooks(occupied)
    return finish_map(name, occupied, [(1.5, 1.5), (15.5, 15.5)], spawn_count=40, clearance=0.5)


def _cave(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Tunnels between places on a shifted grid; some loops, many dead ends."""
    side = _CAVE_SIDE
    pitch = CAVE_SIZE * RESOLUTION / side
    edges = _grow_tree(side, rng)
    places = set(range(side * side))
    for _ in range(_CAVE_LEFT_OUT):
        joined = np.bincount(np.array(sorted(edges)).ravel(), minlength=side * side)
        leaves = np.flatnonzero(joined == 1)
        left_out = int(leaves[rng.integers(len(leaves))])
        places.discard(left_out)
        edges = {edge for edge in edges if left_out not in edge}
    edges = _add_loops(edges, places, side, _CAVE_LOOPS, rng)
    grid = np.stack(np.divmod(np.arange(side * side), side)[::-1], axis=-1)
    nodes = (grid + 0.5 + 0.5 * (rng.random((side * side, 2)) - 0.5)) * pitch
    nodes = np.clip(nodes, _CAVE_MARGIN, CAVE_SIZE * RESOLUTION - _CAVE_MARGIN)
    widths = 1.1 + 0.8 * rng.random(side * side)
    paths, lengths = [], {}
    for first, second in sorted(edges):
        bends = _bends(nodes[first], nodes[second], rng)
        ends = [[*nodes[place], widths[place]] for place in (first, second)]
        paths.append(np.array([ends[0], *bends, ends[1]]))
        lengths[first, second] = float(np.hypot(*(nodes[second] - nodes[first])))
    start = min(places, key=lambda place: (nodes[place].sum(), place))
    path_lengths = _path_lengths(edges, lengths, side * side)[start]
    goal = int(np.where(path_lengths <= _CAVE_PATH, path_lengths, -1.0).argmax())
    return finish_map(
        name,
        carve_tunnels(CAVE_SIZE, paths, rng),
        [nodes[start], nodes[goal]],
        spawn_count=100,
        clearance=0.7,
        max_steps=1200,
    )


def _bends(
    first: NDArray[np.float64], second: NDArray[np.float64], rng: np.random.Generator
) -> list[list[float]]:
    """Two places (x m, y m, half width m) between a tunnel's ends, to either side of the line."""
    along = second - first
    across = along[::-1] * (-1, 1)
    bends = []
    for part in (0.33, 0.67):
        place = first + part * along + _uniform(rng, -0.3, 0.3) * across
        place = np.clip(place, _CAVE_MARGIN, CAVE_SIZE * RESOLUTION - _CAVE_MARGIN)
        bends.append([*place, _uniform(rng, 1.0, 1.7)])
    return bends
