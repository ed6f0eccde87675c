"""The one place where simulator and agent meet: let N robots act for T steps."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.exploration import draw_exploration, epsilon_greedy
from sqn_jax.agent.networks import Params, QNetwork, initial_carry
from sqn_jax.agent.shards import own_shard
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.config import RandomizationConfig
from sqn_jax.env import navigation
from sqn_jax.env.params import EnvParams, EnvState, Observation
from sqn_jax.env.randomize import randomized, robot_axes, robots_own
from sqn_jax.training.motion import first_observation, next_observation


@struct.dataclass
class ActorState:
    """N robots within their episodes: what an unroll starts from and leaves behind."""

    obs: Observation
    """[N, ...] what they see now; with `network.motion_inputs` a `MotionObservation`."""
    env_state: EnvState
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


def start_actors(keys: Array, env_params: EnvParams, network: QNetwork) -> ActorState:
    """Start an episode for each of the keys [N], which are consumed."""
    return before_first_action(*reset_robots(keys, env_params), network)


def before_first_action(obs: Observation, env_state: EnvState, network: QNetwork) -> ActorState:
    """N robots at the start of their tasks, by what the env shows [N, ...]: nothing lies behind."""
    carry = initial_carry(network.config, obs.goal.shape[0])
    return ActorState(first_observation(obs, network.config), env_state, carry)


def reset_robots(keys: Array, env_params: EnvParams) -> tuple[Observation, EnvState]:
    """First observations and states [N, ...] of the episodes of keys [N], which are consumed."""
    return jax.vmap(navigation.reset, in_axes=(0, robot_axes(env_params)))(keys, env_params)


def restart_at_goal(
    keys: Array, actors: ActorState, env_params: EnvParams, network: QNetwork
) -> tuple[ActorState, Array]:
    """Give every robot that stands within the goal radius a new task; the keys [N] are consumed.

    Returns:
        The robots, and which of them [N] have begun anew.
    """
    away = actors.env_state.goal - actors.env_state.pose[:, :2]
    arrived = jnp.hypot(away[:, 0], away[:, 1]) < env_params.goal_radius
    fresh = start_actors(keys, env_params, network)

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(jnp.expand_dims(arrived, tuple(range(1, old.ndim))), new, old)

    return jax.tree.map(choose, fresh, actors), arrived


class RandomDraws(NamedTuple):
    """All randomness of an unroll, [T, N] each."""

    uniform: Array
    """0..1, decides whether to explore."""
    actions: Array
    """int32, taken where a robot explores."""
    step_keys: Array
    """Keys for the simulator's noise."""


def random_draws(key: Array, num_steps: int, num_envs: int) -> RandomDraws:
    """Draw the randomness of a whole unroll at once; the key is consumed."""
    explore_key, noise_key = jax.random.split(key)
    shape = (num_steps, num_envs)
    uniform, actions = draw_exploration(explore_key, shape, navigation.NUM_ACTIONS)
    return RandomDraws(uniform, actions, jax.random.split(noise_key, shape))


def unroll(
    draws: RandomDraws,
    params: Params,
    actors: ActorState,
    epsilon: Array,
    env_params: EnvParams,
    network: QNetwork,
) -> tuple[ActorState, Trajectory]:
    """Let N robots act for T steps, without reset.

    Args:
        draws: from `random_draws`, consumed; lays down T and N.
        params: parameters of the network.
        actors: the robots.
        epsilon: [N] probabilities of a random action; 0 is greedy.
        env_params: the world, or one for each robot (`env.randomize`).
        network: the agent.

    Returns:
        The robots afterward, and all that happened but for `covered`. In a compiled program what
        nobody uses of it costs nothing.
    """
    body = partial(_act_and_step, params=params, epsilon=epsilon, env_params=env_params)
    last, steps = jax.lax.scan(partial(body, network=network), actors, draws)
    return last, with_ends(steps, actors, last)


def _act_and_step(
    actors: ActorState,
    draws: RandomDraws,
    *,
    params: Params,
    epsilon: Array,
    env_params: EnvParams,
    network: QNetwork,
) -> tuple[ActorState, Trajectory]:
    """One step of all robots: action values, action, simulator."""
    obs = jax.tree.map(lambda x: x[None], actors.obs)
    carry, output = network.apply(params, obs, actors.carry)
    output = jax.tree.map(lambda x: x[0], output)
    actions = epsilon_greedy(output.q_values, epsilon, draws.uniform, draws.actions)
    actors, step = step_actors(draws.step_keys, actors, actions, env_params)
    return dataclasses.replace(actors, carry=carry), dataclasses.replace(step, output=output)


