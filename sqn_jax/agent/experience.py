"""What rollouts hand to learners."""

from __future__ import annotations

from typing import Any

from flax import struct
from jax import Array


@struct.dataclass
class Episodes:
    """T steps of N robots, time-major; every array of `obs` has one entry more, the last one seen.

    A whole episode, or a window of one. Either is cut after T steps, which is no end: `terminated`
    alone stops the bootstrap.
    """

    obs: Any
    """A pytree of [T + 1, N, ...] arrays in 0..1."""
    actions: Array
    """[T, N] int32."""
    rewards: Array
    """[T, N] float32."""
    terminated: Array
    """[T, N] bool: the episode truly ended with this step."""
    carry: Array
    """[N, H] the network's recurrent state before the first step; zero at an episode's start."""
