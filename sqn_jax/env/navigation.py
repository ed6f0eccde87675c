"""Mapless navigation as pure functions: `reset`, `reset_to`, `step`.

A robot with range beams and the goal's distance and heading moves through an occupancy grid.

Observation: `Observation(ranges [71], goal [2])`, every number in 0..1.
Action: 0 stand still, 1 forward 2.5 m/s, 2 backward 1.25 m/s, 3 turn left pi rad/s, 4 turn right.
Reward: 2.0 exp(-d) while the goal is reachable + 1.0 x newly covered m2 - 0.2 (paper eq. 7 to 9);
`env.reward_collision`, 0 by default, is the penalty of a collision.
End: never terminated; truncated after `max_steps` steps. Reaching the goal does not end an
episode: a mean reward of 1.35 a step, as the paper reports, is otherwise impossible.

Everything is for one robot; `jax.vmap` makes many. Positions are in meters from the map's lower
left corner, headings in radians from +x toward +y.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.env import coverage, reward
from sqn_jax.env.arguments import (
    require_action,
    require_key,
    require_params,
    require_place,
    require_state,
)
from sqn_jax.env.bumper import is_blocked
from sqn_jax.env.dynamics import move
from sqn_jax.env.geometry import beam_angles, encode_distance, goal_in_robot_frame
from sqn_jax.env.params import EnvParams, EnvState, Observation
from sqn_jax.env.raycast import cast_fan
from sqn_jax.env.scan_margin import thickened

NUM_ACTIONS = 5
STAND, FORWARD, BACKWARD, LEFT, RIGHT = range(5)
ACTION_NAMES = ("stand still", "forward", "backward", "turn left", "turn right")
MOTION_ITERATIONS = 12
"""Free rectangles the path of one step may cross; a longer path counts as blocked."""

Info = dict[str, Array]


def sample_task(key: Array, params: EnvParams) -> tuple[Array, Array]:
    """Draw a start pose [3] and a goal [2] near two different spawn points (section IV-A).

    Of a map that holds several, both lie in the same. A fraction of the tasks, none by default, has
    its goal near one of the closest spawn points.
    """
    keys = jax.random.split(key, 7)
    start_key, goal_key, start_place_key, goal_place_key, heading_key, near_key, which_key = keys
    start_point = _draw_start_point(start_key, params)
    first, group_size = params.spawn_groups[start_point]
    other = jax.random.randint(goal_key, (), 1, group_size)
    neighbors = params.spawn_neighbors[start_point]
    neighbor = neighbors[jax.random.randint(which_key, (), 0, neighbors.shape[0])]
    near = jax.random.uniform(near_key) < params.near_goal_fraction
    anyone = first + (start_point - first + other) % group_size
    goal_point = jnp.where(near, neighbor, anyone)
    start = _place_near(start_place_key, start_point, params)
    heading = jax.random.uniform(heading_key, (), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.append(start, heading), _place_near(goal_place_key, goal_point, params)


def start_point_of(key: Array, params: EnvParams) -> Array:
    """The number of the spawn point near which `reset` of this key starts."""
    task_key, _ = jax.random.split(key)
    return _draw_start_point(jax.random.split(task_key, 7)[0], params)


def _draw_start_point(key: Array, params: EnvParams) -> Array:
    return params.start_points[jax.random.randint(key, (), 0, params.start_points.shape[0])]


def _place_near(key: Array, point: Array, params: EnvParams) -> Array:
    place = jax.random.randint(key, (), 0, params.spawn_counts[point])
    return params.spawn_positions[point, place]


def reset(key: Array, params: EnvParams) -> tuple[Observation, EnvState]:
    """Start an episode at a random task; the key is consumed."""
    require_key(key)
    require_params(params)
    task_key, noise_key = jax.random.split(key)
    pose, goal = sample_task(task_key, params)
    return reset_to(noise_key, pose, goal, params)


def reset_to(
    key: Array, pose: Array, goal: Array, params: EnvParams
) -> tuple[Observation, EnvState]:
    """Start an episode at a given pose [3] and goal [2]; what the first scan sees is no reward."""
    require_key(key)
    require_params(params)
    pose, goal = require_place("pose", pose, 3, params), require_place("goal", goal, 2, params)
    ranges = true_ranges(pose, params)
    covered, _ = _add_scan(coverage.empty(params.lattice), pose, ranges, params)
    state = EnvState(pose=pose, goal=goal, covered=covered, step=jnp.int32(0))
    return observe(key, ranges, state, params), state


def step(
    key: Array, state: EnvState, action: Array, params: EnvParams
) -> tuple[Observation, EnvState, Array, Array, Array, Info]:
    """Advance by one time step.

    Args:
        key: consumed; only used for noise.
        state: where the robot is.
        action: integer in 0..4. Where it is traced (under `jit`, `vmap`, `scan`) it cannot be
            refused: what is above 4 acts as 4, what is negative counts from the end, -1 as 4.
        params: from `make_env`.

    Returns:
        Observation, state, reward, terminated (always False), truncated, and info: `reached`
        (goal within `goal_radius`), `collision` (a move refused since the body touches something),
        `refused` (the same, or a move that the bumper has stopped), `goal_distance` m,
        `covered_area` m2 newly seen, and the unweighted reward terms `reward_navigation`,
        `reward_exploration`, `reward_time`, `reward_collision`.

    Raises:
        ValueError: the action is known and none of 0..4, or an argument is of another kind or
            shape than that of one robot.
    """
    require_key(key)
    require_params(params)
    require_state(state)
    require_action(action, NUM_ACTIONS)
    motion_key, reading_key = jax.random.split(key)
    velocity = params.commands[action]
    if params.config.velocity_noise > 0:
        velocity = velocity + params.velocity_noise * jax.random.normal(motion_key, (2,))
    blocked = _bumper_stops(reading_key, state.pose, params.commands[action], params)
    pose, collision = move(
        state.pose,
        jnp.where(blocked, 0.0, velocity),
        params.body,
        time_step=params.time_step,
        iterations=MOTION_ITERATIONS,
    )
    ranges = true_ranges(pose, params)
    covered, fresh_area = _add_scan(state.covered, pose, ranges, params)
    new_state = EnvState(pose=pose, goal=state.goal, covered=covered, step=state.step + 1)

    distance, heading = goal_in_robot_frame(pose, state.goal)
    reachable = reward.goal_is_reachable(
        distance, heading, ranges, field_of_view=field_of_view(params)
    )
    navigation = reward.navigation_reward(distance, reachable)
    exploration = reward.exploration_reward(fresh_area)
    time = reward.time_reward()
    touch = reward.collision_reward(collision)
    total = reward.total_reward(navigation, exploration, time, touch, params.reward_weights)
    info = {
        "reached": distance < params.goal_radius,
        "collision": collision,
        "refused": collision | blocked,
        "goal_distance": distance,
        "covered_area": fresh_area,
        "reward_navigation": navigation,
        "reward_exploration": exploration,
        "reward_time": jnp.float32(time),
        "reward_collision": touch,
    }
    terminated = jnp.bool_(False)
    truncated = new_state.step >= params.max_steps
    obs = observe(reading_key, ranges, new_state, params)
    return obs, new_state, total, terminated, truncated, info


def observe(key: Array, ranges: Array, state: EnvState, params: EnvParams) -> Observation:
    """Turn true readings [R] m and the goal into what the agent sees.

    With noise and a `scan_margin` if configured.
    """
    config = params.config
    ranges = _with_noise(key, ranges, params)
    if config.scan_margin > 0:
        ranges = thickened(
            jnp.maximum(ranges, 0.0),
            beam_angles(config).astype(np.float32),
            margin=config.scan_margin,
            max_range=config.max_range,
        )
    distance, heading = goal_in_robot_frame(state.pose, state.goal)
    if params.mirrored is not None:
        ranges = jnp.where(params.mirrored, ranges[::-1], ranges)
        heading = jnp.where(params.mirrored, -heading, heading)
    scaled_distance = encode_distance(distance, config)
    if config.heading_encoding == "linear":
        goal = jnp.stack([scaled_distance, (heading + jnp.pi) / (2 * jnp.pi)])
    else:
        sine, cosine = jnp.sin(heading), jnp.cos(heading)
        goal = jnp.stack([scaled_distance, (1 + sine) / 2, (1 + cosine) / 2])
    return Observation(ranges=jnp.clip(ranges / config.max_range, 0.0, 1.0), goal=goal)


def true_ranges(pose: Array, params: EnvParams) -> Array:
    """Noise-free readings [R] of all beams, m, from the rightmost to the leftmost."""
    return cast_fan(
        params.sight,
        pose,
        beam_angles(params.config).astype(np.float32),
        max_range=params.config.max_range,
        iterations=params.config.ray_iterations,
    )


def field_of_view(params: EnvParams) -> float:
    """Angle from the first beam to the last, rad."""
    return math.radians(params.config.field_of_view_deg)


def covered_along(poses: Array, params: EnvParams) -> Array:
    """The points seen so far at each of the poses [T + 1, 3] of an episode, as in `EnvState`."""

    def look(covered: Array, pose: Array) -> tuple[Array, Array]:
        covered, _ = _add_scan(covered, pose, true_ranges(pose, params), params)
        return covered, covered

    _, covered = jax.lax.scan(look, coverage.empty(params.lattice), poses)
    return covered


def _with_noise(key: Array, ranges: Array, params: EnvParams) -> Array:
    config = params.config
    if config.range_noise == 0:
        return ranges
    noise = params.range_noise * jax.random.uniform(key, ranges.shape, minval=-1.0)
    if config.range_noise_unit == "relative":
        return ranges * (1 + noise)
    return ranges + config.max_range * noise


def _bumper_stops(key: Array, pose: Array, command: Array, params: EnvParams) -> Array:
    """Whether the bumper, if there is one, keeps the robot from this move.

    It knows what a robot's would: readings with noise, of a scan of its own, and the command, not
    the move that comes of it.
    """
    config = params.config
    if config.bumper == 0:
        return jnp.bool_(False)
    return is_blocked(
        _with_noise(jax.random.fold_in(key, 1), true_ranges(pose, params), params),
        beam_angles(config).astype(np.float32),
        command[0] * params.time_step,
        radius=config.robot_radius,
        reach=config.robot_radius + config.bumper,
        max_range=config.max_range,
    )


def _add_scan(covered: Array, pose: Array, ranges: Array, params: EnvParams) -> tuple[Array, Array]:
    if params.tile is not None:
        pose = pose.at[:2].set(pose[:2] % jnp.asarray(params.tile, pose.dtype))
    return coverage.add_scan(
        covered, pose, ranges, field_of_view=field_of_view(params), lattice=params.lattice
    )
