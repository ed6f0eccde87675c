"""Whether the goal is reachable, as a robot tells from what it observes: the first case of eq. 8.

`env.reward` decides by the true readings what is rewarded; an agent knows only what it is shown.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from sqn_jax.config import EnvConfig


def goal_seems_reachable(ranges: Array, goal: Array, sensors: EnvConfig) -> Array:
    """Whether the goal lies in the field of view and nearer than the beam nearest to its direction.

    Args:
        ranges: [..., R] in 0..1, with noise if there is any.
        goal: [..., G] in 0..1.
        sensors: what the robot measures with, and how that is shown.

    Returns:
        Booleans [...].
    """
    shown = goal[..., 0]
    if sensors.goal_distance_encoding == "clipped":
        distance = shown * sensors.max_goal_distance
    else:
        distance = sensors.goal_distance_scale * shown / jnp.maximum(1 - shown, 2.0**-24)
    if sensors.heading_encoding == "linear":
        heading = goal[..., 1] * 360 - 180
    else:
        heading = jnp.degrees(jnp.arctan2(goal[..., 1] * 2 - 1, goal[..., 2] * 2 - 1))
    last_beam = ranges.shape[-1] - 1
    beam = (heading / sensors.field_of_view_deg + 0.5) * last_beam
    nearest = jnp.clip(jnp.floor(beam + 0.5), 0, last_beam).astype(jnp.int32)
    reading = jnp.take_along_axis(ranges, nearest[..., None], axis=-1)[..., 0] * sensors.max_range
    in_view = jnp.abs(heading) <= sensors.field_of_view_deg / 2
    return in_view & (distance < reading)
