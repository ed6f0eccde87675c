"""How the robot moves: unicycle motion with a collision check along the whole path."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from sqn_jax.env.geometry import wrap_angle
from sqn_jax.env.raycast import RayGrid, cast_rays, is_blocked


def move(
    pose: Array, velocity: Array, body_grid: RayGrid, *, time_step: Array, iterations: int
) -> tuple[Array, Array]:
    """Move for one step; a move into an occupied place is refused as a whole (section IV-A).

    The robot follows an arc; its end is exact and its path is checked along the chord (the actions
    of the paper either translate or turn, so arc and chord differ only under velocity noise). A
    refused move leaves the position as it was; the turn is made all the same.

    Args:
        pose: [3] x m, y m, heading rad.
        velocity: [2] forward speed m/s (negative is backward), turn rate rad/s.
        body_grid: the places the robot's center may not enter, as a `RayGrid`.
        time_step: s.
        iterations: rectangles the path may cross; a longer path counts as blocked.

    Returns:
        The new pose, its heading in [-pi, pi), and whether a move was refused.
    """
    turn = velocity[1] * time_step
    # jnp.sinc(z) is sin(pi z) / (pi z): the chord of an arc of this length and turn.
    chord = velocity[0] * time_step * jnp.sinc(turn / (2 * jnp.pi))
    length = jnp.abs(chord)
    direction = pose[2] + turn / 2
    travel = direction + jnp.where(chord < 0, jnp.pi, 0.0)
    # Half a millimeter beyond the end, so that the new place is inside a free cell.
    needed = length + 5e-4
    clear = cast_rays(
        body_grid, pose[:2], travel[None], max_range=needed + 1e-3, iterations=iterations
    )[0]
    step = chord * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
    # A ray may cut a corner by less than a thousandth of a cell; an end there would be a trap.
    end = jnp.where(clear < needed, pose[:2], pose[:2] + step)
    refused = (length > 0) & ((clear < needed) | is_blocked(body_grid, end))
    position = jnp.where(refused, pose[:2], end)
    return jnp.append(position, wrap_angle(pose[2] + turn)), refused
