"""A virtual bumper: the robot makes no move that its beams show to end too near at something."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

LEAST_APPROACH = 1e-3
"""m; a move that brings the robot nearer to something by less is no approach."""
SIDEWAYS = 0.9
"""How far aside a hit lies, for its distance ahead, to be beside the robot: from 42 degrees on."""
MIDDLE = 0.02
"""m; what is so near the line of the move counts as on both sides of it."""


def is_blocked(
    ranges: Array,
    angles: ArrayLike,
    travel: Array,
    *,
    radius: float,
    reach: float,
    max_range: float,
) -> Array:
    """Whether a straight move would bring the robot's center within `reach` of what its beams hit.

    Along a wall beside it that is nearer already it may go on: on each side of its way it comes as
    near as it is to something there. From what is nearer than its own body it may drive away.

    Args:
        ranges: [R] readings, m; one of `max_range` or more is no hit.
        angles: [R] rad, of the beams.
        travel: m along the heading, negative for a move backward.
        radius: m, of the body; nearer readings are no place that it goes along.
        reach: m from the center, the radius included.
        max_range: m.

    Returns:
        A boolean scalar.
    """
    ahead, aside = ranges * jnp.cos(angles), ranges * jnp.sin(angles)
    beyond = ahead - jnp.clip(ahead, jnp.minimum(travel, 0.0), jnp.maximum(travel, 0.0))
    nearest = jnp.hypot(beyond, aside)
    is_hit = ranges < max_range
    is_approached = is_hit & (nearest < ranges - LEAST_APPROACH)
    is_beside = is_hit & (ranges >= radius) & (jnp.abs(aside) > SIDEWAYS * jnp.abs(ahead))

    def blocks(is_there: Array) -> Array:
        then = jnp.where(is_approached & is_there, nearest, jnp.inf).min()
        now = jnp.where(is_beside & is_there, ranges, jnp.inf).min()
        return (then < reach) & (then < now - LEAST_APPROACH)

    return blocks(aside > -MIDDLE) | blocks(aside < MIDDLE)
