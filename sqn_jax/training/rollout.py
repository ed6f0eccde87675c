"""The one place where simulator and agent meet: drive N robots for T steps."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.experience import Episodes
from sqn_jax.agent.exploration import draw_exploration, epsilon_greedy
from sqn_jax.agent.networks import Params, QNetwork, initial_carry
from sqn_jax.agent.shards import own_shard
from sqn_jax.config import RandomizationConfig
from sqn_jax.env import navigation
from sqn_jax.env.params import EnvParams, EnvState, Observation
from sqn_jax.env.randomize import randomized, robot_axes, robots_own


@struct.dataclass
class Trace:
    """What happened along T steps of N robots, beside what the learner needs; time-major."""

    poses: Array
    """[T + 1, N, 3] x m, y m, heading rad; the first is the start."""
    goals: Array
    """[N, 2] m."""
    rewards: Array
    """[T, N]."""
    goal_distances: Array
    """[T, N] line-of-sight distance after each step, m."""
    collisions: Array
    """[T, N] bool: the move was refused."""
    covered_areas: Array
    """[T, N] m2 newly seen in each step."""
    skill_weights: Array
    """[T, N, K] the skill decision of each step."""
    skill_q_values: Array
    """[T, N, K, A] action values of each skill, as the network puts them out."""


@struct.dataclass
class Fleet:
    """N robots on their way: what an unroll starts from and leaves behind."""

    obs: Observation
    """[N, ...] what they see now."""
    state: EnvState
    """[N, ...] where they are."""
    carry: Array
    """[N, H] recurrent state of their network."""


def own_worlds(
    env_params: EnvParams, config: RandomizationConfig, num_envs: int, axis_name: str | None
) -> EnvParams:
    """The worlds of N robots, or of this device's shard of them."""
    worlds = randomized(env_params, config, num_envs)
    own = {name: own_shard(getattr(worlds, name), axis_name) for name in robots_own(worlds)}
    return dataclasses.replace(worlds, **own)


def start_fleet(keys: Array, network: QNetwork, env_params: EnvParams) -> Fleet:
    """Start an episode for each of the keys [N], which are consumed."""
    obs, state = jax.vmap(navigation.reset, in_axes=(0, robot_axes(env_params)))(keys, env_params)
    return Fleet(obs=obs, state=state, carry=initial_carry(network.config, keys.shape[0]))


def restart_at_goal(
    keys: Array, fleet: Fleet, network: QNetwork, env_params: EnvParams
) -> tuple[Fleet, Array]:
    """Give every robot that stands within the goal radius a new task; the keys [N] are consumed.

    Returns:
        The fleet, and which robots [N] have begun anew.
    """
    away = fleet.state.goal - fleet.state.pose[:, :2]
    arrived = jnp.hypot(away[:, 0], away[:, 1]) < env_params.goal_radius
    fresh = start_fleet(keys, network, env_params)

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(jnp.expand_dims(arrived, tuple(range(1, old.ndim))), new, old)

    return jax.tree.map(choose, fresh, fleet), arrived


Chance = tuple[Array, Array, Array]
"""All that is left to chance while N robots drive T steps, [T, N] each: coins and actions for
exploration, and keys for the simulator's noise."""


def draw_chance(key: Array, num_steps: int, num_envs: int) -> Chance:
    """Draw it for a whole unroll at once; the key is consumed."""
    explore_key, noise_key = jax.random.split(key)
    shape = (num_steps, num_envs)
    coins, random_actions = draw_exploration(explore_key, shape, navigation.NUM_ACTIONS)
    return coins, random_actions, noise_keys(noise_key, *shape)


def noise_keys(key: Array, num_steps: int, num_envs: int) -> Array:
    """The keys [T, N] that an unroll hands to the simulator; the key is consumed."""
    return jax.random.split(key, (num_steps, num_envs))


