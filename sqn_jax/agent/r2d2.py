"""The method of the paper: R2D2, replay of whole episodes with priorities and a target network.

Follows Kapturowski et al. 2019 with the paper's changes (section IV-C): sequences are whole
episodes and the target network follows by Polyak averaging. Since an episode is stored from its
first step on, the recurrent state starts at zero as it did on the robot.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent import replay
from sqn_jax.agent.learner import LearnerState, current_discount, gradient_step, update_target
from sqn_jax.agent.loss import LossOutput, r2d2_loss
from sqn_jax.agent.networks import Params
from sqn_jax.agent.program import Program
from sqn_jax.agent.replay import ReplayState
from sqn_jax.agent.shards import all_shards
from sqn_jax.agent.trajectory import Trajectory


@struct.dataclass
class PackedEpisodes:
    """Whole episodes as stored: robot-major, 81 bytes a step, 87 with motion."""

    obs: Any
    """`ranges` [N, T + 1, R] uint8, steps of 2 cm; `goal` [N, T + 1, G] uint16; `motion`, where
    there is any, [N, T + 1, A + 1] uint8, exact."""
    actions: Array
    """[N, T] uint8."""
    rewards: Array
    """[N, T] float32."""
    terminated: Array
    """[N, T] bool."""


_STEPS = {"ranges": 255, "goal": 65535, "motion": 1}
"""Into how many steps the numbers 0..1 of each part of an observation are divided."""


def _packed(obs: Any) -> Any:
    def integers(name: str) -> Array:
        steps = _STEPS[name]
        dtype = jnp.uint8 if steps < 256 else jnp.uint16
        return jnp.round(getattr(obs, name) * steps).astype(dtype)

    return dataclasses.replace(obs, **{x.name: integers(x.name) for x in dataclasses.fields(obs)})


def _unpacked(obs: Any) -> Any:
    def numbers(name: str) -> Array:
        return getattr(obs, name).astype(jnp.float32) / _STEPS[name]

    return dataclasses.replace(obs, **{x.name: numbers(x.name) for x in dataclasses.fields(obs)})


def pack(trajectory: Trajectory) -> PackedEpisodes:
    """Whole time-major episodes to compact items."""
    compact = PackedEpisodes(
        obs=_packed(trajectory.obs),
        actions=trajectory.actions.astype(jnp.uint8),
        rewards=trajectory.rewards,
        terminated=trajectory.terminated,
    )
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), compact)


def unpack(items: PackedEpisodes, hidden_size: int) -> Trajectory:
    """The inverse of `pack`, to the rounding of the integers; the recurrent state is zero."""
    compact = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), items)
    return Trajectory(
        obs=_unpacked(compact.obs),
        actions=compact.actions.astype(jnp.int32),
        rewards=compact.rewards,
        terminated=compact.terminated,
        carry=jnp.zeros((compact.actions.shape[1], hidden_size)),
    )


def packed_item(trajectory: Trajectory) -> Any:
    """Shapes and dtypes of one stored episode, from episodes given as shapes or arrays."""
    packed = jax.eval_shape(pack, trajectory)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), packed)


def init_memory(trajectory: Trajectory, program: Program) -> ReplayState:
    """An empty replay for rounds of N episodes [T (+ 1), N, ...], given as shapes or arrays."""
    return replay.init(
        packed_item(trajectory), program.config.replay.capacity, trajectory.actions.shape[1]
    )


def learn(
    key: Array, state: LearnerState, trajectory: Trajectory, program: Program
) -> tuple[LearnerState, dict[str, Array]]:
    """Store a round of episodes and update, once enough are stored; the key is consumed.

    On several devices each stores its shard of the round and learns from its shard of every
    minibatch; all are given the same key.
    """
    config = program.config
    memory = replay.add(state.memory, pack(trajectory))
    keys = jax.random.split(key, config.updates_per_round)

    def all_updates(state: LearnerState) -> tuple[LearnerState, dict[str, Array]]:
        return jax.lax.scan(lambda state, key: update(key, state, program), state, keys)

    def none(state: LearnerState) -> tuple[LearnerState, dict[str, Array]]:
        shapes = jax.eval_shape(all_updates, state)[1]
        return state, jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)

    is_ready = memory.size >= config.replay.min_episodes
    state = dataclasses.replace(state, memory=memory)
    state, metrics = jax.lax.cond(is_ready, all_updates, none, state)
    return state, jax.tree.map(jnp.mean, metrics)


def update(
    key: Array, state: LearnerState, program: Program
) -> tuple[LearnerState, dict[str, Array]]:
    """Draw a minibatch, learn from it, and store its new priorities; the key is consumed."""
    config = program.config.replay
    items, places, weights = replay.sample(
        key,
        state.memory,
        program.config.learner.batch_size,
        priority_exponent=config.priority_exponent if config.prioritized else 0.0,
        importance_exponent=config.importance_exponent if config.prioritized else 0.0,
        axis_name=program.axis_name,
    )
    trajectory = unpack(items, program.config.network.hidden_size)
    state, priorities, metrics = learn_from(state, trajectory, weights, program)
    priorities = all_shards(priorities, program.axis_name)
    memory = replay.update_priorities(state.memory, places, priorities)
    return dataclasses.replace(state, memory=memory), metrics


def learn_from(
    state: LearnerState, trajectory: Trajectory, weights: Array, program: Program
) -> tuple[LearnerState, Array, dict[str, Array]]:
    """One update from episodes that have been drawn.

    Args:
        state: the learner.
        trajectory: [T (+ 1), B, ...] whole episodes.
        weights: [B] importance-sampling weights.
        program: of the run.

    Returns:
        The new state, priorities [B] of the episodes, and scalars worth logging.
    """
    discount = current_discount(state, program)

    def loss_function(params: Params) -> tuple[Array, LossOutput]:
        return r2d2_loss(params, state.target_params, trajectory, weights, discount, program)

    state, output, metrics = gradient_step(state, loss_function, program)
    state = update_target(state, program.config.learner.target_update_rate)
    max_weight = program.config.replay.max_priority_weight
    return state, replay.sequence_priorities(output.td_errors, max_weight), metrics
