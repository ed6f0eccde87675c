"""The area the robot has seen: the paper's map coverage M (section III-C, eq. 6).

A place counts as seen if it lies in the field of view and no farther than the reading of the beam
nearest in angle: sectors, since single lines are 0.44 m apart at 5 m. The map is divided into
coverage cells with one sample point each, and the covered area is the number of seen points times
the area of a cell. The points are offset differently in each row and column, so that walls along
the axes do not beat against the lattice. Only the cells within the range of the sensor are looked
at in a step; eight of a row share a byte.

Most of the simulator's time goes into this module: two thousand cells a step, each with an angle,
a look-up of a reading and a comparison. See `stages.stage` for how it is kept in vector code.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from sqn_jax.env.geometry import polynomial_arctan2
from sqn_jax.env.stages import stage

GOLDEN_RATIO = 0.618034
SECOND_RATIO = 0.754878


def grid_shape(height_m: float, width_m: float, cell: float) -> tuple[int, int]:
    """Rows and bytes a row of the coverage of a map, for `height_m` x `width_m` metres."""
    return math.ceil(height_m / cell), math.ceil(width_m / cell / 8)


def empty(shape: tuple[int, int]) -> Array:
    """A coverage [rows, bytes] in which nothing has been seen."""
    return jnp.zeros(shape, jnp.uint8)


def add_scan(
    covered: Array,
    pose: Array,
    ranges: Array,
    *,
    field_of_view: float,
    max_range: float,
    cell: float,
    always: Array,
) -> tuple[Array, Array]:
    """Mark what a scan sees.

    Args:
        covered: [rows, bytes] uint8, the coverage so far.
        pose: [3] x m, y m, heading rad.
        ranges: [R] true readings, m, from the rightmost beam to the leftmost.
        field_of_view: angle from the first beam to the last, rad.
        max_range: the farthest reading, m.
        cell: side of a coverage cell, m.
        always: True; see `stages.stage`.

    Returns:
        The new coverage, and the newly seen area in m2.
    """
    first_row = jnp.floor((pose[1] - max_range) / cell)
    first_byte = jnp.floor((pose[0] - max_range) / (8 * cell))
    num_rows = math.ceil(2 * max_range / cell) + 1
    num_bytes = math.ceil((num_rows + 7) / 8)
    rows = first_row + jnp.arange(num_rows, dtype=jnp.float32)
    columns = 8 * first_byte + jnp.arange(8 * num_bytes, dtype=jnp.float32)
    axes = stage(always, partial(_robot_axes, cell=cell), pose, rows, columns)
    half_beams_per_radian = 2 * (ranges.shape[0] - 1) / field_of_view
    to_half_beam = partial(_half_beams, per_radian=half_beams_per_radian, num_beams=ranges.shape[0])
    half_beam, distance_squared = stage(always, to_half_beam, *axes)
    limits = stage(always, _squared_readings, ranges)
    seen = stage(always, _is_within, limits, half_beam, distance_squared)
    window = stage(always, _pack_bits, seen)
    place = partial(_place_window, shape=covered.shape)
    on_map = stage(always, place, window, first_row, first_byte)
    fresh = stage(always, _count_new_bits, on_map, covered)
    # A product with ones: the CPU adds up a row so faster than by a reduction.
    return covered | on_map, fresh @ jnp.ones(fresh.shape) * cell**2


def area(covered: Array, cell: float) -> Array:
    """Seen area of a coverage [rows, bytes], m2."""
    return jax.lax.population_count(covered).astype(jnp.int32).sum() * cell**2


def _robot_axes(
    pose: Array, rows: Array, columns: Array, *, cell: float
) -> tuple[Array, Array, Array, Array]:
    """Sample points of [rows] x [columns] in the robot's frame, m.

    The sample point of a cell is shifted along the row by an amount of the row's own, and along the
    column by one of the column's own, so that both coordinates are sums.

    Returns:
        Summands of the distance ahead [columns], [rows], and of that to the left [columns], [rows].
    """
    x_of_column, x_of_row = columns * cell - pose[0], _fraction(rows * GOLDEN_RATIO) * cell
    y_of_row, y_of_column = rows * cell - pose[1], _fraction(columns * SECOND_RATIO) * cell
    cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
    return (
        cosine * x_of_column + sine * y_of_column,
        cosine * x_of_row + sine * y_of_row,
        cosine * y_of_column - sine * x_of_column,
        cosine * y_of_row - sine * x_of_row,
    )


def _fraction(numbers: Array) -> Array:
    return numbers - jnp.floor(numbers)


def _half_beams(
    ahead_of_column: Array,
    ahead_of_row: Array,
    left_of_column: Array,
    left_of_row: Array,
    *,
    per_radian: float,
    num_beams: int,
) -> tuple[Array, Array]:
    """Direction of each sample point as an index into `_squared_readings`, and distance squared."""
    ahead = ahead_of_column[None] + ahead_of_row[:, None]
    left = left_of_column[None] + left_of_row[:, None]
    half_beam = polynomial_arctan2(left, ahead) * per_radian + num_beams
    index = jnp.clip(half_beam, 0.0, 2.0 * num_beams - 1).astype(jnp.int32)
    return index, ahead * ahead + left * left


def _squared_readings(ranges: Array) -> Array:
    """[2 R] squared reading that counts in each half of a sector; -1 beyond the field of view.

    Between two beams the first half belongs to the one on the right, the second to the other.
    """
    outside = jnp.full(1, -1.0)
    return jnp.concatenate([outside, jnp.repeat(ranges * ranges, 2)[1:-1], outside])


def _is_within(limits: Array, index: Array, distance_squared: Array) -> Array:
    return limits.at[index].get(mode="promise_in_bounds") >= distance_squared


def _pack_bits(bits: Array) -> Array:
    """[rows, 8 bytes] bool to [rows, bytes] uint8, the first bit the lowest.

    Four booleans are read as one number; a product shifts each to its place in the upper byte.
    """
    fours = bits.reshape(bits.shape[0], -1, 2, 4).astype(jnp.uint8)
    number = jax.lax.bitcast_convert_type(fours, jnp.uint32)
    nibbles = (number * jnp.uint32(0x01020408) >> 24) & 15
    return (nibbles[..., 0] | nibbles[..., 1] << 4).astype(jnp.uint8)


def _place_window(
    window: Array, first_row: Array, first_byte: Array, *, shape: tuple[int, ...]
) -> Array:
    """The window where it belongs on a map of [rows, bytes], and nothing seen around it."""
    # By a slice of a padded copy: a scatter is serial on the CPU.
    rows, columns = shape
    padded = jnp.pad(window, ((rows, rows), (columns, columns)))
    start = (rows - first_row.astype(jnp.int32), columns - first_byte.astype(jnp.int32))
    return jax.lax.dynamic_slice(padded, start, shape)


def _count_new_bits(seen: Array, covered: Array) -> Array:
    """How many bits of each byte are newly seen, in a flat row of floats."""
    return jax.lax.population_count(seen & ~covered).astype(jnp.float32).reshape(-1)