def step_actors(
    step_keys: Array, actors: ActorState, actions: Array, env_params: EnvParams
) -> tuple[ActorState, Trajectory]:
    """Advance N robots by actions [N], whoever chose them; the keys [N] are consumed.

    Returns:
        The robots, their carry as it was, and the step: a trajectory without the axis of time, of
        which `with_ends` makes a whole one.
    """
    step = jax.vmap(navigation.step, in_axes=(0, 0, 0, robot_axes(env_params)))
    obs, env_state, rewards, terminated, _, info = step(
        step_keys, actors.env_state, actions, env_params
    )
    taken = Trajectory(
        obs=actors.obs,
        actions=actions,
        rewards=rewards,
        terminated=terminated,
        poses=actors.env_state.pose,
        info=info,
    )
    obs = next_observation(actors.obs, obs, actions, info["refused"])
    return dataclasses.replace(actors, obs=obs, env_state=env_state), taken


def with_ends(steps: Trajectory, first: ActorState, last: ActorState) -> Trajectory:
    """Steps from `step_actors`, stacked, with what was before the first and after the last.

    Args:
        steps: [T, N, ...]; `obs` may be left out.
        first: the robots before them.
        last: the robots after them.
    """

    def append(array: Array, end: Array) -> Array:
        return jnp.concatenate([array, end[None]])

    return dataclasses.replace(
        steps,
        obs=None if steps.obs is None else jax.tree.map(append, steps.obs, last.obs),
        poses=append(steps.poses, last.env_state.pose),
        carry=first.carry,
        goals=first.env_state.goal,
    )


def join_windows(windows: Trajectory) -> Trajectory:
    """What `episode_metrics` needs of an episode out of its windows, stacked [W, T / W, N, ...]."""
    moves = dataclasses.replace(
        windows.only("rewards", "info", "output"), poses=windows.poses[:, 1:]
    )
    joined = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), moves)
    poses = jnp.concatenate([windows.poses[0, :1], joined.poses])
    return dataclasses.replace(joined, poses=poses, goals=windows.goals[0])


@struct.dataclass
class EpisodeMetrics:
    """One number an episode, [N] each."""

    success: Array
    """bool: the goal radius was ever entered."""
    time_steps: Array
    """int32: the step of the first entry, counted from 1; the episode's length for a failure."""
    mean_reward: Array
    """Mean reward a step."""
    collisions: Array
    """int32: moves refused since the body would touch something, not those a bumper stopped."""
    covered_area: Array
    """m2 seen beyond the first scan."""
    path_length: Array
    """m traveled up to the first entry, or in the whole episode for a failure."""


def episode_metrics(
    trajectory: Trajectory,
    goal_radius: Array,
    max_steps: Array | None = None,
    collision_ends: Array | None = None,
) -> EpisodeMetrics:
    """Reduce whole episodes to one number each.

    Success counts from the first step on; a robot that starts within the radius has it at step 1
    at the latest if it stays.

    Args:
        trajectory: with `rewards`, `poses` and `info`.
        goal_radius: m, one number or [N].
        max_steps: [N] steps of each episode, at most T; None: T.
        collision_ends: bool, whether nothing counts after the first collision; None: no.
    """
    info = trajectory.info
    length, num_robots = trajectory.rewards.shape
    is_cut = max_steps is not None
    limit = jnp.full(num_robots, length) if max_steps is None else max_steps
    end = limit
    if collision_ends is not None:
        first_collision = jnp.argmax(info["collision"], axis=0) + 1
        ended = collision_ends & info["collision"].any(axis=0)
        end = jnp.where(ended, jnp.minimum(limit, first_collision), limit)
    steps = jnp.arange(length)[:, None]
    within = steps < end[None]
    radii = jnp.broadcast_to(goal_radius, num_robots)[None]
    inside = (info["goal_distance"] < radii) & within
    success = inside.any(axis=0)
    time_steps = jnp.where(success, jnp.argmax(inside, axis=0) + 1, limit).astype(jnp.int32)
    moves = jnp.diff(trajectory.poses[..., :2], axis=0)
    traveled = jnp.hypot(moves[..., 0], moves[..., 1])
    counted = within & (steps < time_steps[None])
    return EpisodeMetrics(
        success=success,
        time_steps=time_steps,
        mean_reward=jnp.mean(trajectory.rewards, axis=0, where=within if is_cut else None),
        collisions=(info["collision"] & within).sum(axis=0, dtype=jnp.int32),
        covered_area=jnp.where(within, info["covered_area"], 0.0).sum(axis=0),
        path_length=jnp.where(counted, traveled, 0.0).sum(axis=0),
    )
