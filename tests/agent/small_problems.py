"""Tiny networks with random weights and tiny random episodes, the same in every run."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from learning_oracle import Batch

from sqn_jax.agent import QNetwork, Trajectory, make_network
from sqn_jax.config import NetworkConfig

NUM_ACTIONS = 3
NUM_BEAMS = 4
NUM_GOAL = 2
HIDDEN = 5


@struct.dataclass
class Seen:
    """An observation as the networks expect one."""

    ranges: Any
    goal: Any


@struct.dataclass
class SeenWithMotion(Seen):
    """One for networks that take their last motion, too."""

    motion: Any


def small_network(algo: str, *, hidden_size: int = HIDDEN, **settings: Any) -> QNetwork:
    config = NetworkConfig(hidden_size=hidden_size, **settings)
    return make_network(algo, config, NUM_ACTIONS)


def random_obs(rng: np.random.Generator, length: int, batch: int) -> Seen:
    return Seen(
        ranges=jnp.asarray(rng.random((length, batch, NUM_BEAMS)), jnp.float32),
        goal=jnp.asarray(rng.random((length, batch, NUM_GOAL)), jnp.float32),
    )


def random_params(network: QNetwork, rng: np.random.Generator, obs: Any = None) -> Any:
    """Every parameter random, those too that start at zero, one or close to it."""
    obs = random_obs(rng, 1, 1) if obs is None else jax.tree.map(lambda x: x[:1, :1], obs)
    carry = jnp.zeros((1, network.config.hidden_size))
    shapes = jax.eval_shape(network.init, jax.random.key(0), obs, carry)

    def draw(path: Any, leaf: Any) -> Array:
        spread = 1 / np.sqrt(leaf.shape[0]) if len(leaf.shape) == 2 else 0.4
        centre = 1.0 if path[-1].key == "scale" else 0.0
        return jnp.asarray(centre + spread * rng.normal(size=leaf.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def random_episodes(
    rng: np.random.Generator, length: int, batch: int, *, terminated: float = 0.0
) -> Trajectory:
    """Steps that end truly with the given chance, driven with a recurrent state in mid-way."""
    return Trajectory(
        obs=random_obs(rng, length + 1, batch),
        actions=jnp.asarray(rng.integers(0, NUM_ACTIONS, (length, batch)), jnp.int32),
        rewards=jnp.asarray(rng.normal(size=(length, batch)), jnp.float32),
        terminated=jnp.asarray(rng.random((length, batch)) < terminated),
        carry=jnp.asarray(rng.normal(size=(batch, HIDDEN)), jnp.float32),
    )


def of_robots(episodes: Trajectory, robots: Any) -> Trajectory:
    """The episodes of some robots only, field by field."""
    return Trajectory(
        obs=Seen(episodes.obs.ranges[:, robots], episodes.obs.goal[:, robots]),
        actions=episodes.actions[:, robots],
        rewards=episodes.rewards[:, robots],
        terminated=episodes.terminated[:, robots],
        carry=episodes.carry[robots],
    )


def in_float64(tree: Any) -> Any:
    """Plain NumPy numbers in double precision, for the oracle."""
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


def as_batch(episodes: Trajectory) -> Batch:
    return Batch(
        ranges=np.asarray(episodes.obs.ranges, np.float64),
        goal=np.asarray(episodes.obs.goal, np.float64),
        actions=np.asarray(episodes.actions, np.int64),
        rewards=np.asarray(episodes.rewards, np.float64),
        terminated=np.asarray(episodes.terminated),
        carry=np.asarray(episodes.carry, np.float64),
    )