def unroll(
    chance: Chance,
    network: QNetwork,
    params: Params,
    fleet: Fleet,
    epsilon: Array,
    env_params: EnvParams,
) -> tuple[Fleet, Episodes, Trace]:
    """Drive N robots for T steps, without reset.

    Args:
        chance: from `draw_chance`, consumed; lays down T and N.
        network: the agent.
        params: its parameters.
        fleet: the robots.
        epsilon: [N] probabilities of a random action; 0 is greedy.
        env_params: the world, or one for each robot (`env.randomize`).

    Returns:
        The robots afterwards, the steps for the learner, and the trace for statistics and
        pictures.
    """
    advance = partial(
        act_and_step, network=network, params=params, epsilon=epsilon, env_params=env_params
    )
    last, (observations, poses, actions, results, outputs) = jax.lax.scan(advance, fleet, chance)
    reward, terminated, info = results
    episodes = Episodes(
        obs=jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), observations, last.obs),
        actions=actions,
        rewards=reward,
        terminated=terminated,
        carry=fleet.carry,
    )
    trace = Trace(
        poses=jnp.concatenate([poses, last.state.pose[None]]),
        goals=fleet.state.goal,
        rewards=reward,
        goal_distances=info["goal_distance"],
        collisions=info["collision"],
        covered_areas=info["covered_area"],
        skill_weights=outputs.skill_weights,
        skill_q_values=outputs.skill_q_values,
    )
    return last, episodes, trace


def act_and_step(
    fleet: Fleet,
    chance: Chance,
    *,
    network: QNetwork,
    params: Params,
    epsilon: Array,
    env_params: EnvParams,
) -> tuple[Fleet, tuple[Any, ...]]:
    """One step of all robots: Q-values, action, simulator."""
    coins, random_actions, step_keys = chance
    carry, output = network.apply(params, jax.tree.map(lambda x: x[None], fleet.obs), fleet.carry)
    output = jax.tree.map(lambda x: x[0], output)
    action = epsilon_greedy(output.q_values, epsilon, coins, random_actions)
    step = jax.vmap(navigation.step, in_axes=(0, 0, 0, robot_axes(env_params)))
    obs, state, reward, terminated, _, info = step(step_keys, fleet.state, action, env_params)
    emitted = (fleet.obs, fleet.state.pose, action, (reward, terminated, info), output)
    return Fleet(obs=obs, state=state, carry=carry), emitted


def join_windows(traces: Trace) -> Trace:
    """One trace of an episode out of its windows, stacked [W, T / W, N, ...]."""
    moves = dataclasses.replace(traces, poses=traces.poses[:, 1:])
    joined = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), moves)
    poses = jnp.concatenate([traces.poses[0, :1], joined.poses])
    return dataclasses.replace(joined, poses=poses, goals=traces.goals[0])


@struct.dataclass
class EpisodeSummary:
    """One number an episode, [N] each."""

    success: Array
    """bool: the goal radius was ever entered."""
    time_steps: Array
    """int32: the step of the first entry, counted from 1; the episode's length for a failure."""
    mean_reward: Array
    """Mean reward a step."""
    collisions: Array
    """int32: refused moves."""
    covered_area: Array
    """m2 seen beyond the first scan."""
    path_length: Array
    """m driven up to the first entry, or in the whole episode for a failure."""


def summarize(trace: Trace, goal_radius: Array) -> EpisodeSummary:
    """Reduce whole episodes to one number each.

    Success counts from the first step on; a robot that starts within the radius has it at step 1
    at the latest if it stays.
    """
    length = trace.goal_distances.shape[0]
    inside = trace.goal_distances < goal_radius
    success = inside.any(axis=0)
    time_steps = jnp.where(success, jnp.argmax(inside, axis=0) + 1, length).astype(jnp.int32)
    moves = jnp.diff(trace.poses[..., :2], axis=0)
    driven = jnp.hypot(moves[..., 0], moves[..., 1])
    counted = jnp.arange(length)[:, None] < time_steps[None]
    return EpisodeSummary(
        success=success,
        time_steps=time_steps,
        mean_reward=trace.rewards.mean(axis=0),
        collisions=trace.collisions.sum(axis=0, dtype=jnp.int32),
        covered_area=trace.covered_areas.sum(axis=0),
        path_length=jnp.where(counted, driven, 0.0).sum(axis=0),
    )
