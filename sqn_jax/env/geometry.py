"""Angles and the goal as seen from the robot. Metres and radians, x forward, y to the left."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def wrap_angle(angle: Array) -> Array:
    """Return the angle folded into [-pi, pi), rad, of any shape."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


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
