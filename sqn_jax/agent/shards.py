"""What several devices do together when each has a shard of the robots.

Everything takes the name of the axis that the shards lie along; None stands for a single device,
which has all.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

AXIS = "devices"
"""Name of the axis of the devices that share the robots of a seed."""

SEEDS = "seeds"
"""Name of the axis of the groups of devices that have seeds of their own."""


def own_shard(tree: Any, axis_name: str | None, axis: int = 0) -> Any:
    """This device's rows along `axis` of arrays that all devices have."""
    if axis_name is None:
        return tree

    def cut(array: Array) -> Array:
        rows = array.shape[axis] // jax.lax.axis_size(axis_name)
        first = jax.lax.axis_index(axis_name) * rows
        return jax.lax.dynamic_slice_in_dim(array, first, rows, axis)

    return jax.tree.map(cut, tree)


def all_shards(shard: Array, axis_name: str | None) -> Array:
    """The rows of all devices, one device's after the other's; the inverse of `own_shard`."""
    if axis_name is None:
        return shard
    return jax.lax.all_gather(shard, axis_name, tiled=True)


def mean(tree: Any, axis_name: str | None) -> Any:
    """The average over the devices of a tree of float32 arrays.

    In one message: each takes as long as the devices wait for each other, whatever its size.
    """
    if axis_name is None:
        return tree
    flat, unravel = ravel_pytree(tree)
    return unravel(jax.lax.pmean(flat, axis_name))


def take(tree: Any, rows: Array, columns: Array, axis_name: str | None) -> Any:
    """Own shard of the items [B, ...] at places of arrays whose columns lie on several devices.

    Args:
        tree: of [R, C, ...] arrays, of which each device has as many columns as any other.
        rows: [B] in 0..R - 1.
        columns: [B] in 0..C - 1, counted over all devices.
        axis_name: of the devices.

    Returns:
        The items at (rows, columns), the first B / D on the first of D devices and so on.
    """
    if axis_name is None:
        return jax.tree.map(lambda x: x[rows, columns], tree)

    def fetch(array: Array) -> Array:
        width = array.shape[1]
        own = columns - jax.lax.axis_index(axis_name) * width
        is_here = (own >= 0) & (own < width)
        items = array[rows, jnp.clip(own, 0, width - 1)].astype(_summable(array.dtype))
        # Each item is on one device only: with zeros from all others, their sum is the item.
        items = jnp.where(jnp.expand_dims(is_here, tuple(range(1, items.ndim))), items, 0)
        summed = jax.lax.psum_scatter(items, axis_name, tiled=True)
        return summed.astype(array.dtype)

    return jax.tree.map(fetch, tree)


def _summable(dtype: Any) -> Any:
    return jnp.uint8 if dtype == jnp.bool_ else dtype
