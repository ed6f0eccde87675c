"""The area the robot has seen: the paper's map coverage M (section III-C, eq. 6).

A place counts as seen if it lies in the field of view and no farther than the reading of the beam
nearest in angle: sectors, since single lines are 0.44 m apart at 5 m. The map is divided into
coverage cells with one sample point each, and the covered area is the number of seen points times
the area of a cell. The points are offset differently in each row and column, so that walls along
the axes do not beat against the lattice. Only the cells within the range of the sensor are looked
at in a step; eight of a row share a byte.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array

from sqn_jax.env.geometry import polynomial_arctan2

GOLDEN_RATIO = 0.618034
SECOND_RATIO = 0.754878


def grid_shape(height_m: float, width_m: float, cell: float) -> tuple[int, int]:
    """Rows and bytes a row of the coverage of a map, for `height_m` x `width_m` metres."""
    return math.ceil(height_m / cell), math.ceil(width_m / cell / 8)


def empty(shape: tuple[int, int]) -> Array:
    """A coverage [rows, bytes] in which nothing has been seen."""
    return jnp.zeros(shape, jnp.uint8)


def sample_points(rows: Array, columns: Array, cell: float) -> tuple[Array, Array]:
    """Positions x, y in m of the sample points of coverage cells, given as float indices."""
    shift_x = rows * GOLDEN_RATIO
    shift_y = columns * SECOND_RATIO
    x = (columns + shift_x - jnp.floor(shift_x)) * cell
    y = (rows + shift_y - jnp.floor(shift_y)) * cell
    return x, y


def add_scan(
    covered: Array,
    pose: Array,
    ranges: Array,
    *,
    field_of_view: float,
    max_range: float,
    cell: float,
) -> tuple[Array, Array]:
    """Mark what a scan sees.

    Args:
        covered: [rows, bytes] uint8, the coverage so far.
        pose: [3] x m, y m, heading rad.
        ranges: [R] true readings, m, from the rightmost beam to the leftmost.
        field_of_view: angle from the first beam to the last, rad.
        max_range: the farthest reading, m.
        cell: side of a coverage cell, m.

    Returns:
        The new coverage, and the newly seen area in m2.
    """
    window, first_row, first_byte = _visible_window(pose, ranges, field_of_view, max_range, cell)
    # Place the window by a slice of a padded copy: a scatter is serial on the CPU.
    rows, columns = covered.shape
    padded = jnp.pad(window, ((rows, rows), (columns, columns)))
    seen = jax.lax.dynamic_slice(padded, (rows - first_row, columns - first_byte), covered.shape)
    fresh = jax.lax.population_count(seen & ~covered).astype(jnp.int32).sum()
    return covered | seen, fresh.astype(jnp.float32) * cell**2


def area(covered: Array, cell: float) -> Array:
    """Seen area of a coverage [rows, bytes], m2."""
    return jax.lax.population_count(covered).astype(jnp.int32).sum() * cell**2


def _visible_window(
    pose: Array, ranges: Array, field_of_view: float, max_range: float, cell: float
) -> tuple[Array, Array, Array]:
    """Bits of the cells within range: [window rows, window bytes], and where the window lies.

    The stages are kept apart by barriers on purpose: fused into one loop they compile to scalar
    code, which is four times slower on the CPU.
    """
    num_rows = math.ceil(2 * max_range / cell) + 1
    num_bytes = math.ceil((num_rows + 7) / 8)
    first_row = jnp.floor((pose[1] - max_range) / cell)
    first_byte = jnp.floor((pose[0] - max_range) / (8 * cell))
    index = jnp.arange(num_rows * num_bytes * 8, dtype=jnp.int32)
    rows = first_row + (index // (num_bytes * 8)).astype(jnp.float32)
    columns = first_byte * 8 + (index % (num_bytes * 8)).astype(jnp.float32)
    x, y = sample_points(rows, columns, cell)
    delta_x, delta_y = x - pose[0], y - pose[1]
    cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
    forward, left = cosine * delta_x + sine * delta_y, cosine * delta_y - sine * delta_x
    num_beams = ranges.shape[0]
    beam = polynomial_arctan2(left, forward) * ((num_beams - 1) / field_of_view)
    beam = beam + (num_beams - 1) / 2
    in_view = (beam >= 0) & (beam <= num_beams - 1)
    distance_squared = jnp.where(in_view, delta_x**2 + delta_y**2, jnp.inf)
    nearest_beam = jnp.clip(jnp.floor(beam + 0.5), 0, num_beams - 1).astype(jnp.int32)
    nearest_beam, distance_squared = jax.lax.optimization_barrier((nearest_beam, distance_squared))
    reading = ranges.at[nearest_beam].get(mode="promise_in_bounds")
    reading = jax.lax.optimization_barrier(reading)
    bits = (reading**2 >= distance_squared).reshape(num_rows, num_bytes, 8)
    powers = 2 ** jnp.arange(8, dtype=jnp.int32)
    # A sum, not shifts and ors: reductions are not fused into what follows, so that the window is
    # computed once and not again for every cell of the map that looks at it.
    window = jnp.where(bits, powers, 0).sum(axis=-1).astype(jnp.uint8)
    return window, first_row.astype(jnp.int32), first_byte.astype(jnp.int32)
