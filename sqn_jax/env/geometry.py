"""Angles and the goal as seen from the robot. Meters and radians, x forward, y to the left."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.config import EnvConfig

Angle = TypeVar("Angle", float, Array, NDArray[Any])
"""rad, a number or an array of JAX or of NumPy."""

AnyArray = TypeVar("AnyArray", Array, NDArray[Any])


def wrap_angle(angle: Angle) -> Angle:
    """Return the angle folded into [-pi, pi), rad, of any shape."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def beam_angles(config: EnvConfig) -> NDArray[np.float64]:
    """[R] directions of the beams from the heading, rad, from the rightmost to the leftmost."""
    half = math.radians(config.field_of_view_deg) / 2
    return np.linspace(-half, half, config.num_beams)


def goal_in_robot_frame(pose: Array, goal: Array) -> tuple[Array, Array]:
    """Line-of-sight distance and heading of the goal, the paper's d and psi (section III-A).

    Args:
        pose: [3] x m, y m, heading rad.
        goal: [2] x m, y m.

    Returns:
        Distance in m and heading in [-pi, pi), rad; 0 is straight ahead, positive to the left.
    """
    delta_x, delta_y = goal[0] - pose[0], goal[1] - pose[1]
    distance = jnp.hypot(delta_x, delta_y)
    return distance, wrap_angle(jnp.arctan2(delta_y, delta_x) - pose[2])


def encode_distance(distance: Array, config: EnvConfig) -> Array:
    """Goal distance in m, of any shape, as the agent sees it, in 0..1.

    "clipped" is d / `max_goal_distance`, and 1 from there on. "rational" is d / (d + c) with c the
    `goal_distance_scale`: steepest at the goal, and never at an end.
    """
    if config.goal_distance_encoding == "clipped":
        return jnp.clip(distance / config.max_goal_distance, 0.0, 1.0)
    return distance / (distance + config.goal_distance_scale)


def decode_goal(goal: AnyArray, config: EnvConfig) -> tuple[AnyArray, AnyArray]:
    """Distance, m, and heading, rad, from the goal as an agent sees it, [..., 2 or 3].

    The inverse of what `navigation.observe` does, for NumPy arrays, too; a distance beyond
    `farthest_shown` comes back as that.
    """
    xp: Any = jnp if isinstance(goal, Array) else np
    shown = goal[..., 0]
    if config.goal_distance_encoding == "clipped":
        distance = shown * config.max_goal_distance
    else:
        distance = config.goal_distance_scale * shown / xp.maximum(1 - shown, 2.0**-24)
    if config.heading_encoding == "linear":
        return distance, goal[..., 1] * 2 * np.pi - np.pi
    return distance, xp.arctan2(goal[..., 1] * 2 - 1, goal[..., 2] * 2 - 1)


def farthest_shown(config: EnvConfig) -> float:
    """Goal distance from which on observations are all the same, m."""
    return config.max_goal_distance if config.goal_distance_encoding == "clipped" else math.inf
