"""Exact ray casting over an occupancy grid by hopping through free rectangles.

The readings agree with a cell-by-cell grid traversal to floating-point accuracy, but for the few
rays that need more hops than `iterations`: those are cut short, never too long.
"""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import NDArray

from sqn_jax.env.arithmetic import fraction, larger, smaller, to_integer
from sqn_jax.env.loops import repeat, traced_once


@struct.dataclass
class RayGrid:
    """A map prepared for rays by `free_space.far_sides`, or several one after the other.

    Of several maps `first_entry`, `resolution` and `width` have an axis, of maps or of robots.
    """

    far_sides: Array
    """[H * W * sectors] int16, where the free rectangle of a cell ends; 0 in the first sector of a
    blocked cell. The sectors of a cell lie together: a robot's beams start in one cell."""
    first_entry: Array
    """int32: where in `far_sides` the map begins."""
    resolution: Array
    """m per cell."""
    width: Array
    """int32: columns W."""
    sectors: int = struct.field(pytree_node=False)
    """Sectors of direction in the table."""

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of a single map."""
        width = int(self.width)
        return self.far_sides.size // (self.sectors * width), width


def cast_rays(
    grid: RayGrid, position: Array, angles: Array, *, max_range: Array | float, iterations: int
) -> Array:
    """Distance from a position to the first blocked cell along each angle.

    Args:
        grid: the prepared map.
        position: [2] x m, y m, in a free cell.
        angles: [R] directions, rad, any turn.
        max_range: reading where nothing is hit, m.
        iterations: rectangles a ray may cross before it is cut short.

    Returns:
        [R] distances in 0..max_range, m.
    """
    directions = (angles, jnp.cos(angles), jnp.sin(angles))
    # For a single ray, starting the next pass of a loop takes longer than the hop.
    return _hop(grid, position, directions, max_range, iterations, unroll=4)


def cast_fan(
    grid: RayGrid, pose: Array, beams: NDArray[np.float32], *, max_range: float, iterations: int
) -> Array:
    """Distance from a pose [3] to the first blocked cell along beams fixed to the robot.

    The same as `cast_rays` with the angles `pose[2] + beams`, for one sine and one cosine in all:
    those of many angles take as long as the rays themselves.

    Args:
        pose: x m, y m, heading rad.
        beams: [R] directions relative to the heading, rad, known when the program is compiled.

    Returns:
        [R] distances in 0..max_range, m.
    """
    # A few beams more, so that vectors of 8 come out even: the rest of a row is done one by one.
    count = len(beams)
    beams = np.pad(beams, (0, -count % 8))
    cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
    beam_cosines, beam_sines = np.cos(beams), np.sin(beams)
    directions = (
        pose[2] + beams,
        cosine * beam_cosines - sine * beam_sines,
        sine * beam_cosines + cosine * beam_sines,
    )
    return _hop(grid, pose[:2], directions, max_range, iterations, unroll=1)[:count]


@partial(traced_once, static_argnames=("iterations", "unroll"))
def _hop(
    grid: RayGrid,
    position: Array,
    directions: tuple[Array, Array, Array],
    max_range: Array | float,
    iterations: int,
    *,
    unroll: int,
) -> Array:
    """Cast rays of the given angles, cosines and sines, [R] each."""
    angles, cosines, sines = directions
    # The sector says where the table looks: a direction that rounding has put on the other side of
    # an axis comes back, and one on an axis moves a little aside, where 0 times infinity would
    # appear.
    sector = jnp.floor(fraction(angles * (1 / (2 * np.pi))) * grid.sectors)
    sector = jnp.where(sector < grid.sectors, sector, 0.0)
    quarter = grid.sectors // 4
    cosines = _with_sign(cosines, (sector < quarter) | (sector >= 3 * quarter))
    sines = _with_sign(sines, sector < 2 * quarter)
    inverse_cosines, inverse_sines = 1 / cosines, 1 / sines
    # Counted from the corner of the robot's own cell: far from the map's corner, single precision
    # would not distinguish the two sides of a border.
    in_cells = position / grid.resolution
    own_cell = jnp.floor(in_cells)
    x, y = in_cells - own_cell
    column, row = to_integer(own_cell)
    own_entry = grid.first_entry + (row * grid.width + column) * grid.sectors
    table_start = own_entry + to_integer(sector)
    limit = max_range / grid.resolution

    def hop(_: Array | int, traveled: Array) -> Array:
        # A thousandth of a cell beyond the last border, so that rounding cannot fall back.
        inside = traveled + 1e-3
        column, row = jnp.floor(x + cosines * inside), jnp.floor(y + sines * inside)
        place = table_start + to_integer(row * grid.width + column) * grid.sectors
        sides = _look_up(grid, place).astype(jnp.int32)
        side_x, side_y = (sides << 24) >> 24, sides >> 8
        to_side = (column + side_x.astype(jnp.float32) - x) * inverse_cosines
        to_top = (row + side_y.astype(jnp.float32) - y) * inverse_sines
        return larger(traveled, smaller(smaller(to_side, to_top), limit))

    start = jnp.zeros_like(cosines)
    return repeat(iterations, hop, start, unroll=unroll) * grid.resolution


def is_blocked(grid: RayGrid, position: Array) -> Array:
    """Whether the cell at a position [2] m is blocked; the position must lie on the map."""
    column, row = to_integer(jnp.floor(position / grid.resolution))
    return _look_up(grid, grid.first_entry + (row * grid.width + column) * grid.sectors) == 0


def _look_up(grid: RayGrid, place: Array) -> Array:
    return grid.far_sides.at[place].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _with_sign(component: Array, positive: Array) -> Array:
    """The absolute value of a component of a direction, at least 1e-7, with the sign asked for."""
    size = larger(jnp.abs(component), 1e-7)
    return jnp.where(positive, size, -size)
