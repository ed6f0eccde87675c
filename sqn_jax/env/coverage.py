"""The area the robot has seen: the paper's map coverage M (section III-C, eq. 7).

A place counts as seen if it lies in the field of view and no farther than the reading of the beam
nearest in angle: sectors, since single lines are 0.44 m apart at 5 m. Seen area is counted on a
lattice of points, each of which stands for a square of the lattice's cell; a bit a point.

A scan is drawn row by row of the lattice. What a row sees of a sector is an interval: between the
two edges of the sector, which cross the row at y cot(angle), and within the half-chord
sqrt(r^2 - y^2) of its circle. An interval of points is the difference of two powers of two, so
that a whole row takes a few instructions a sector, without an angle or a look-up for each point.

The lattice is turned against the map's axes by an angle whose tangent is the golden ratio.
Otherwise a wall along an axis would run beside a whole row of points, and an error of half a cell
in one would be an error in all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.env.arithmetic import fraction, larger, smaller, to_integer
from sqn_jax.env.loops import repeat, traced_once

GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
LATTICE_ANGLE = math.atan(GOLDEN_RATIO)
"""Direction of the lattice's rows on the map, rad. Seen along an axis, its points fall as evenly as
any: no ratio is farther from all simple fractions."""

ROW_BITS = 31
"""Points in a bitmask of a scan; a power of two for the place after the last still fits 32 bits."""

LARGEST_BLOCK = 20
"""Sectors that are drawn in one pass of a loop; all in one would take long to compile."""

FAR = 1e9
"""Stands for infinity, cells; times the smallest distance of a row it is still out of range."""


@dataclass(frozen=True)
class Lattice:
    """Where the points of a map lie and how they are stored; static.

    In the lattice's own frame, in cells, point m of row n is at (m, n). Bitmasks of 32 points fill
    a `covered` array [bitmasks, groups, group_rows] uint32: bit b of `covered[k, g, p]` is point
    32 k + b of row g x group_rows + p.
    """

    height: float
    """Extent of the map along y, m."""
    width: float
    """Extent of the map along x, m."""
    cell: float
    """Distance of neighboring points, m."""
    max_range: float
    """Farthest reading of the sensor, m."""
    origin: tuple[float, float]
    """Where the map's corner (0, 0) lies in the lattice's frame, cells."""
    num_bitmasks: int
    """Bitmasks in a row."""
    num_groups: int
    """Groups of rows."""

    @classmethod
    def over(cls, height_m: float, width_m: float, cell: float, max_range: float) -> Self:
        """The lattice for a map of `height_m` x `width_m` meters."""
        corners = _turn(np.array([0.0, width_m, 0.0, width_m]), np.array([0, 0, 1, 1]) * height_m)
        left, bottom = (math.floor(axis.min() / cell) - 1 for axis in corners)
        columns, rows = (
            axis.max() / cell - low + 2 for axis, low in zip(corners, (left, bottom), strict=True)
        )
        group_rows = math.ceil(max_range / cell)
        return cls(
            height=height_m,
            width=width_m,
            cell=cell,
            max_range=max_range,
            origin=(-left, group_rows - bottom),
            num_bitmasks=max(math.ceil(columns / 32), 2),
            num_groups=math.ceil(rows / group_rows) + 2,
        )

    @property
    def group_rows(self) -> int:
        """Rows in a group: as many as a scan reaches above the robot, and below."""
        return math.ceil(self.max_range / self.cell)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a `covered` array."""
        return self.num_bitmasks, self.num_groups, self.group_rows

    def points(self) -> NDArray[np.float64]:
        """Places of all points on the map, [bitmasks, groups, group_rows, 32, 2] x m, y m."""
        rows = np.arange(self.num_groups * self.group_rows).reshape(1, *self.shape[1:], 1)
        columns = np.arange(self.num_bitmasks * 32).reshape(-1, 1, 1, 32)
        u, v = (columns - self.origin[0]) * self.cell, (rows - self.origin[1]) * self.cell
        return np.stack(np.broadcast_arrays(*_turn(u, v, back=True)), axis=-1)

    def nearest_point(
        self, x: NDArray[np.floating], y: NDArray[np.floating]
    ) -> tuple[NDArray[np.intp], ...]:
        """Where in `points` the point nearest to each place on the map stands.

        Args:
            x: m, any shape.
            y: m, the same shape.

        Returns:
            Indices of bitmasks, groups, group_rows and bits, of that shape each.
        """
        u, v = _turn(x, y)
        column = np.rint(u / self.cell + self.origin[0]).astype(np.intp)
        row = np.rint(v / self.cell + self.origin[1]).astype(np.intp)
        return column // 32, row // self.group_rows, row % self.group_rows, column % 32

    def on_map(self) -> NDArray[np.uint32]:
        """The points that lie on the map, as a `covered` array; a sector may reach beyond it."""
        x, y = np.moveaxis(self.points(), -1, 0)
        inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        return np.bitwise_or.reduce(np.uint32(inside) << np.arange(32, dtype=np.uint32), axis=-1)


