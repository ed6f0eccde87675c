"""Procedural maps: from a kind and an integer seed, one more map.

    from sqn_jax.maps.generate import generate
    occupancy_map = generate("maze", 7)

The same kind and seed give the same map bit for bit. Every map has a closed border, and all that a
robot of 0.1 m radius can stand on is one connected region.
"""

from __future__ import annotations

import operator
from collections.abc import Callable

import numpy as np

from sqn_jax.config.map_names import KINDS
from sqn_jax.maps.kinds.cave import cave
from sqn_jax.maps.kinds.clutter import clutter
from sqn_jax.maps.kinds.column import column
from sqn_jax.maps.kinds.corridors import corridors
from sqn_jax.maps.kinds.courtyard import courtyard
from sqn_jax.maps.kinds.forest import forest
from sqn_jax.maps.kinds.maze import maze
from sqn_jax.maps.kinds.rooms import rooms
from sqn_jax.maps.kinds.track import track
from sqn_jax.maps.occupancy import OccupancyMap

_MAKERS: dict[str, Callable[[str, np.random.Generator], OccupancyMap]] = {
    "maze": maze,
    "column": column,
    "forest": forest,
    "cave": cave,
    "rooms": rooms,
    "corridors": corridors,
    "track": track,
    "clutter": clutter,
    "courtyard": courtyard,
}


def generate(kind: str, seed: int) -> OccupancyMap:
    """The map of a kind that belongs to a seed.

    Args:
        kind: like the project's own maps are "maze" (17 x 17 m, corridors about 2 m wide), "column"
            (17 x 17 m, round pillars around an open middle), "forest" (17 x 17 m, asterisks) and
            "cave" (51 x 51 m, rough tunnels). Of 12.5 or 25 m a side and of proportions that
            differ from seed to seed are "rooms" (houses and offices), "corridors" (narrow or wide,
            thin or thick walls), "track" (one course, a loop or with two ends), "clutter" (posts
            and boxes in a field) and "courtyard" (open ground between buildings); their functions
            in `maps.kinds` name the ranges.
        seed: any whole number >= 0.

    Returns:
        The map, named kind-seed: 0.05 m a cell, spawn points all over, four evaluation points in a
        maze and two (start, goal) in the others. Episodes take 400 steps, 1200 in a cave, and in
        the kinds of changing size as many as their longest path asks for, 400 at least.

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
    return _MAKERS[kind](f"{kind}-{number}", np.random.Generator(np.random.PCG64(number)))
