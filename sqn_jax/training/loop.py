"""Training: one compiled program that scans over rounds of rollout and learning.

`train_chunk` is the device program; `run` calls it chunk by chunk and hands numbers to the host
in between. Files, bars and pictures stand outside, in whoever consumes the generator.

With a mesh of several devices (`devices.choose`) each of them has some of the seeds; those that
have the same seeds step and learn from a shard of the robots each. Random numbers are drawn for all
robots alike on each, so that no robot's fate depends on the number of devices.
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
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from sqn_jax.agent import pqn, r2d2
from sqn_jax.agent.exploration import epsilon_per_robot, epsilon_schedule
from sqn_jax.agent.learner import LearnerState, current_discount, progress
from sqn_jax.agent.program import Program
from sqn_jax.agent.shards import all_shards, mean, own_shard
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.config import TrainConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams
from sqn_jax.training.curriculum import by_learnability, with_outcomes
from sqn_jax.training.devices import own_part, place, placed_shapes
from sqn_jax.training.exported import exported_jit
from sqn_jax.training.rollout import (
    ActorState,
    EpisodeMetrics,
    episode_metrics,
    join_windows,
    own_worlds,
    random_draws,
    restart_at_goal,
    start_actors,
    unroll,
)
from sqn_jax.training.state import RunnerState, init_runner, runner_specs

Metrics = dict[str, Array]
"""Scalars to log, and the mean weight of each skill [K]."""

Carry = tuple[LearnerState, ActorState, Array]
"""What goes from window to window: the learner, the robots, and which of them [N] have had a new
task in this round."""

LEARN = {"r2d2": r2d2.learn, "pqn": pqn.learn}


def make_program(env_params: EnvParams, config: TrainConfig, mesh: Mesh | None = None) -> Program:
    """What a run in this world keeps to; with a mesh, its robots are divided between devices.

    Raises:
        ValueError: the window does not divide the episode.
    """
    return Program(config, env_params.max_steps, NUM_ACTIONS, mesh)


def train_round(
    runner: RunnerState, env_params: EnvParams, program: Program
) -> tuple[RunnerState, Metrics]:
    """One whole episode of all robots, with the updates; returns scalars to log.

    On several devices, of this device's shard of the robots; the scalars are those of all.
    """
    config, axis_name = program.config, program.axis_name
    key, start_key, window_key = jax.random.split(runner.key, 3)
    done = progress(runner.learner, program)
    epsilon = epsilon_per_robot(done, config.num_envs, config.exploration)
    epsilon = own_shard(epsilon, axis_name)
    env_params = by_learnability(env_params, runner.map_success)
    env_params = own_worlds(env_params, config.randomization, config.num_envs, axis_name)
    start_keys = own_shard(jax.random.split(start_key, config.num_envs), axis_name)
    actors = start_actors(start_keys, env_params, program.network)
    has_restarted = jnp.zeros(epsilon.shape, bool)

    def one_window(carry: Carry, key: Array) -> tuple[Carry, tuple[Trajectory, Metrics]]:
        return rollout_and_learn(key, carry, epsilon, env_params, program)

    window_keys = jax.random.split(window_key, program.num_windows)
    (learner, *_), (windows, learning) = jax.lax.scan(
        one_window, (runner.learner, actors, has_restarted), window_keys
    )
    trajectory = join_windows(windows)
    episodes = episode_metrics(trajectory, env_params.goal_radius)
    metrics = mean(_rollout_metrics(episodes, trajectory), axis_name) | {
        "updates": learner.num_updates,
        "skipped_updates": learner.num_skipped,
        "finite": _is_finite(learner),
        "epsilon": epsilon_schedule(done, config.exploration),
        "discount": jnp.asarray(current_discount(runner.learner, program), jnp.float32),
        **jax.tree.map(jnp.mean, learning),
    }
    learner = dataclasses.replace(learner, round=learner.round + 1)
    map_success = with_outcomes(
        runner.map_success, start_keys, episodes.success, env_params, axis_name
    )
    return RunnerState(learner, key, map_success), metrics


def rollout_and_learn(
    key: Array, carry: Carry, epsilon: Array, env_params: EnvParams, program: Program
) -> tuple[Carry, tuple[Trajectory, Metrics]]:
    """One window: roll it out, learn from it, and send robots that have arrived to new goals.

    To the learner a new task is a truncation, as the end of every window is one: it has already
    seen the last observation of the old one. Success and time steps are those of first tasks.
    """
    learner, actors, has_restarted = carry
    config, axis_name = program.config, program.axis_name
    unroll_key, learn_key, restart_key = jax.random.split(key, 3)
    draws = random_draws(unroll_key, program.window_length, config.num_envs)
    draws = own_shard(draws, axis_name, axis=1)
    actors, trajectory = unroll(draws, learner.params, actors, epsilon, env_params, program.network)
    learner, metrics = LEARN[config.method](learn_key, learner, trajectory, program)
    distances = jnp.where(has_restarted[None], jnp.inf, trajectory.info["goal_distance"])
    trajectory = dataclasses.replace(
        trajectory.only("rewards", "poses", "goals", "output"),
        info=trajectory.info | {"goal_distance": distances},
    )
    if config.method == "pqn" and config.learner.restart_at_goal:
        restart_keys = own_shard(jax.random.split(restart_key, config.num_envs), axis_name)
        actors, restarted = restart_at_goal(restart_keys, actors, env_params, program.network)
        has_restarted |= restarted
    return (learner, actors, has_restarted), (trajectory, metrics)


def _rollout_metrics(episodes: EpisodeMetrics, trajectory: Trajectory) -> Metrics:
    """Means over the robots of an episode."""
    return {
        "mean_reward": episodes.mean_reward.mean(),
        "success": episodes.success.mean(),
        "time_steps": episodes.time_steps.mean(),
        "collisions": episodes.collisions.mean(),
        "covered_area": episodes.covered_area.mean(),
        "skill_usage": trajectory.output.skill_weights.mean(axis=(0, 1)),
    }


def _is_finite(learner: LearnerState) -> Array:
    """Whether all that learning has made is numbers."""
    made = (learner.params, learner.target_params, learner.opt_state)
    floats = [x for x in jax.tree.leaves(made) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.all(jnp.stack([jnp.isfinite(x).all() for x in floats]))


def train_chunk(
    runner: RunnerState, env_params: EnvParams, program: Program
) -> tuple[RunnerState, Metrics]:
    """Scan over `rounds_per_chunk` rounds; nothing returns to the host in between.

    Args:
        runner: donated; with `num_seeds` > 1 every array has a leading axis [K].
        env_params: the world, shared by all seeds.
        program: static.

    Returns:
        The new state and metrics [rounds] ([K, rounds] for several seeds).
    """
    chunk = partial(_train_chunk_on_each, program=program)
    if program.mesh is None:
        return chunk(runner, env_params)
    specs = runner_specs(program)
    return jax.shard_map(
        chunk,
        mesh=program.mesh,
        in_specs=(specs, PartitionSpec()),
        out_specs=(specs, PartitionSpec()),
        check_vma=False,  # Loops in the simulator begin with constants, which vary nowhere.
    )(runner, env_params)


def _train_chunk_on_each(
    runner: RunnerState, env_params: EnvParams, program: Program
) -> tuple[RunnerState, Metrics]:
    """What one device does."""

    def one_round(runner: RunnerState, _: None) -> tuple[RunnerState, Metrics]:
        return train_round(runner, env_params, program)

    def rounds(runner: RunnerState) -> tuple[RunnerState, Metrics]:
        return jax.lax.scan(one_round, runner, None, length=program.config.rounds_per_chunk)

    if program.config.num_seeds == 1:
        return rounds(runner)
    runner, metrics = _for_each_seed(rounds, runner)
    gather = partial(all_shards, axis_name=program.seed_axis_name)
    return runner, jax.tree.map(gather, metrics)


def _for_each_seed(function: Callable[..., Any], runner: RunnerState) -> Any:
    """Side by side; one alone as a run of one seed, whose branches can be left out."""
    if runner.key.shape[0] > 1:
        return jax.vmap(function)(runner)
    results = function(jax.tree.map(lambda x: x[0], runner))
    return jax.tree.map(lambda x: x[None], results)


_compiled_train_chunk = exported_jit(train_chunk, static_argname="program", donate_argname="runner")


def start_run(program: Program) -> RunnerState:
    """State of a new run: seed `config.seed`, or several with consecutive seeds side by side.

    Run i of several has the same key as a single run with seed `config.seed + i`. With a mesh, the
    arrays lie on its devices.
    """
    return place(_start_run(program), program.mesh, runner_specs(program))


@exported_jit(static_argname="program")
def _start_run(program: Program) -> RunnerState:
    config = program.config
    if config.num_seeds == 1:
        return init_runner(jax.random.key(config.seed), program)
    keys = jax.vmap(jax.random.key)(config.seed + jnp.arange(config.num_seeds))
    return jax.vmap(lambda key: init_runner(key, program))(keys)


def runner_shapes(program: Program) -> RunnerState:
    """Shapes, dtypes and places of what `start_run` makes, without computing anything."""
    shapes = jax.eval_shape(partial(_start_run, program))
    return placed_shapes(shapes, program.mesh, runner_specs(program))


@dataclass(frozen=True)
class ChunkReport:
    """What one chunk did."""

    chunk: int
    """Chunks done, from 1."""
    metrics: dict[str, Any]
    """Means over the chunk's rounds; a list with one number a seed where there are several."""
    seconds: float
    """Time the chunk ran."""