def empty(lattice: Lattice) -> Array:
    """A `covered` array in which nothing has been seen."""
    return jnp.zeros(lattice.shape, jnp.uint32)


def area(covered: Array, cell: float) -> Array:
    """Seen area of a `covered` array, m2."""
    return jax.lax.population_count(covered).astype(jnp.int32).sum() * cell**2


@partial(traced_once, static_argnames=("field_of_view", "lattice"))
def add_scan(
    covered: Array, pose: Array, ranges: Array, *, field_of_view: float, lattice: Lattice
) -> tuple[Array, Array]:
    """Mark what a scan sees.

    Args:
        covered: [bitmasks, groups, group_rows] uint32, the coverage so far.
        pose: [3] x m, y m, heading rad.
        ranges: [R] true readings, m, from the rightmost beam to the leftmost.
        field_of_view: angle from the first beam to the last, rad.
        lattice: the map's.

    Returns:
        The new coverage, and the newly seen area in m2.
    """
    u, v = _turn(pose[0] / lattice.cell, pose[1] / lattice.cell)
    # Rows are counted from the first that a scan on the map can reach.
    u, v = u + lattice.origin[0], v + (lattice.origin[1] - lattice.group_rows)
    sectors = _sectors(pose[2] - LATTICE_ANGLE, ranges / lattice.cell, field_of_view)
    radius = lattice.max_range / lattice.cell
    rows = jnp.floor(v) + np.arange(1 - lattice.group_rows, lattice.group_rows + 1.0)
    num_bitmasks = math.ceil(2 * radius / ROW_BITS)
    first_points = jnp.ceil(u - radius) + ROW_BITS * np.arange(num_bitmasks)
    bitmasks = _draw(rows - v, first_points - u, sectors)
    num_fresh = jnp.int32(0)
    for first_point, seen in zip(first_points, bitmasks, strict=True):
        covered, fresh = _mark(covered, rows, first_point, seen, lattice)
        num_fresh += fresh
    return covered, num_fresh.astype(jnp.float32) * lattice.cell**2


def _turn(x: Any, y: Any, *, back: bool = False) -> tuple[Any, Any]:
    """Coordinates on the map in the frame of the lattice, or `back` to the map."""
    cosine, sine = math.cos(LATTICE_ANGLE), math.sin(LATTICE_ANGLE)
    if back:
        sine = -sine
    return cosine * x + sine * y, cosine * y - sine * x


def _sectors(heading: Array, reaches: Array, field_of_view: float) -> Array:
    """The sectors that reach into the half-plane above the robot, and those below.

    Counter-clockwise from the lattice's +u axis for the half above, from -u for the half below.

    Args:
        heading: in the lattice's frame, rad.
        reaches: [R] readings, cells.
        field_of_view: rad.

    Returns:
        [4, S]: where the sectors' ends cross a row, as multiples of the row's distance, `-FAR`
        beyond the half-plane, above and below; and the squares of the sectors' reaches, above and
        below, -1 where nothing is seen. The first sector begins at or before the half-plane.
    """
    blind = reaches.shape[0]
    limits, most = _sector_limits(blind, field_of_view)
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    cosines = cosine * np.cos(limits) - sine * np.sin(limits)
    sines = sine * np.cos(limits) + cosine * np.sin(limits)
    crossings = cosines / sines
    above = jnp.where(sines > 1e-6, crossings, -FAR)
    below = jnp.where(sines < -1e-6, crossings, -FAR)
    table = jnp.concatenate([above, below, reaches * reaches, jnp.full(1, -1.0)])
    angles = jnp.array([[0.0], [np.pi]]) - heading
    sector = _sector_at(angles, blind, field_of_view) + np.arange(most, dtype=np.int32)[None]
    following = sector + 1
    sector = jnp.where(sector > blind, sector - (blind + 1), sector)
    following = jnp.where(following > blind, following - (blind + 1), following)
    own_row = np.array([[0], [blind + 1]], np.int32)
    index = jnp.concatenate([following + own_row, sector + 2 * (blind + 1)])
    return table.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _sector_limits(num_beams: int, field_of_view: float) -> tuple[NDArray[np.float32], int]:
    """Where the sectors begin, rad from the heading, and how many can touch a half-plane.

    One sector a beam, its neighbors halfway; those of the outermost beams end at the field of
    view. The last of the [R + 1] sectors is what lies beyond it and cannot be seen.
    """
    spacing = field_of_view / (num_beams - 1)
    between = (np.arange(1, num_beams) - 0.5) * spacing
    limits = np.concatenate([[0.0], between, [field_of_view]])
    widths = np.diff(limits, append=2 * np.pi)
    # A half-plane that begins at the very end of sector k touches it and all within 180 degrees.
    following = np.cumsum([np.roll(widths, -k - 1) for k in range(len(widths))], axis=1)
    touched = 2 + (following < np.pi * (1 - 1e-6)).sum(axis=1)
    most = int(min(touched.max(), len(widths)))
    return (limits - field_of_view / 2).astype(np.float32), most


