"""Greedy episodes of a trained policy, without exploration and without auto-reset."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.agent.networks import Params, make_network
from sqn_jax.config import Algorithm, NetworkConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams
from sqn_jax.rollout import EpisodeSummary, Trace, start_fleet, summarize, unroll
from sqn_jax.statistics import bootstrap_interval, wilson_interval


@partial(jax.jit, static_argnames=("algo", "network_config", "num_episodes"))
def run_episodes(
    key: Array,
    params: Params,
    env_params: EnvParams,
    *,
    algo: Algorithm,
    network_config: NetworkConfig,
    num_episodes: int,
) -> tuple[EpisodeSummary, Trace]:
    """Drive greedy episodes of one policy.

    Starts, goals and noise come from the key alone: every policy that is given the same key and
    the same world meets the same tasks.

    Args:
        key: consumed; independent of any training key.
        params: parameters of one network, without a seed axis.
        env_params: the world, with the noise it was made with.
        algo: which network the parameters belong to.
        network_config: its sizes.
        num_episodes: E.

    Returns:
        One number an episode [E], and the traces of all of them.
    """
    start_key, unroll_key = jax.random.split(key)
    network = make_network(algo, network_config, NUM_ACTIONS)
    fleet = start_fleet(start_key, num_episodes, network, env_params)
    _, _, trace = unroll(
        unroll_key,
        network,
        params,
        fleet,
        jnp.zeros(num_episodes),
        env_params,
        num_steps=env_params.max_steps,
    )
    return summarize(trace, env_params.goal_radius), trace


def select_seed(params: Params, index: int) -> Params:
    """Parameters of one of several vmapped seeds."""
    return jax.tree.map(lambda x: x[index], params)


def aggregate(summaries: list[EpisodeSummary]) -> dict[str, Any]:
    """Statistics over the episodes of one or more training seeds, ready for JSON.

    Args:
        summaries: one for each training seed, as NumPy or JAX arrays [E].

    Returns:
        `success`, `time_steps` (failures at the limit), `time_steps_success` (None without a
        success), `mean_reward`, `collisions`, `coverage_m2`: each `mean`, `std` over episodes and
        a 95 % interval `ci95` over episodes (Wilson for `success`, bootstrap for the others); and
        `success_per_seed`.
    """
    joined = {
        name: np.concatenate([np.asarray(getattr(summary, name)) for summary in summaries])
        for name in ("success", "time_steps", "mean_reward", "collisions", "covered_area")
    }
    success = joined["success"]
    steps = joined["time_steps"]
    return {
        "success": {
            "mean": float(success.mean()),
            "std": float(success.std()),
            "ci95": list(wilson_interval(int(success.sum()), success.size)),
        },
        "time_steps": _describe(steps),
        "time_steps_success": _describe(steps[success]) if success.any() else None,
        "mean_reward": _describe(joined["mean_reward"]),
        "collisions": _describe(joined["collisions"]),
        "coverage_m2": _describe(joined["covered_area"]),
        "success_per_seed": [float(np.mean(np.asarray(s.success))) for s in summaries],
    }


def _describe(values: np.ndarray) -> dict[str, Any]:
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "ci95": list(bootstrap_interval(values)),
    }