CompiledChunk = Callable[[RunnerState, EnvParams], tuple[RunnerState, Metrics]]
"""A compiled `train_chunk`."""


def compile_chunk(env_params: EnvParams, program: Program) -> tuple[CompiledChunk, float]:
    """Compile `train_chunk`; returns it and the seconds it took.

    It is compiled from shapes: arrays from a checkpoint are bound to their device, and what is
    compiled for those is not what a new run has compiled and stored.
    """
    started = time.perf_counter()
    world = placed_shapes(jax.eval_shape(lambda x: x, env_params), program.mesh)
    runner = runner_shapes(program)
    compiled = _compiled_train_chunk.compile(runner, world, program)
    return compiled, time.perf_counter() - started


def run(
    runner: RunnerState,
    env_params: EnvParams,
    program: Program,
    compiled: CompiledChunk | None = None,
) -> Iterator[tuple[RunnerState, ChunkReport]]:
    """Train chunk by chunk from any state to the end, yielding after each.

    The yielded state is donated to the next chunk: use it before asking for the next one.
    `compiled` comes from `compile_chunk`; without it the first chunk waits for it. With a mesh,
    `runner` lies on its devices.
    """
    config = program.config
    env_params = place(env_params, program.mesh)
    if compiled is None:
        compiled, _ = compile_chunk(env_params, program)
    for chunk in range(rounds_done(runner) // config.rounds_per_chunk + 1, config.num_chunks + 1):
        started = time.perf_counter()
        runner, metrics = compiled(runner, env_params)
        host_metrics = jax.device_get(metrics)
        seconds = time.perf_counter() - started
        yield runner, ChunkReport(chunk, _average(host_metrics, config), seconds)


def rounds_done(runner: RunnerState) -> int:
    """Rounds that lie behind a state, as a number on the host."""
    return int(np.max(own_part(runner.learner.round)))


def _average(metrics: dict[str, Any], config: TrainConfig) -> dict[str, Any]:
    """Mean over the rounds of a chunk, as plain numbers (lists over seeds, lists over skills).

    Counts are those at the end. Before learning has begun there is no loss: NaN.
    """
    axis = 0 if config.num_seeds == 1 else 1
    means = {name: np.mean(value, axis=axis).tolist() for name, value in metrics.items()}
    return means | {
        "updates": int(np.max(metrics["updates"])),
        "skipped_updates": np.max(metrics["skipped_updates"], axis=axis).tolist(),
        "finite": np.all(metrics["finite"], axis=axis).tolist(),
    }
