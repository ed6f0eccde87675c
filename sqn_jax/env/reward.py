"""The reward of the paper (section III-C, eq. 7 to 9): navigation, exploration and time.

Beside it there is a term for collisions, not in the paper; its weight is 0 by default.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def goal_is_reachable(
    goal_distance: Array, goal_heading: Array, ranges: Array, *, field_of_view: float
) -> Array:
    """Whether the goal is reachable from what the robot sees now: g in S_obs of eq. 8.

    Reachable means in the field of view and nearer than the reading of the beam nearest to the
    goal's direction; a goal close by behind a wall is not.

    Args:
        goal_distance: m.
        goal_heading: rad in [-pi, pi), 0 straight ahead.
        ranges: [R] true readings, m, evenly spaced from -field_of_view / 2 to + field_of_view / 2.
        field_of_view: rad.

    Returns:
        A boolean scalar.
    """
    last_beam = ranges.shape[0] - 1
    beam = goal_heading / field_of_view * last_beam + last_beam / 2
    nearest_beam = jnp.clip(jnp.floor(beam + 0.5), 0, last_beam).astype(jnp.int32)
    in_view = jnp.abs(goal_heading) <= field_of_view / 2
    return in_view & (goal_distance < ranges[nearest_beam])


def navigation_reward(goal_distance: Array, reachable: Array) -> Array:
    """exp(-d) while the goal is reachable, else 0 (eq. 8); d in m, so the unit is 1."""
    return jnp.where(reachable, jnp.exp(-goal_distance), 0.0)


def exploration_reward(newly_covered_area: Array) -> Array:
    """Growth of the covered area (eq. 7), m2."""
    return newly_covered_area


def time_reward() -> float:
    """The constant penalty of a step: -1."""
    return -1.0


def collision_reward(collision: Array) -> Array:
    """The penalty of a collision: -1, else 0."""
    return jnp.where(collision, -1.0, 0.0)


def total_reward(
    navigation: Array, exploration: Array, time: float, collision: Array, weights: Array
) -> Array:
    """Weighted sum of the terms (eq. 9); `weights` [4] in the order of the arguments."""
    of_paper = weights[0] * navigation + weights[1] * exploration + weights[2] * time
    return of_paper + weights[3] * collision
