"""A virtual bumper: the robot makes no move that its beams show to end too near at something."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

LEAST_APPROACH = 1e-3
"""m; a move that brings the robot nearer by less, along a wall, is made."""


def is_blocked(ranges: Array, angles: ArrayLike, travel: Array, *, reach: float) -> Array:
    """Whether a straight move would bring the robot's center within `reach` of what its beams hit.

    A robot that is nearer already may make every move that does not bring it nearer still.

    Args:
        ranges: [R] true readings, m; those without a hit are far away.
        angles: [R] rad, of the beams.
        travel: m along the heading, negative for a move backward.
        reach: m from the center, the radius of the body included.

    Returns:
        A boolean scalar.
    """
    ahead, aside = ranges * jnp.cos(angles), ranges * jnp.sin(angles)
    beyond = ahead - jnp.clip(ahead, jnp.minimum(travel, 0.0), jnp.maximum(travel, 0.0))
    nearest = jnp.hypot(beyond, aside).min()
    return (nearest < reach) & (nearest < ranges.min() - LEAST_APPROACH)
