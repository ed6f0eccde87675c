"""What the simulator knows of a world: `EnvParams`, and its state `EnvState`."""

from __future__ import annotations

import jax
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike, DTypeLike

from sqn_jax.config import EnvConfig
from sqn_jax.env.coverage import Lattice
from sqn_jax.env.raycast import RayGrid


def on_device(values: ArrayLike, dtype: DTypeLike) -> Array:
    """Numbers of the host on the device; `jnp.asarray` would compile a program for each shape."""
    return jax.device_put(np.asarray(values, dtype))


@struct.dataclass
class EnvParams:
    """A map and a robot, on the device. Made by `make_env`.

    All arrays are traced: a map of the same shape, another speed or another noise level is a
    `replace` or a `vmap`, not a recompilation. `config` and `max_steps` are static.
    """

    sight: RayGrid
    """The occupied cells, for range readings."""
    body: RayGrid
    """The cells the robot's center may not enter, for collisions."""
    spawn_positions: Array
    """[S, M, 2] m: places to start or finish, grouped by spawn point, padded by repetition."""
    spawn_counts: Array
    """[S] int32: how many of the M places of a spawn point are real."""
    start_points: Array
    """[D] int32: the spawn points that tasks start from, equally likely; one of a map with a weight
    comes that often."""
    spawn_groups: Array
    """[S, 2] int32: of the spawn points that reach each other the first, and how many they are; all
    of them, unless the map holds several side by side."""
    spawn_neighbors: Array
    """[S, M'] int32: the spawn points nearest to each, for tasks with a near goal."""
    near_goal_fraction: Array
    """Share of such tasks."""
    commands: Array
    """[5, 2] forward speed m/s and turn rate rad/s of each action."""
    time_step: Array
    """s."""
    goal_radius: Array
    """m."""
    velocity_noise: Array
    """[2] standard deviation of the noise on forward speed, m/s, and turn rate, rad/s; without
    effect unless `config.velocity_noise` is more than 0, which compiles the noise in."""
    range_noise: Array
    """Half-width of the uniform noise on the readings; see `EnvConfig.range_noise_unit`. Without
    effect unless `config.range_noise` is more than 0, which compiles the noise in."""
    reward_weights: Array
    """[4] weights of navigation, exploration, time and collision."""
    mirrored: Array | None
    """bool: what the robot sees is the mirror image of where it is, left for right. With turn rates
    of the other sign in `commands`, it lives in the mirror image of the map. None compiles nothing
    in."""
    config: EnvConfig = struct.field(pytree_node=False)
    """The static settings this was made from."""
    max_steps: int = struct.field(pytree_node=False)
    """Steps an episode."""
    lattice: Lattice = struct.field(pytree_node=False)
    """The points on which the covered area is counted, of one tile."""
    tile: tuple[float, float] | None = struct.field(pytree_node=False)
    """Width and height of the tiles of a map that holds several, m."""


@struct.dataclass
class EnvState:
    """The state of one episode."""

    pose: Array
    """[3] x m, y m, heading rad in [-pi, pi)."""
    goal: Array
    """[2] x m, y m."""
    covered: Array
    """[bitmasks, groups, group_rows] uint32: the points seen so far, one a bit; see `Lattice`."""
    step: Array
    """int32: steps taken."""


@struct.dataclass
class Observation:
    """What the agent sees. Every number lies in 0..1."""

    ranges: Array
    """[R] readings over the maximal range, from the rightmost beam to the leftmost."""
    goal: Array
    """[2] goal distance as `geometry.encode_distance` has it and heading (psi + pi) / 2 pi; or
    [3] distance, (1 + sin psi) / 2, (1 + cos psi) / 2 with `heading_encoding="sincos"`."""
