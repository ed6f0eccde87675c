"""Exact ray casting over an occupancy grid by hopping through free rectangles.

The readings agree with a cell-by-cell grid traversal to floating-point accuracy, but for the few
rays that need more hops than `iterations`: those are cut short, never too long.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array


@struct.dataclass
class RayGrid:
    """A map prepared for rays by `free_space.free_rectangles`."""

    rectangles: Array
    """[sectors * H * W] uint16, width + 256 * height of the free rectangle, cells."""
    resolution: Array
    """m per cell."""
    height: int = struct.field(pytree_node=False)
    """Rows H."""
    width: int = struct.field(pytree_node=False)
    """Columns W."""
    sectors: int = struct.field(pytree_node=False)
    """Sectors of direction in the table."""


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
    cosines, sines = _nonzero(jnp.cos(angles)), _nonzero(jnp.sin(angles))
    sector = jnp.floor(angles * (grid.sectors / (2 * jnp.pi))).astype(jnp.int32) % grid.sectors
    table_start = sector * (grid.height * grid.width)
    x, y = position[0] / grid.resolution, position[1] / grid.resolution
    sign_x, sign_y = jnp.sign(cosines), jnp.sign(sines)
    inverse_x, inverse_y = 1 / cosines, 1 / sines
    # The near corner of a rectangle, from the cell's lower left: 0 going up, 1 going down.
    corner_x, corner_y = (sign_x < 0) - x, (sign_y < 0) - y
    limit = max_range / grid.resolution

    def hop(_: Array, travelled: Array) -> Array:
        # A thousandth of a cell beyond the last border, so that rounding cannot fall back.
        inside = travelled + 1e-3
        column, row = jnp.floor(x + cosines * inside), jnp.floor(y + sines * inside)
        cell = table_start + row.astype(jnp.int32) * grid.width + column.astype(jnp.int32)
        rectangle = grid.rectangles.at[cell].get(mode="promise_in_bounds").astype(jnp.int32)
        to_side = (column + corner_x + sign_x * (rectangle & 255)) * inverse_x
        to_top = (row + corner_y + sign_y * (rectangle >> 8)) * inverse_y
        farther = jnp.minimum(jnp.minimum(to_side, to_top), limit)
        return jnp.where(rectangle > 0, farther, travelled)

    start = jnp.zeros_like(cosines)
    return jax.lax.fori_loop(0, iterations, hop, start) * grid.resolution


def is_blocked(grid: RayGrid, position: Array) -> Array:
    """Whether the cell at a position [2] m is blocked; the position must lie on the map."""
    column, row = jnp.floor(position / grid.resolution).astype(jnp.int32)
    cell = row * grid.width + column
    return grid.rectangles.at[cell].get(mode="promise_in_bounds") == 0


def _nonzero(component: Array) -> Array:
    """Keep a direction off the exact axis, where 0 times infinity would appear."""
    return jnp.where(jnp.abs(component) < 1e-7, 1e-7, component)
