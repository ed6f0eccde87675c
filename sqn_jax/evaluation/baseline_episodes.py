"""Episodes of navigators that are no networks: the oracle and the wall follower.

Both meet the starts, goals and noise that `episodes.run_episodes` gives to a network for the same
key.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from sqn_jax.baselines.bug import BugNavigator
from sqn_jax.baselines.oracle import Oracle
from sqn_jax.env import NUM_ACTIONS, EnvParams, EnvState, Observation
from sqn_jax.evaluation.episodes import episode_keys, start_by_hand, step_by_hand
from sqn_jax.maps import OccupancyMap
from sqn_jax.training.rollout import EpisodeSummary, Trace, summarize

Ints = NDArray[np.int64]
Choose = Callable[[Observation, EnvState], Ints]


def run_oracle(
    key: Array, occupancy_map: OccupancyMap, env_params: EnvParams, num_episodes: int
) -> tuple[EpisodeSummary, Trace]:
    """Drive episodes with the navigator that knows the map.

    Args:
        key: the key of `episodes.episode_keys`: the same one gives the same tasks and noise.
        occupancy_map: the map `env_params` was made from.
        env_params: the world.
        num_episodes: E.

    Returns:
        One number an episode [E], and the traces; skill arrays have width 1 and say nothing.

    Raises:
        ValueError: the map is not the one of `env_params`, or the robot cannot drive or turn.
    """
    oracle: Oracle | None = None

    def choose(_: Observation, state: EnvState) -> Ints:
        nonlocal oracle
        poses, goals = np.asarray(state.pose, np.float64), np.asarray(state.goal, np.float64)
        if oracle is None:
            oracle = Oracle(occupancy_map, env_params, goals)
        return oracle.choose(poses)

    return drive(episode_keys(key, num_episodes), env_params, choose)


def run_bug(key: Array, env_params: EnvParams, num_episodes: int) -> tuple[EpisodeSummary, Trace]:
    """Drive episodes with the wall follower, which sees the observation and nothing else.

    Args:
        key, env_params, num_episodes: see `run_oracle`.

    Returns:
        One number an episode [E], and the traces.
    """
    bug = BugNavigator(env_params.config, num_episodes)

    def choose(obs: Observation, _: EnvState) -> Ints:
        return bug.choose(np.asarray(obs.ranges, np.float64), np.asarray(obs.goal, np.float64))

    return drive(episode_keys(key, num_episodes), env_params, choose)


def drive(keys: Array, env_params: EnvParams, choose: Choose) -> tuple[EpisodeSummary, Trace]:
    """Drive whole episodes with actions chosen on the host.

    Args:
        keys: [E], from `episode_keys`.
        env_params: the world.
        choose: actions [E] from the observations and states of all robots; called once a step.

    Returns:
        One number an episode [E], and the traces, as NumPy arrays.
    """
    step_keys, obs, state = start_by_hand(keys, env_params)
    poses, goals = [np.asarray(state.pose)], np.asarray(state.goal)
    steps: list[Any] = []
    for step_key in step_keys:
        actions = jnp.asarray(choose(obs, state), jnp.int32)
        obs, state, reward, _, _, info = step_by_hand(step_key, state, actions, env_params)
        names = ("goal_distance", "collision", "covered_area")
        steps.append(jax.device_get((reward, *(info[name] for name in names))))
        poses.append(np.asarray(state.pose))
    rewards, distances, collisions, areas = (np.stack(parts) for parts in zip(*steps, strict=True))
    recorded: dict[str, Any] = {
        "poses": np.stack(poses),
        "goals": goals,
        "rewards": rewards,
        "goal_distances": distances,
        "collisions": collisions,
        "covered_areas": areas,
        "skill_weights": np.ones((*rewards.shape, 1), np.float32),
        "skill_q_values": np.zeros((*rewards.shape, 1, NUM_ACTIONS), np.float32),
    }
    trace = Trace(**recorded)
    return jax.device_get(summarize(trace, env_params.goal_radius)), trace
