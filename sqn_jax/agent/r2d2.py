"""The method of the paper: R2D2, replay of whole episodes with priorities and a target network.

Follows Kapturowski et al. 2019 with the paper's changes (section IV-C): sequences are whole
episodes and the target network follows by Polyak averaging. Since an episode is stored from its
first step on, the recurrent state starts at zero as it did on the robot.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from sqn_jax.agent import replay
from sqn_jax.agent.experience import Episodes
from sqn_jax.agent.learner import LearnerState, gradient_step, update_target
from sqn_jax.agent.loss import r2d2_loss
from sqn_jax.agent.networks import QNetwork
from sqn_jax.agent.replay import ReplayState
from sqn_jax.agent.shares import all_shares
from sqn_jax.config import TrainConfig


@struct.dataclass
class PackedEpisodes:
    """Whole episodes as stored: robot-major, 81 bytes a step."""

    obs: Any
    """`ranges` [N, T + 1, R] uint8, steps of 2 cm; `goal` [N, T + 1, G] uint16."""
    actions: Array
    """[N, T] uint8."""
    rewards: Array
    """[N, T] float32."""
    terminated: Array
    """[N, T] bool."""


def pack(episodes: Episodes) -> PackedEpisodes:
    """Whole time-major episodes to compact items."""
    compact = PackedEpisodes(
        obs=dataclasses.replace(
            episodes.obs,
            ranges=jnp.round(episodes.obs.ranges * 255).astype(jnp.uint8),
            goal=jnp.round(episodes.obs.goal * 65535).astype(jnp.uint16),
        ),
        actions=episodes.actions.astype(jnp.uint8),
        rewards=episodes.rewards,
        terminated=episodes.terminated,
    )
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), compact)


def unpack(items: PackedEpisodes, hidden_size: int) -> Episodes:
    """The inverse of `pack`, to the rounding of the integers; the recurrent state is zero."""
    compact = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), items)
    return Episodes(
        obs=dataclasses.replace(
            compact.obs,
            ranges=compact.obs.ranges.astype(jnp.float32) / 255,
            goal=compact.obs.goal.astype(jnp.float32) / 65535,
        ),
        actions=compact.actions.astype(jnp.int32),
        rewards=compact.rewards,
        terminated=compact.terminated,
        carry=jnp.zeros((compact.actions.shape[1], hidden_size)),
    )


def packed_item(episodes: Episodes) -> Any:
    """Shapes and dtypes of one stored episode, from episodes given as shapes or arrays."""
    packed = jax.eval_shape(pack, episodes)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), packed)


def learn(
    key: Array,
    state: LearnerState,
    memory: ReplayState,
    episodes: Episodes,
    network: QNetwork,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    discount: Array | float | None = None,
    axis_name: str | None = None,
) -> tuple[LearnerState, ReplayState, dict[str, Array]]:
    """Store a round of episodes and update, once enough are stored; the key is consumed.

    With the name of an axis of devices, each stores its share of the round and learns from its
    share of every minibatch; all are given the same key.
    """
    memory = replay.add(memory, pack(episodes))
    update = partial(
        _update,
        network=network,
        optimizer=optimizer,
        config=config,
        discount=discount,
        axis_name=axis_name,
    )
    keys = jax.random.split(key, config.updates_per_round)

    def all_updates(carry: Any) -> tuple[Any, dict[str, Array]]:
        return jax.lax.scan(update, carry, keys)

    def none(carry: Any) -> tuple[Any, dict[str, Array]]:
        shapes = jax.eval_shape(all_updates, carry)[1]
        return carry, jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)

    ready = memory.size >= config.replay.min_episodes
    (state, memory), metrics = jax.lax.cond(ready, all_updates, none, (state, memory))
    return state, memory, jax.tree.map(jnp.mean, metrics)


def _update(
    carry: tuple[LearnerState, ReplayState],
    key: Array,
    *,
    network: QNetwork,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
    discount: Array | float | None,
    axis_name: str | None,
) -> tuple[tuple[LearnerState, ReplayState], dict[str, Array]]:
    state, memory = carry
    settings = config.replay
    items, places, weights = replay.sample(
        key,
        memory,
        config.learner.batch_size,
        priority_exponent=settings.priority_exponent if settings.prioritized else 0.0,
        importance_exponent=settings.importance_exponent if settings.prioritized else 0.0,
        axis_name=axis_name,
    )
    episodes = unpack(items, config.network.hidden_size)

    def loss_function(params: Any) -> Any:
        return r2d2_loss(
            params, state.target_params, network, episodes, weights, config.learner, discount
        )

    state, output, metrics = gradient_step(state, optimizer, loss_function, axis_name)
    state = update_target(state, config.learner.target_update_rate)
    priorities = replay.sequence_priorities(output.td_errors, settings.max_priority_weight)
    priorities = all_shares(priorities, axis_name)
    return (state, replay.update_priorities(memory, places, priorities)), metrics
