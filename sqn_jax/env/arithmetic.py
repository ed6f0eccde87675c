"""Element-wise operations in the form that compiles to the fewest instructions.

XLA keeps NaN through `jnp.minimum` and saturates when a float becomes an integer; on the CPU each
of these costs four or five vector instructions where one does for numbers known to be plain. Most
of the simulator's arithmetic is of this kind.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

LARGEST_INTEGER = 2**22
"""Whole numbers up to this size pass through `to_integer`."""

_ROUNDING = np.float32(1.5 * 2**23)
_ROUNDING_BITS = np.int32(_ROUNDING.view(np.int32))


def require_single_precision() -> None:
    """Refuse a mode of JAX in which numbers that are not cast are float64.

    Raises:
        ValueError: `jax_enable_x64` is on.
    """
    if jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise ValueError(
            "jax_enable_x64 is on, expected it off: the simulator computes in single precision "
            "(jax.enable_x64(False) as a context, or JAX_ENABLE_X64=0)"
        )


def smaller(a: Array | float, b: Array | float) -> Array:
    """The smaller of two numbers, neither of them NaN."""
    return jnp.where(a < b, a, b)


def larger(a: Array | float, b: Array | float) -> Array:
    """The larger of two numbers, neither of them NaN."""
    return jnp.where(a > b, a, b)


def to_integer(number: Array) -> Array:
    """Round float32 numbers of at most `LARGEST_INTEGER` in size to int32, halves to even.

    The sum with 1.5 x 2^23 has the rounded number in its lowest bits.

    Raises:
        ValueError: `jax_enable_x64` is on.
    """
    require_single_precision()
    return jax.lax.bitcast_convert_type(number + _ROUNDING, jnp.int32) - _ROUNDING_BITS


def fraction(number: Array) -> Array:
    """What is above the next lower whole number, in 0..1."""
    return number - jnp.floor(number)
