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
