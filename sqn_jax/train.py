"""Training: one compiled program that scans over rounds of rollout and learning.

`train_chunk` is the device program; `run` drives it chunk by chunk and hands numbers to the host
in between. Files, bars and pictures stand outside, in whoever consumes the generator.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax import Array

from sqn_jax.agent import pqn, r2d2, replay
from sqn_jax.agent.experience import Episodes
from sqn_jax.agent.exploration import epsilon_per_robot, epsilon_schedule
from sqn_jax.agent.learner import LearnerState, discount_schedule, init_learner, make_optimizer
from sqn_jax.agent.networks import Params, QNetwork, make_network
from sqn_jax.agent.replay import ReplayState
from sqn_jax.config import TrainConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams
from sqn_jax.rollout import (
    Fleet,
    Trace,
    join_windows,
    restart_at_goal,
    start_fleet,
    summarize,
    unroll,
)


@struct.dataclass
class RunnerState:
    """Everything a run needs to go on; with several seeds, each array has a leading axis [K]."""

    learner: LearnerState
    """Parameters and optimiser."""
    memory: Any
    """Replay of the method `r2d2`; None for `pqn`."""
    key: Array
    """Randomness still to come."""
    round: Array
    """int32: rounds done."""


def network_of(config: TrainConfig) -> QNetwork:
    """The network a config asks for."""
    return make_network(config.algo, config.network, NUM_ACTIONS)


def averages(config: TrainConfig) -> bool:
    """Whether the policy is an average of the parameters over the last updates."""
    return config.method == "pqn" and config.learner.average_share > 0


def policy_params(learner: LearnerState, config: TrainConfig) -> Params:
    """The parameters to evaluate and to ship: the averaged ones where there are any."""
    return learner.target_params if averages(config) else learner.params


def num_windows(config: TrainConfig, env_params: EnvParams) -> int:
    """Windows an episode is driven in: one for `r2d2`.

    Raises:
        ValueError: the window does not divide the episode.
    """
    window = config.learner.window_length if config.method == "pqn" else 0
    if window and env_params.max_steps % window:
        raise ValueError(
            f"learner.window_length is {window}, expected a divisor of the episode's "
            f"{env_params.max_steps} steps"
        )
    return env_params.max_steps // window if window else 1


def updates_a_round(config: TrainConfig, env_params: EnvParams) -> int:
    """Updates of the network in one round."""
    if config.method == "r2d2":
        return config.updates_per_round
    batches = config.num_envs // config.learner.batch_size
    return num_windows(config, env_params) * batches * config.learner.num_passes


def optimizer_of(config: TrainConfig, env_params: EnvParams) -> optax.GradientTransformation:
    """The optimiser a config asks for; its schedule spans the run."""
    total = config.num_rounds * updates_a_round(config, env_params)
    return make_optimizer(config.learner, total)


def episode_shapes(config: TrainConfig, env_params: EnvParams) -> Episodes:
    """Shapes and dtypes of what one unroll hands to the learner, without computing anything."""
    network = network_of(config)
    num_steps = env_params.max_steps // num_windows(config, env_params)

    def one_unroll(key: Array) -> Episodes:
        fleet = start_fleet(key, config.num_envs, network, env_params)
        params = network.init(key, jax.tree.map(lambda x: x[None], fleet.obs), fleet.carry)
        epsilon = jnp.zeros(config.num_envs)
        return unroll(key, network, params, fleet, epsilon, env_params, num_steps=num_steps)[1]

    return jax.eval_shape(one_unroll, jax.random.key(0))


def memory_bytes(config: TrainConfig, env_params: EnvParams) -> int:
    """Bytes that the replay of all seeds and the episodes of a round will take."""
    episodes = episode_shapes(config, env_params)
    total = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(episodes))
    if config.method == "r2d2":
        total += replay.num_bytes(r2d2.packed_item(episodes), config.replay.capacity)
    return config.num_seeds * total


def init_runner(key: Array, env_params: EnvParams, config: TrainConfig) -> RunnerState:
    """The state of one run before its first round; the key is consumed."""
    learner_key, obs_key, run_key = jax.random.split(key, 3)
    network = network_of(config)
    fleet = start_fleet(obs_key, 1, network, env_params)
    learner = init_learner(
        learner_key,
        network,
        optimizer_of(config, env_params),
        jax.tree.map(lambda x: x[None], fleet.obs),
        use_target=config.method == "r2d2" or averages(config),
    )
    memory: ReplayState | None = None
    if config.method == "r2d2":
        item = r2d2.packed_item(episode_shapes(config, env_params))
        memory = replay.init(item, config.replay.capacity)
    return RunnerState(learner=learner, memory=memory, key=run_key, round=jnp.int32(0))


def train_round(
    runner: RunnerState, _: None, *, env_params: EnvParams, config: TrainConfig
) -> tuple[RunnerState, dict[str, Array]]:
    """One whole episode of all robots, with the updates; returns scalars to log."""
    key, fleet_key, window_key = jax.random.split(runner.key, 3)
    windows = num_windows(config, env_params)
    progress = runner.round / config.num_rounds
    epsilon = epsilon_per_robot(progress, config.num_envs, config.exploration)
    fleet = start_fleet(fleet_key, config.num_envs, network_of(config), env_params)
    discount = discount_schedule(progress, config.learner)
    body = partial(
        _drive_and_learn,
        epsilon=epsilon,
        discount=discount,
        env_params=env_params,
        config=config,
    )
    on_first_task = jnp.ones(config.num_envs, bool)
    first = (runner.learner, runner.memory, fleet, on_first_task)
    keys = jax.random.split(window_key, windows)
    (learner, memory, _fleet, _first), (traces, learning) = jax.lax.scan(body, first, keys)
    trace = join_windows(traces)
    summary = summarize(trace, env_params.goal_radius)
    metrics = {
        "mean_reward": summary.mean_reward.mean(),
        "success": summary.success.mean(),
        "time_steps": summary.time_steps.mean(),
        "collisions": summary.collisions.mean(),
        "covered_area": summary.covered_area.mean(),
        "updates": learner.num_updates,
        "skill_usage": trace.skill_weights.mean(axis=(0, 1)),
        "epsilon": epsilon_schedule(progress, config.exploration),
        "discount": jnp.asarray(discount, jnp.float32),
        **jax.tree.map(jnp.mean, learning),
    }
    new_runner = RunnerState(learner=learner, memory=memory, key=key, round=runner.round + 1)
    return new_runner, metrics


def _drive_and_learn(
    carry: tuple[LearnerState, Any, Fleet, Array],
    key: Array,
    *,
    epsilon: Array,
    discount: Array | float,
    env_params: EnvParams,
    config: TrainConfig,
) -> tuple[tuple[LearnerState, Any, Fleet, Array], tuple[Trace, dict[str, Array]]]:
    """One window: drive it, learn from it, and send robots that have arrived to new goals.

    To the learner a new task is a truncation, as the end of every window is one: it has already
    seen the last observation of the old one. Success and time steps are those of first tasks.
    """
    learner, memory, fleet, on_first_task = carry
    unroll_key, learn_key, restart_key = jax.random.split(key, 3)
    network = network_of(config)
    num_steps = env_params.max_steps // num_windows(config, env_params)
    fleet, episodes, trace = unroll(
        unroll_key, network, learner.params, fleet, epsilon, env_params, num_steps=num_steps
    )
    learn = r2d2.learn if config.method == "r2d2" else pqn.learn
    optimizer = optimizer_of(config, env_params)
    learner, memory, metrics = learn(
        learn_key, learner, memory, episodes, network, optimizer, config, discount
    )
    distances = jnp.where(on_first_task[None], trace.goal_distances, jnp.inf)
    trace = dataclasses.replace(trace, goal_distances=distances)
    if config.method == "pqn" and config.learner.restart_at_goal:
        fleet, restarted = restart_at_goal(restart_key, fleet, network, env_params)
        on_first_task &= ~restarted
    return (learner, memory, fleet, on_first_task), (trace, metrics)


def train_chunk(
    runner: RunnerState, env_params: EnvParams, config: TrainConfig
) -> tuple[RunnerState, dict[str, Array]]:
    """Scan over `rounds_per_chunk` rounds; nothing returns to the host in between.

    Args:
        runner: donated; with `num_seeds` > 1 every array has a leading axis [K].
        env_params: the world, shared by all seeds.
        config: static.

    Returns:
        The new state and metrics [rounds] ([K, rounds] for several seeds).
    """

    def scan(one: RunnerState) -> tuple[RunnerState, dict[str, Array]]:
        body = partial(train_round, env_params=env_params, config=config)
        return jax.lax.scan(body, one, None, length=config.rounds_per_chunk)

    return scan(runner) if config.num_seeds == 1 else jax.vmap(scan)(runner)


compiled_train_chunk = jax.jit(train_chunk, static_argnames="config", donate_argnames="runner")


@partial(jax.jit, static_argnames="config")
def start_run(env_params: EnvParams, config: TrainConfig) -> RunnerState:
    """State of a new run: seed `config.seed`, or several with consecutive seeds side by side.

    Run i of several has the same key as a single run with seed `config.seed + i`.
    """
    if config.num_seeds == 1:
        return init_runner(jax.random.key(config.seed), env_params, config)
    keys = jax.vmap(jax.random.key)(config.seed + jnp.arange(config.num_seeds))
    return jax.vmap(lambda key: init_runner(key, env_params, config))(keys)


@dataclass(frozen=True)
class ChunkReport:
    """What one chunk did."""

    chunk: int
    """Chunks done, from 1."""
    metrics: dict[str, Any]
    """Means over the chunk's rounds; a list with one number a seed where there are several."""
    seconds: float
    """Time the chunk ran."""


