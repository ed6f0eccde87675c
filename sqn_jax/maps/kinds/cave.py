"""Caves: 51 x 51 m of rough tunnels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps.kinds.placing import uniform
from sqn_jax.maps.kinds.plan import add_loops, grow_tree, path_lengths, prune
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.maps.terrain import CAVE_SIZE, RESOLUTION, carve_tunnels, finish_map

_SIDE = 6  # places a side where tunnels may meet
_LOOPS = 3
_LEFT_OUT = 8  # places of the cave that stay rock
_MARGIN = 4.0  # m; no nearer to the border lies the course of a tunnel
_LONGEST_PATH = 115.0  # m, about the longest path from start to goal


def cave(name: str, rng: np.random.Generator) -> OccupancyMap:
    """Tunnels between places on a shifted grid; some loops, many dead ends."""
    side = _SIDE
    pitch = CAVE_SIZE * RESOLUTION / side
    edges = grow_tree(side, rng)
    edges, places = prune(edges, side, _LEFT_OUT, rng)
    edges = add_loops(edges, places, side, _LOOPS, rng)
    grid = np.stack(np.divmod(np.arange(side * side), side)[::-1], axis=-1)
    nodes = (grid + 0.5 + 0.5 * (rng.random((side * side, 2)) - 0.5)) * pitch
    nodes = np.clip(nodes, _MARGIN, CAVE_SIZE * RESOLUTION - _MARGIN)
    widths = 1.1 + 0.8 * rng.random(side * side)
    paths, lengths = [], {}
    for first, second in sorted(edges):
        bends = _bends(nodes[first], nodes[second], rng)
        ends = [[*nodes[place], widths[place]] for place in (first, second)]
        paths.append(np.array([ends[0], *bends, ends[1]]))
        lengths[first, second] = float(np.hypot(*(nodes[second] - nodes[first])))
    start = min(places, key=lambda place: (nodes[place].sum(), place))
    from_start = path_lengths(edges, lengths, side * side)[start]
    goal = int(np.where(from_start <= _LONGEST_PATH, from_start, -1.0).argmax())
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
        place = first + part * along + uniform(rng, -0.3, 0.3) * across
        place = np.clip(place, _MARGIN, CAVE_SIZE * RESOLUTION - _MARGIN)
        bends.append([*place, uniform(rng, 1.0, 1.7)])
    return bends
