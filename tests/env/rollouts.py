"""Whole episodes for the simulator's tests: many robots in one compiled program."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.env import EnvParams, EnvState, Observation, reset, step

TURN_LEFT, TURN_RIGHT = 3, 4


class Rollout(NamedTuple):
    """What N robots did in T steps; poses and coverage have the start in front."""

    poses: np.ndarray  # [N, T + 1, 3]
    goals: np.ndarray  # [N, 2]
    covered: np.ndarray  # [N, T + 1, rows, bytes]
    actions: np.ndarray  # [N, T]
    rewards: np.ndarray  # [N, T]
    terminated: np.ndarray  # [N, T]
    truncated: np.ndarray  # [N, T]
    info: dict[str, np.ndarray]  # [N, T] each
    observations: Observation  # [N, T + 1, ...]


def run_robots(params: EnvParams, seed: int, robots: int, num_steps: int = 400) -> Rollout:
    """Let the first half of the robots act at random and the others wander about."""
    keys = jax.random.split(jax.random.key(seed), robots)
    return _run_robots(keys, jnp.arange(robots) >= robots // 2, params, num_steps)


def _run_robots(keys: Array, wanders: Array, params: EnvParams, num_steps: int) -> Rollout:
    run = _episodes(keys, wanders, params, num_steps=num_steps)
    return jax.tree.map(np.asarray, run)


@partial(jax.jit, static_argnames="num_steps")
def _episodes(keys: Array, wanders: Array, params: EnvParams, *, num_steps: int) -> Rollout:
    return jax.vmap(partial(_episode, params=params, num_steps=num_steps))(keys, wanders)


def _episode(key: Array, wanders: Array, *, params: EnvParams, num_steps: int) -> Rollout:
    reset_key, rollout_key = jax.random.split(key)
    obs, state = reset(reset_key, params)

    def one_step(
        carry: tuple[Observation, EnvState, Array], key: Array
    ) -> tuple[tuple[Observation, EnvState, Array], tuple]:
        obs, state, last_action = carry
        wander_key, random_key, step_key = jax.random.split(key, 3)
        action = jnp.where(
            wanders,
            _wander(wander_key, obs, last_action),
            jax.random.randint(random_key, (), 0, 5),
        )
        result = step(step_key, state, action, params)
        return (result[0], result[1], action), (action, *result)

    keys = jax.random.split(rollout_key, num_steps)
    _, (actions, later_obs, states, rewards, terminated, truncated, info) = jax.lax.scan(
        one_step, (obs, state, jnp.int32(0)), keys
    )
    start = jax.tree.map(lambda leaf: leaf[None], (obs, state))
    all_obs, all_states = jax.tree.map(
        lambda first, later: jnp.concatenate([first, later]), start, (later_obs, states)
    )
    return Rollout(
        poses=all_states.pose,
        goals=state.goal,
        covered=all_states.covered,
        actions=actions,
        rewards=rewards,
        terminated=terminated,
        truncated=truncated,
        info=info,
        observations=all_obs,
    )


def _wander(key: Array, obs: Observation, last_action: Array) -> Array:
    """Forward where there is room, else turn on in one direction; one action in ten at random."""
    side_key, random_key, which_key = jax.random.split(key, 3)
    turning = last_action >= TURN_LEFT
    turn = jnp.where(turning, last_action, jax.random.randint(side_key, (), TURN_LEFT, 5))
    action = jnp.where(obs.ranges[33:38].min() * 5.0 < 0.5, turn, 1)
    at_random = jax.random.uniform(random_key) < 0.1
    return jnp.where(at_random, jax.random.randint(which_key, (), 0, 5), action)
