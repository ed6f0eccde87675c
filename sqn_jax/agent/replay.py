"""A ring of whole episodes on the device, drawn by priority. It knows nothing of what it stores.

Everything is a pure function of `ReplayState`. Episodes come in blocks of a fixed size that
divides the capacity, so that a block is one contiguous write. Several devices each store a shard of
every block; all have the priorities.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.shards import own_shard, take


@struct.dataclass
class ReplayState:
    """Stored items and their priorities."""

    storage: Any
    """A pytree of [blocks, N, ...] arrays; each device has its shard of every block."""
    priorities: Array
    """[capacity] float32, positive; 0 where nothing is stored. Item n of block b has the place
    b N + n."""
    position: Array
    """int32: where the next block goes."""
    size: Array
    """int32: items stored."""
    max_priority: Array
    """The largest priority seen, given to new items."""


def init(example: Any, capacity: int, block: int) -> ReplayState:
    """An empty replay for items like `example`, a pytree of arrays or shape structs.

    Args:
        example: one item.
        capacity: items to keep.
        block: N, items that will be added at a time; divides the capacity.
    """
    if capacity % block:
        raise ValueError(f"a block of {block} items does not divide the capacity {capacity}")
    shape = (capacity // block, block)
    return ReplayState(
        storage=jax.tree.map(lambda x: jnp.zeros((*shape, *x.shape), x.dtype), example),
        priorities=jnp.zeros(capacity),
        position=jnp.int32(0),
        size=jnp.int32(0),
        max_priority=jnp.float32(1.0),
    )


def num_bytes(example: Any, capacity: int) -> int:
    """Memory that `init` would allocate, bytes."""
    item = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(example))
    return capacity * (item + 4) + 12


def add(state: ReplayState, items: Any) -> ReplayState:
    """Store a block of N items [N, ...], over the oldest once full.

    On several devices each is given its own shard of the block.
    """
    chex.assert_trees_all_equal_shapes_and_dtypes(
        items, jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), state.storage)
    )
    capacity = state.priorities.shape[0]
    block = _block(state)

    def write(stored: Array, new: Array) -> Array:
        return jax.lax.dynamic_update_index_in_dim(stored, new, state.position // block, axis=0)

    fresh = jnp.full(block, state.max_priority)
    return dataclasses.replace(
        state,
        storage=jax.tree.map(write, state.storage, items),
        priorities=jax.lax.dynamic_update_slice_in_dim(state.priorities, fresh, state.position, 0),
        position=(state.position + block) % capacity,
        size=jnp.minimum(state.size + block, capacity),
    )


def _block(state: ReplayState) -> int:
    """Items of a block, on all devices together."""
    return int(state.priorities.shape[0] // jax.tree.leaves(state.storage)[0].shape[0])


def probabilities(state: ReplayState, exponent: float) -> Array:
    """Probability of each place to be drawn, [capacity]: proportional to priority ** exponent."""
    stored = jnp.arange(state.priorities.shape[0]) < state.size
    weights = jnp.where(stored, state.priorities**exponent, 0.0)
    return weights / weights.sum()


def sample(
    key: Array,
    state: ReplayState,
    batch_size: int,
    *,
    priority_exponent: float,
    importance_exponent: float,
    axis_name: str | None = None,
) -> tuple[Any, Array, Array]:
    """Draw items with replacement (Schaul et al. 2016). The replay must not be empty.

    Args:
        key: consumed.
        state: with at least one item.
        batch_size: items to draw.
        priority_exponent: 0 draws uniformly.
        importance_exponent: 0 leaves the bias of prioritized drawing uncorrected.
        axis_name: of the devices that the storage is divided between; all are given the same key.

    Returns:
        Items [B, ...], their places [B] int32, and importance weights [B] in (0, 1], scaled by
        their largest. With several devices, all places but only the own shard of items and weights.
    """
    probability = probabilities(state, priority_exponent)
    cumulative = jnp.cumsum(probability)
    draws = jax.random.uniform(key, (batch_size,)) * cumulative[-1]
    places = (cumulative[None] <= draws[:, None]).sum(axis=1, dtype=jnp.int32)
    places = jnp.minimum(places, state.size - 1)
    items = take(state.storage, *jnp.divmod(places, _block(state)), axis_name)
    weights = (state.size * probability[places]) ** -importance_exponent
    return items, places, own_shard(weights / weights.max(), axis_name)


def update_priorities(state: ReplayState, places: Array, priorities: Array) -> ReplayState:
    """Set the priorities [B] of places [B]; of a place drawn twice, one of the two.

    A priority that is not finite leaves the place the one it has.
    """
    known = jnp.where(jnp.isfinite(priorities), priorities, state.priorities[places])
    priorities = jnp.maximum(known, 1e-6)
    return dataclasses.replace(
        state,
        priorities=state.priorities.at[places].set(priorities),
        max_priority=jnp.maximum(state.max_priority, priorities.max()),
    )


def sequence_priorities(td_errors: Array, max_weight: float) -> Array:
    """Priority of sequences (R2D2, section 2.3): weight x max |d| + (1 - weight) x mean |d|.

    Args:
        td_errors: [T, B].
        max_weight: in 0..1.

    Returns:
        [B].
    """
    magnitude = jnp.abs(td_errors)
    return max_weight * magnitude.max(axis=0) + (1 - max_weight) * magnitude.mean(axis=0)
