"""A rollout that exported files are compared with."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.agent.networks import Params, QNetwork
from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, EnvState, Observation, make_env, reset, step
from sqn_jax.env.geometry import decode_goal
from sqn_jax.policies.greedy import GreedyPolicy, step_policy
from sqn_jax.training.state import network_of

NUM_STEPS = 400
SEED = 1_000


def reference_rollout(policy: GreedyPolicy, map_name: str) -> dict[str, NDArray[Any]]:
    """Let a policy act for 400 steps in the simulator, without noise.

    Args:
        policy: which.
        map_name: where.

    Returns:
        `observations` [T, R + 2] in SI units, infinite where a beam hits nothing, and with
        `network.motion_inputs` a column more, whether the step before was refused; `hidden`
        [T + 1, N] before each step and after the last; `q_values` [T, A]; `skill_weights` [T, K];
        `actions` [T].

    Raises:
        ValueError: the map is unusable for this robot.
    """
    env = dataclasses.replace(
        policy.config.env, velocity_noise=0.0, range_noise=0.0, near_goal_fraction=0.0
    )
    world = make_env(map_name, env, spawn="evaluation")
    key, reset_key = jax.random.split(jax.random.key(SEED))
    obs, state = reset(reset_key, world)
    observed, refused, carries, q_values, skill_weights = jax.device_get(
        _roll(
            jax.random.split(key, NUM_STEPS),
            (obs, state, np.bool_(False), policy.start()),
            world,
            policy.params,
            network_of(policy.config),
        )
    )
    observations = in_si_units(observed, env)
    if policy.config.network.motion_inputs:
        observations = np.column_stack([observations, refused.astype(np.float32)])
    return {
        "observations": observations,
        "hidden": np.concatenate([np.asarray(policy.start())[None], carries]),
        "q_values": q_values,
        "skill_weights": skill_weights,
        "actions": q_values.argmax(axis=1),
    }


def in_si_units(obs: Observation, env: EnvConfig) -> NDArray[np.float32]:
    """What a robot's sensors give where the network sees `obs` [T, ...]: [T, R + 2] m, m, rad."""
    ranges, goal = np.asarray(obs.ranges, np.float64), np.asarray(obs.goal, np.float64)
    readings = np.where(ranges < 1, ranges * env.max_range, np.inf)
    distance, heading = decode_goal(goal, env)
    return np.column_stack([readings, distance, heading]).astype(np.float32)


@partial(jax.jit, static_argnames="network")
def _roll(
    keys: Array,
    start: tuple[Observation, EnvState, Any, Array],
    world: EnvParams,
    params: Params,
    network: QNetwork,
) -> tuple[Observation, Array, Array, Array, Array]:
    """Observations, whether the steps before them were refused, carries after each step, Q-values
    and skill weights, [T, ...] each."""

    def advance(before: Any, key: Array) -> Any:
        obs, state, refused, carry = before
        carry, output = step_policy(params, obs, carry, refused, network)
        new_obs, state, *_, info = step(key, state, output.q_values.argmax(), world)
        seen = obs, refused, carry, output.q_values, output.skill_weights
        return (new_obs, state, info["refused"], carry), seen

    rollout: tuple[Observation, Array, Array, Array, Array] = jax.lax.scan(advance, start, keys)[1]
    return rollout
