"""The scan of a wide robot as a slimmer one would see it: obstacles thicker, the robot the same."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

LEAST_AHEAD = 1e-6
"""m; what a beam passes just beside is not ahead of it."""


def thickened(ranges: Array, angles: ArrayLike, *, margin: float, max_range: float) -> Array:
    """Readings of the same scan if everything that a beam hits were thicker.

    Around each hit there is a disc of radius `margin`. A beam reads where it meets the first of
    them. So a robot of radius r + margin sees what one of radius r would see, if obstacles were
    wider by the margin: where the latter fits, the former does. Hits must be nearer to each other
    than two margins to make a closed wall; at 5 degrees and a margin of 0.23 m that is within 5 m.
    What no beam reaches is not made thicker: readings just below `max_range` become rare.

    Args:
        ranges: [R] m; a reading of `max_range` or more is no hit.
        angles: [R] rad, of the beams.
        margin: m, more than 0.
        max_range: m.

    Returns:
        [R] m, 0 where the robot stands within a margin of a hit in that direction.
    """
    directions = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    hits = ranges[:, None] * directions
    ahead = directions @ hits.T  # [beams, hits] m, how far along a beam a hit lies
    aside = ranges[None] ** 2 - ahead**2
    meets = (aside < margin**2) & (ahead > LEAST_AHEAD) & (ranges < max_range)[None]
    entries = ahead - jnp.sqrt(jnp.maximum(margin**2 - aside, 0.0))
    nearest = jnp.where(meets, jnp.maximum(entries, 0.0), max_range).min(axis=1)
    return jnp.minimum(nearest, ranges)
