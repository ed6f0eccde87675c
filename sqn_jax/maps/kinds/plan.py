"""Plans: places on a square grid and what joins them, as random trees with some loops."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

Edge = tuple[int, int]


def grow_tree(
    side: int, rng: np.random.Generator, *, last: float = 0.6, straight: float = 0.0
) -> set[Edge]:
    """A random tree over a square of side x side places: edges (a, b), a < b, row * side + col.

    Args:
        side: places a side.
        rng: what decides.
        last: how often it grows from the place reached last (long paths); else from any reached so
            far (short dead ends).
        straight: how often it grows on in the direction in which that place was reached.
    """
    edges: set[Edge] = set()
    active = [int(rng.integers(side * side))]
    reached = {active[0]: active[0]}  # And from where.
    while active:
        index = len(active) - 1 if rng.random() < last else int(rng.integers(len(active)))
        place = active[index]
        new = [other for other in beside(place, side) if other not in reached]
        if not new:
            active.pop(index)
            continue
        ahead = 2 * place - reached[place]
        if straight and ahead in new and rng.random() < straight:
            other = ahead
        else:
            other = new[int(rng.integers(len(new)))]
        edges.add((min(place, other), max(place, other)))
        reached[other] = place
        active.append(other)
    return edges


def beside(place: int, side: int) -> list[int]:
    """The places left of, right of, below and above a place."""
    row, col = divmod(place, side)
    beside = [(row, col - 1), (row, col + 1), (row - 1, col), (row + 1, col)]
    return [r * side + c for r, c in beside if 0 <= r < side and 0 <= c < side]


def prune(
    edges: set[Edge], side: int, count: int, rng: np.random.Generator
) -> tuple[set[Edge], set[int]]:
    """The tree without `count` of its leaves, one after the other, and the places that are left."""
    places = set(range(side * side))
    for _ in range(count):
        joined = np.bincount(np.array(sorted(edges)).ravel(), minlength=side * side)
        leaves = np.flatnonzero(joined == 1)
        left_out = int(leaves[rng.integers(len(leaves))])
        places.discard(left_out)
        edges = {edge for edge in edges if left_out not in edge}
    return edges, places


def add_loops(
    edges: set[Edge], places: set[int], side: int, count: int, rng: np.random.Generator
) -> set[Edge]:
    """The edges and `count` more (or all there are) between neighbors among the places."""
    absent = [
        (place, other)
        for place in sorted(places)
        for other in beside(place, side)
        if place < other and other in places and (place, other) not in edges
    ]
    order = np.argsort(rng.random(len(absent)), kind="stable")
    return edges | {absent[index] for index in order[:count]}


def path_lengths(edges: set[Edge], lengths: dict[Edge, float], count: int) -> NDArray[np.float64]:
    """Length of the shortest path [count, count] between all places; inf where there is none."""
    pairs = np.array(sorted(edges))
    data = np.array([lengths[edge] for edge in sorted(edges)])
    graph = coo_array((data, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    between: NDArray[np.float64] = dijkstra(graph.tocsr(), directed=False)
    return between
