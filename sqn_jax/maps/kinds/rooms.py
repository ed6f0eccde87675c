"""Rooms: floors of houses and offices, with doors, corridors and furniture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree

from sqn_jax.maps.kinds.furniture import furnish
from sqn_jax.maps.kinds.placing import in_cells, uniform
from sqn_jax.maps.kinds.points import draw_size, with_points
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.maps.terrain import RESOLUTION, WALL, walled_square

_JAMB = 2  # cells of wall beside a door, at least
_DOORWAY = 14  # cells before and behind a door that stay free of furniture


@dataclass(frozen=True)
class Room:
    """A rectangle of free cells: rows from `bottom` to before `top`, columns likewise."""

    bottom: int
    top: int
    left: int
    right: int
    is_corridor: bool = False

    @property
    def cells(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return slice(self.bottom, self.top), slice(self.left, self.right)

    @property
    def turned(self) -> Room:
        """The same with rows and columns exchanged."""
        return Room(self.left, self.right, self.bottom, self.top, self.is_corridor)


@dataclass(frozen=True)
class Style:
    """How a floor is built; lengths in cells."""

    wall: int
    smallest: int
    """Side of a room."""
    corridors: float
    """How often a large part is divided by a corridor and not by a wall."""
    doors: tuple[int, int]
    """Widths from the first to the second."""
    more_doors: float
    """How many of the walls between two rooms have a door that is not needed."""
    openings: float
    """How many doors are wide openings."""


def rooms(name: str, rng: np.random.Generator) -> OccupancyMap:
    """A floor, divided again and again or into equal rooms.

    For each map are drawn: 12.5 or 25 m a side; whether it fills the map, with some rooms left out,
    or stands on open ground with entrances; walls of 0.1 to 0.5 m; rooms of 1.6 to 5 m or more a
    side; corridors of 1 to 2 m; doors of 0.5 to 1.2 m, all alike or not, and openings of 1.3 to
    3 m; how many doors there are beyond those that are needed; how much furniture stands about.
    """
    size = draw_size(rng)
    style = _draw_style(rng)
    yard = in_cells(rng, 1.2, 3.0) if rng.random() < 0.35 else 0
    edge = WALL + (yard + style.wall if yard else 0)
    floor = Room(edge, size - edge, edge, size - edge)
    divided = _equal(floor, style, rng) if rng.random() < 0.3 else _divided(floor, style, rng)
    occupied = walled_square(size)
    if yard:
        occupied[floor.cells] = True
        occupied[WALL + yard : -WALL - yard, WALL + yard : -WALL - yard] = True
    else:
        occupied[:] = True
    divided = _without_some(divided, rng)
    for room in divided:
        occupied[room.cells] = False
    keep_free = np.zeros_like(occupied)
    _add_doors(occupied, keep_free, divided, style, rng)
    if yard:
        _add_entrances(occupied, keep_free, divided, floor, style, rng)
    furnish(occupied, keep_free, [room.cells for room in divided if not room.is_corridor], rng)
    return with_points(name, occupied)


def _draw_style(rng: np.random.Generator) -> Style:
    narrow = in_cells(rng, 0.5, uniform(rng, 0.5, 0.9))
    wide = in_cells(rng, narrow * RESOLUTION, 1.2)
    return Style(
        wall=in_cells(rng, 0.1, 0.25) if rng.random() < 0.75 else in_cells(rng, 0.25, 0.5),
        smallest=in_cells(rng, 1.6, 3.5),
        corridors=uniform(rng, -0.5, 1.0),
        doors=(narrow, wide),
        more_doors=uniform(rng, 0.0, 0.5),
        openings=uniform(rng, -0.3, 0.4),
    )


def _divided(part: Room, style: Style, rng: np.random.Generator) -> list[Room]:
    """The part as rooms: cut in two, by a wall or by a corridor, until they are small."""
    height, width = part.top - part.bottom, part.right - part.left
    if height > width or (height == width and rng.random() < 0.5):
        return [room.turned for room in _divided(part.turned, style, rng)]
    # From here on it is cut from left to right.
    spare = width - 2 * style.smallest - style.wall
    if spare < 0 or (width < 5 * style.smallest // 2 and rng.random() < 0.3):
        return [part]
    corridor = in_cells(rng, 1.0, 2.0)
    has_corridor = height > style.smallest and rng.random() < style.corridors
    if not has_corridor or spare < corridor + style.wall:
        end = part.left + style.smallest + int(rng.integers(spare + 1))
        second = end + style.wall
        between = []
    else:
        end = part.left + style.smallest + int(rng.integers(spare - corridor - style.wall + 1))
        second = end + corridor + 2 * style.wall
        between = [Room(part.bottom, part.top, end + style.wall, second - style.wall, True)]
    first_part = Room(part.bottom, part.top, part.left, end)
    second_part = Room(part.bottom, part.top, second, part.right)
    return [*_divided(first_part, style, rng), *between, *_divided(second_part, style, rng)]


def _equal(floor: Room, style: Style, rng: np.random.Generator) -> list[Room]:
    """Rows and columns of rooms alike."""
    length = floor.top - floor.bottom + style.wall
    pitch = in_cells(rng, 1.6, 5.0) + style.wall
    count = max(length // pitch, 2)
    edges = [floor.bottom + k * length // count for k in range(count + 1)]
    spans = [(edges[k], edges[k + 1] - style.wall) for k in range(count)]
    return [Room(*rows, *cols) for rows in spans for cols in spans]


def _without_some(divided: list[Room], rng: np.random.Generator) -> list[Room]:
    """In one half, all but up to a fifth of the rooms; corridors stay."""
    if rng.random() < 0.5:
        return divided
    fraction = uniform(rng, 0.0, 0.2)
    selected = [room for room in divided if room.is_corridor or rng.random() >= fraction]
    return selected if len(selected) > 1 else divided


def _overlap(first: Room, second: Room, style: Style) -> tuple[int, int] | None:
    """Rows in which the second room lies behind the first one's right wall, if it does."""
    if first.right + style.wall != second.left:
        return None
    return max(first.bottom, second.bottom), min(first.top, second.top)