ChunkProgram = Callable[[RunnerState, EnvParams], tuple[RunnerState, dict[str, Array]]]
"""A compiled `train_chunk`."""


def compile_chunk(
    runner: RunnerState, env_params: EnvParams, config: TrainConfig
) -> tuple[ChunkProgram, float]:
    """Compile `train_chunk` for states like `runner`; returns it and the seconds it took.

    It is compiled from shapes: arrays from a checkpoint are bound to their device, and a program
    made for those is not the one that a new run has compiled and kept.
    """
    started = time.perf_counter()
    shapes = jax.eval_shape(lambda *given: given, runner, env_params)
    program = compiled_train_chunk.lower(*shapes, config).compile()
    return program, time.perf_counter() - started


def run(
    runner: RunnerState,
    env_params: EnvParams,
    config: TrainConfig,
    program: ChunkProgram | None = None,
) -> Iterator[tuple[RunnerState, ChunkReport]]:
    """Train chunk by chunk from any state to the end, yielding after each.

    The yielded state is donated to the next chunk: use it before asking for the next one.
    `program` comes from `compile_chunk`; without one the first chunk waits for it.
    """
    if program is None:
        program, _ = compile_chunk(runner, env_params, config)
    rounds_done = int(np.max(np.asarray(runner.round)))
    for chunk in range(rounds_done // config.rounds_per_chunk + 1, config.num_chunks + 1):
        started = time.perf_counter()
        runner, metrics = program(runner, env_params)
        host_metrics = jax.device_get(metrics)
        seconds = time.perf_counter() - started
        yield runner, ChunkReport(chunk, _average(host_metrics, config), seconds)


def _average(metrics: dict[str, Any], config: TrainConfig) -> dict[str, Any]:
    """Mean over the rounds of a chunk, as plain numbers (lists over seeds, lists over skills).

    Updates are a count: their last value. Before learning has begun there is no loss: NaN.
    """
    axis = 0 if config.num_seeds == 1 else 1
    means = {name: np.mean(value, axis=axis).tolist() for name, value in metrics.items()}
    return means | {"updates": int(np.max(metrics["updates"]))}
