"""The one place where simulator and agent meet: drive N robots for T steps."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.exploration import epsilon_greedy
from sqn_jax.agent.experience import Episodes
from sqn_jax.agent.networks import Params, QNetwork, initial_carry
from sqn_jax.env import navigation
from sqn_jax.env.params import EnvParams, EnvState, Observation


@struct.dataclass
class Trace:
    """What happened along T steps of N robots, beside what the learner needs; time-major."""

    poses: Array
    """[T + 1, N, 3] x m, y m, heading rad; the first is the start."""
    goals: Array
    """[N, 2] m."""
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


def reset_all(key: Array, num_envs: int, env_params: EnvParams) -> tuple[Observation, EnvState]:
    """Start N independent episodes; the key is consumed."""
    keys = jax.random.split(key, num_envs)
    return jax.vmap(navigation.reset, in_axes=(0, None))(keys, env_params)


def unroll(
    key: Array,
    network: QNetwork,
    params: Params,
    start: tuple[Observation, EnvState],
    epsilon: Array,
    env_params: EnvParams,
) -> tuple[Episodes, Trace]:
    """Drive N robots from their starts for a whole episode, without reset.

    Args:
        key: consumed.
        network: the agent.
        params: its parameters.
        start: first observation and state of each robot, [N, ...].
        epsilon: [N] probabilities of a random action; 0 is greedy.
        env_params: the world.

    Returns:
        The episodes for the learner, and the trace for statistics and pictures.
    """
    obs, state = start
    num_envs = state.step.shape[0]
    keys = jax.random.split(key, env_params.max_steps)
    act_and_step = partial(
        _act_and_step, network=network, params=params, epsilon=epsilon, env_params=env_params
    )
    first = (obs, state, initial_carry(network.config, num_envs))
    (last_obs, last_state, _), (observations, poses, actions, results, outputs) = jax.lax.scan(
        act_and_step, first, keys
    )
    reward, terminated, info = results
    episodes = Episodes(
        obs=jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), observations, last_obs),
        actions=actions,
        rewards=reward,
        terminated=terminated,
    )
    trace = Trace(
        poses=jnp.concatenate([poses, last_state.pose[None]]),
        goals=state.goal,
        goal_distances=info["goal_distance"],
        collisions=info["collision"],
        covered_areas=info["covered_area"],
        skill_weights=outputs.skill_weights,
        skill_q_values=outputs.skill_q_values,
    )
    return episodes, trace


def _act_and_step(carry, key, *, network, params, epsilon, env_params):  # type: ignore[no-untyped-def]
    """One step of all robots: Q-values, action, simulator."""
    obs, state, hidden = carry
    action_key, step_key = jax.random.split(key)
    hidden, output = network.apply(params, jax.tree.map(lambda x: x[None], obs), hidden)
    output = jax.tree.map(lambda x: x[0], output)
    action = epsilon_greedy(action_key, output.q_values, epsilon)
    step_keys = jax.random.split(step_key, action.shape[0])
    step = jax.vmap(navigation.step, in_axes=(0, 0, 0, None))
    new_obs, new_state, reward, terminated, _, info = step(step_keys, state, action, env_params)
    emitted = (obs, state.pose, action, (reward, terminated, info), output)
    return (new_obs, new_state, hidden), emitted


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


def summarize(episodes: Episodes, trace: Trace, goal_radius: Array) -> EpisodeSummary:
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
        mean_reward=episodes.rewards.mean(axis=0),
        collisions=trace.collisions.sum(axis=0, dtype=jnp.int32),
        covered_area=trace.covered_areas.sum(axis=0),
        path_length=jnp.where(counted, driven, 0.0).sum(axis=0),
    )