def _add_doors(
    occupied: NDArray[np.bool_],
    keep_free: NDArray[np.bool_],
    divided: list[Room],
    style: Style,
    rng: np.random.Generator,
) -> None:
    """Doors so that every room can be reached, and some more, cut into `occupied`."""
    needed = style.doors[1] + 2 * _JAMB
    walls = []
    for i, first in enumerate(divided):
        for j, second in enumerate(divided):
            for turned in (False, True):
                pair = (first.turned, second.turned) if turned else (first, second)
                rows = _overlap(*pair, style)
                if rows is not None and rows[1] - rows[0] >= needed:
                    walls.append((i, j, turned, rows))
    # A random tree, that leads over corridors where it can.
    weights = [
        rng.random() + 1.0 - 0.9 * (divided[i].is_corridor or divided[j].is_corridor)
        for i, j, _, _ in walls
    ]
    ends = np.array([wall[:2] for wall in walls]).reshape(-1, 2).T
    graph = coo_array((weights, (ends[0], ends[1])), shape=(len(divided), len(divided))).tocsr()
    tree = minimum_spanning_tree(graph).tocoo()
    joined = set(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
    for i, j, turned, (bottom, top) in walls:
        if (i, j) not in joined and rng.random() >= style.more_doors:
            continue
        room = divided[i].turned if turned else divided[i]
        width = _draw_door(top - bottom - 2 * _JAMB, style, rng)
        start = bottom + _JAMB + int(rng.integers(top - bottom - 2 * _JAMB - width + 1))
        _cut(occupied, keep_free, (start, width, room.right, style.wall), turned=turned)


def _draw_door(most: int, style: Style, rng: np.random.Generator) -> int:
    """How wide a door is, in cells, or an opening, where there is room for it."""
    if rng.random() < style.openings and most >= 26:
        return min(in_cells(rng, 1.3, 3.0), most)
    return int(rng.integers(style.doors[0], style.doors[1] + 1))


def _cut(
    occupied: NDArray[np.bool_],
    keep_free: NDArray[np.bool_],
    door: tuple[int, int, int, int],
    *,
    turned: bool,
) -> None:
    """Cut a door, (first row, width, first column, depth), rows and columns exchanged if turned."""
    row, width, col, depth = door
    free, doorway = (occupied.T, keep_free.T) if turned else (occupied, keep_free)
    free[row : row + width, col : col + depth] = False
    doorway[row - 2 : row + width + 2, col - _DOORWAY : col + depth + _DOORWAY] = True


def _add_entrances(
    occupied: NDArray[np.bool_],
    keep_free: NDArray[np.bool_],
    divided: list[Room],
    floor: Room,
    style: Style,
    rng: np.random.Generator,
) -> None:
    """One to four doors to the ground outside."""
    for _ in range(int(rng.integers(1, 5))):
        turned, far = rng.random() < 0.5, rng.random() < 0.5
        outer = []
        for room in divided:
            own = room.turned if turned else room
            if own.right == floor.right if far else own.left == floor.left:
                outer.append(own)
        outer = [own for own in outer if own.top - own.bottom >= style.doors[1] + 2 * _JAMB]
        if not outer:
            continue
        own = outer[int(rng.integers(len(outer)))]
        width = _draw_door(own.top - own.bottom - 2 * _JAMB, style, rng)
        start = own.bottom + _JAMB + int(rng.integers(own.top - own.bottom - 2 * _JAMB - width + 1))
        col = own.right if far else own.left - style.wall
        _cut(occupied, keep_free, (start, width, col, style.wall), turned=turned)