def _sector_at(angle: Array, num_beams: int, field_of_view: float) -> Array:
    """Which sector a direction lies in, rad from the heading; `num_beams` beyond the view."""
    wrapped = 2 * np.pi * (fraction(angle / (2 * np.pi) + 0.5) - 0.5)
    beam = jnp.floor((wrapped / field_of_view + 0.5) * (num_beams - 1) + 0.5)
    beam = smaller(larger(beam, 0.0), num_beams - 1.0)
    return to_integer(jnp.where(jnp.abs(wrapped) > field_of_view / 2, float(num_beams), beam))


def _draw(rows: Array, starts: Array, sectors: Array) -> list[Array]:
    """Draw the sectors [4, S] around a robot.

    Args:
        rows: [2 R] rows in reach, half of them below the robot, counted from it, cells.
        starts: [W] first points of the bitmasks, counted from the robot, cells.
        sectors: from `_sectors`.

    Returns:
        The points that are seen, W times [2 R] uint32, `ROW_BITS` in each.
    """
    num_blocks = math.ceil(sectors.shape[1] / LARGEST_BLOCK)
    block = math.ceil(sectors.shape[1] / num_blocks)
    missing = num_blocks * block - sectors.shape[1]
    sectors = jnp.pad(sectors, ((0, 0), (0, missing)), constant_values=-1.0)
    halves = rows.reshape(2, -1)[::-1]
    # From the point half a cell before the first, so that rounding a place to the next whole number
    # counts the points before it.
    draw = partial(_draw_block, rows=halves, starts=starts - 0.5, block=block)
    # The first sector above the robot begins at the far right, the first one below at the left.
    begin = jnp.broadcast_to(np.array([[FAR], [-FAR]], np.float32), halves.shape)
    nothing = [jnp.zeros(halves.shape, jnp.uint32)] * len(starts)

    def draw_next(index: Array | int, carry: Any) -> Any:
        part = jax.lax.dynamic_slice_in_dim(sectors, index * block, block, axis=1)
        begin, bitmasks = carry
        return draw(begin, bitmasks, part)

    _, bitmasks = repeat(num_blocks, draw_next, (begin, nothing), unroll=1)
    return [bitmask[::-1].reshape(-1) for bitmask in bitmasks]


def _draw_block(
    begin: Array, bitmasks: list[Array], sectors: Array, *, rows: Array, starts: Array, block: int
) -> tuple[Array, list[Array]]:
    """Add a block of sectors to the bitmasks; returns the end of the last one, and the bitmasks."""
    squares = rows * rows
    for sector in range(block):
        end = rows * sectors[:2, sector, None]
        left, right = smaller(begin, end), larger(begin, end)
        # Beyond the circle the chord is 0: right of the left end and left of the right one.
        chord_squared = sectors[2:, sector, None] - squares
        chord = jnp.sqrt(larger(chord_squared, 0.0))
        right = smaller(right, chord)
        left = smaller(larger(left, -chord), right)
        bitmasks = [
            bitmask | _power(right - start) - _power(left - start)
            for bitmask, start in zip(bitmasks, starts, strict=True)
        ]
        begin = end
    return begin, bitmasks


def _power(number: Array) -> Array:
    """2 to the number, rounded and clipped to 0..`ROW_BITS`, uint32."""
    clipped = smaller(larger(number, 0.0), float(ROW_BITS))
    # The mask changes nothing but shows the compiler that no shift is too long.
    return jnp.uint32(1) << (to_integer(clipped).astype(jnp.uint32) & 31)


def _mark(
    covered: Array, rows: Array, first_point: Array, seen: Array, lattice: Lattice
) -> tuple[Array, Array]:
    """Mark the points seen of a bitmask from `first_point` on in each of the rows, [2 R] both.

    Only a window of the map is read and written, in place: two bitmasks wide, since a drawn one
    seldom begins where one of the map does, and as high as a scan. Rows always lie in the array,
    bitmasks at the map's edge may not, and the window stays inside.

    Returns:
        The new coverage, and how many points are new.
    """
    column = jnp.floor(first_point / 32)
    bit = to_integer(first_point - 32 * column).astype(jnp.uint32)
    # Upwards in two steps: by 32 at once, where nothing is left over, is no shift.
    lower, upper = seen << bit, seen >> 1 >> (31 - bit)
    own_column = smaller(larger(column, 0.0), lattice.num_bitmasks - 2.0)
    columns = own_column + np.arange(2, dtype=np.float32)[:, None]
    nothing = jnp.uint32(0)
    seen = jnp.where(columns == column, lower[None], nothing)
    seen |= jnp.where(columns == column + 1, upper[None], nothing)
    corner = (to_integer(own_column), to_integer(rows[0]) + lattice.group_rows)
    on_map = jnp.asarray(lattice.on_map().reshape(lattice.num_bitmasks, -1))
    flat = covered.reshape(on_map.shape)
    seen &= jax.lax.dynamic_slice(on_map, corner, seen.shape)
    before = jax.lax.dynamic_slice(flat, corner, seen.shape)
    after = jax.lax.dynamic_update_slice(flat, before | seen, corner)
    num_fresh = jax.lax.population_count(seen & ~before).astype(jnp.int32).sum()
    return after.reshape(covered.shape), num_fresh
