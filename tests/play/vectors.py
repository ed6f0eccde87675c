"""Episodes of the program itself, for its twin in JavaScript to be compared with."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sqn_jax.agent.networks import initial_carry
from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env, reset_to, step
from sqn_jax.maps import OccupancyMap
from sqn_jax.play.map_data import map_data
from sqn_jax.play.policy_data import policy_data
from sqn_jax.policies.greedy import step_network
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.motion import first_observation, next_observation
from sqn_jax.training.state import network_of

EXACT: dict[str, Any] = {"ray_iterations": 32}
"""So many hops that no ray is cut short, as the few in a thousand that need more than 8 are."""

KEY = jax.random.key(0)
"""Nothing is drawn with it: there is no noise."""


@cache
def world_of(occupancy_map: OccupancyMap, config: EnvConfig) -> EnvParams:
    """The world of a policy's settings, tasks at the map's evaluation points."""
    config = dataclasses.replace(config, near_goal_fraction=0.0, **EXACT)
    return make_env(occupancy_map, config, spawn="evaluation")


def rounded(policy: Policy) -> Policy:
    """The policy with the weights that the page has."""
    halves = jax.tree.map(lambda x: x.astype(jnp.float16).astype(jnp.float32), policy.params)
    return dataclasses.replace(policy, params=halves)


def episode(
    policy: Policy, world: EnvParams, seed: int, num_steps: int, *, at_random: bool = False
) -> dict[str, Any]:
    """What a policy does from one evaluation point to another, step by step, as lists.

    Args:
        policy: acts greedily.
        world: from `world_of`.
        seed: draws the points and the heading.
        num_steps: T.
        at_random: actions are drawn, and the policy looks on.

    Returns:
        `pose` and `goal` of the task; `poses` and `ranges` after each step and before the first,
        T + 1 of each; `q_values`, `skill_weights`, `actions`, `rewards` (navigation, exploration
        and time without their weights, and the sum with them), `collisions` and `reached`, T of
        each; `covered`, the points seen in the end.
    """
    rng, max_range = np.random.default_rng(seed), np.float32(world.config.max_range)
    start, goal = rng.choice(np.asarray(world.spawn_positions)[:, 0], 2, replace=False)
    pose = np.append(start, rng.uniform(-np.pi, np.pi)).astype(np.float32)
    network = network_of(policy.config)
    obs, state = _reset(KEY, pose, goal, world)
    seen, carry = (
        first_observation(obs, policy.config.network),
        initial_carry(policy.config.network, 1)[0],
    )
    lists: dict[str, list[Any]] = {name: [] for name in _LISTS}
    lists["poses"].append(np.asarray(state.pose))
    lists["ranges"].append(np.asarray(obs.ranges) * max_range)
    for _ in range(num_steps):
        carry, output = step_network(policy.params[0], seen, carry, network)
        action = rng.integers(5) if at_random else np.asarray(output.q_values).argmax()
        obs, state, reward, _, _, info = _step(KEY, state, np.int32(action), world)
        seen = next_observation(seen, obs, action, info["refused"])
        terms = [info[f"reward_{name}"] for name in ("navigation", "exploration", "time")]
        taken = {
            "poses": state.pose,
            "ranges": np.asarray(obs.ranges) * max_range,
            "q_values": output.q_values,
            "skill_weights": output.skill_weights,
            "actions": action,
            "rewards": [*map(np.asarray, terms), np.asarray(reward)],
            "collisions": info["collision"],
            "reached": info["reached"],
        }
        for name, value in taken.items():
            # At once: a list of arrays on the device is copied number by number.
            lists[name].append(np.asarray(value))
    as_lists = {name: np.array(values).tolist() for name, values in lists.items()}
    points = covered_points(np.asarray(state.covered), world)
    task = {"pose": pose.tolist(), "goal": goal.tolist(), "at_random": at_random}
    return {**task, "covered": points, **as_lists}


_LISTS = (
    *("poses", "ranges", "q_values", "skill_weights", "actions", "rewards", "collisions"),
    "reached",
)


@jax.jit
def _reset(key: Any, pose: Any, goal: Any, world: EnvParams) -> Any:
    return reset_to(key, pose, goal, world)


@jax.jit
def _step(key: Any, state: Any, action: Any, world: EnvParams) -> Any:
    return step(key, state, action, world)


def covered_points(covered: NDArray[np.uint32], world: EnvParams) -> list[list[int]]:
    """Columns and rows of the lattice's points that were seen, counted from the map's corner."""
    bits = (covered[..., None] >> np.arange(32, dtype=np.uint32)) & 1
    bitmask, group, group_row, bit = np.nonzero(bits)
    lattice = world.lattice
    columns = bitmask * 32 + bit - lattice.origin[0]
    rows = group * lattice.group_rows + group_row - lattice.origin[1]
    return np.stack([columns, rows], axis=1).tolist()


def vectors(
    policies: list[Policy],
    maps: list[OccupancyMap],
    tasks: list[tuple[int, int, int, bool]],
    num_steps: int,
) -> dict[str, Any]:
    """Policies and maps as the page has them, and an episode of each task.

    Args:
        policies: with one training seed.
        maps: of one shape, so that one program serves all.
        tasks: which policy, which map, a seed, and whether actions are drawn at random.
        num_steps: of an episode.
    """
    halved = [rounded(policy) for policy in policies]
    episodes = [
        {"policy": policy, "map": place}
        | episode(
            halved[policy],
            world_of(maps[place], policies[policy].config.env),
            seed,
            num_steps,
            at_random=at_random,
        )
        for policy, place, seed, at_random in tasks
    ]
    return {
        "policies": [policy_data(policy) for policy in policies],
        "maps": [map_data(occupancy_map) for occupancy_map in maps],
        "episodes": episodes,
    }
