"""Training: one compiled program that scans over rounds of rollout and learning.

`train_chunk` is the device program; `run` drives it chunk by chunk and hands numbers to the host
in between. Files, bars and pictures stand outside, in whoever consumes the generator.

With a mesh of several devices (`devices.choose`) each of them drives and learns from its share of
the robots. Chance is drawn for all robots alike on each, so that no robot's fate depends on the
number of devices.
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
from jax.sharding import Mesh, PartitionSpec

from sqn_jax.agent import pqn, r2d2, replay
from sqn_jax.agent.experience import Episodes
from sqn_jax.agent.exploration import epsilon_per_robot, epsilon_schedule
from sqn_jax.agent.learner import LearnerState, discount_schedule, init_learner, make_optimizer
from sqn_jax.agent.networks import Params, QNetwork, make_network
from sqn_jax.agent.replay import ReplayState
from sqn_jax.agent.shares import mean, own_share
from sqn_jax.config import TrainConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams
from sqn_jax.training.devices import AXIS, place, placed_shapes
from sqn_jax.training.rollout import (
    Fleet,
    Trace,
    draw_chance,
    join_windows,
    own_worlds,
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
        fleet = start_fleet(jax.random.split(key, config.num_envs), network, env_params)
        params = network.init(key, jax.tree.map(lambda x: x[None], fleet.obs), fleet.carry)
        epsilon = jnp.zeros(config.num_envs)
        chance = draw_chance(key, num_steps, config.num_envs)
        return unroll(chance, network, params, fleet, epsilon, env_params)[1]

    return jax.eval_shape(one_unroll, jax.random.key(0))


def memory_bytes(config: TrainConfig, env_params: EnvParams) -> int:
    """Bytes that the replay of all seeds and the episodes of a round will take, on all devices."""
    episodes = episode_shapes(config, env_params)
    total = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(episodes))
    if config.method == "r2d2":
        total += replay.num_bytes(r2d2.packed_item(episodes), config.replay.capacity)
    return config.num_seeds * total


def init_runner(key: Array, env_params: EnvParams, config: TrainConfig) -> RunnerState:
    """The state of one run before its first round; the key is consumed."""
    learner_key, obs_key, run_key = jax.random.split(key, 3)
    network = network_of(config)
    fleet = start_fleet(jax.random.split(obs_key, 1), network, env_params)
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
        memory = replay.init(item, config.replay.capacity, config.num_envs)
    return RunnerState(learner=learner, memory=memory, key=run_key, round=jnp.int32(0))


def train_round(
    runner: RunnerState,
    _: None,
    *,
    env_params: EnvParams,
    config: TrainConfig,
    axis_name: str | None = None,
) -> tuple[RunnerState, dict[str, Array]]:
    """One whole episode of all robots, with the updates; returns scalars to log.

    With the name of an axis of devices, of this device's share of the robots; the scalars are those
    of all.
    """
    key, fleet_key, window_key = jax.random.split(runner.key, 3)
    windows = num_windows(config, env_params)
    progress = runner.round / config.num_rounds
    epsilon = epsilon_per_robot(progress, config.num_envs, config.exploration)
    epsilon = own_share(epsilon, axis_name)
    env_params = own_worlds(env_params, config.randomization, config.num_envs, axis_name)
    fleet_keys = own_share(jax.random.split(fleet_key, config.num_envs), axis_name)
    fleet = start_fleet(fleet_keys, network_of(config), env_params)
    discount = discount_schedule(progress, config.learner)
    body = partial(
        _drive_and_learn,
        epsilon=epsilon,
        discount=discount,
        env_params=env_params,
        config=config,
        axis_name=axis_name,
    )
    on_first_task = jnp.ones(epsilon.shape[0], bool)
    first = (runner.learner, runner.memory, fleet, on_first_task)
    keys = jax.random.split(window_key, windows)
    (learner, memory, _fleet, _first), (traces, learning) = jax.lax.scan(body, first, keys)
    trace = join_windows(traces)
    summary = summarize(trace, env_params.goal_radius)
    told = {
        "mean_reward": summary.mean_reward.mean(),
        "success": summary.success.mean(),
        "time_steps": summary.time_steps.mean(),
        "collisions": summary.collisions.mean(),
        "covered_area": summary.covered_area.mean(),
        "skill_usage": trace.skill_weights.mean(axis=(0, 1)),
    }
    metrics = mean(told, axis_name) | {
        "updates": learner.num_updates,
        "skipped_updates": learner.num_skipped,
        "finite": _is_finite(learner),
        "epsilon": epsilon_schedule(progress, config.exploration),
        "discount": jnp.asarray(discount, jnp.float32),
        **jax.tree.map(jnp.mean, learning),
    }
    new_runner = RunnerState(learner=learner, memory=memory, key=key, round=runner.round + 1)
    return new_runner, metrics


def _is_finite(learner: LearnerState) -> Array:
    """Whether all that learning has made is numbers."""
    floats = [x for x in jax.tree.leaves(learner) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.all(jnp.stack([jnp.isfinite(x).all() for x in floats]))


def _drive_and_learn(
    carry: tuple[LearnerState, Any, Fleet, Array],
    key: Array,
    *,
    epsilon: Array,
    discount: Array | float,
    env_params: EnvParams,
    config: TrainConfig,
    axis_name: str | None,
) -> tuple[tuple[LearnerState, Any, Fleet, Array], tuple[Trace, dict[str, Array]]]:
    """One window: drive it, learn from it, and send robots that have arrived to new goals.

    To the learner a new task is a truncation, as the end of every window is one: it has already
    seen the last observation of the old one. Success and time steps are those of first tasks.
    """
    learner, memory, fleet, on_first_task = carry
    unroll_key, learn_key, restart_key = jax.random.split(key, 3)
    network = network_of(config)
    num_steps = env_params.max_steps // num_windows(config, env_params)
    chance = own_share(draw_chance(unroll_key, num_steps, config.num_envs), axis_name, axis=1)
    fleet, episodes, trace = unroll(chance, network, learner.params, fleet, epsilon, env_params)
    learn = r2d2.learn if config.method == "r2d2" else pqn.learn
    optimizer = optimizer_of(config, env_params)
    learner, memory, metrics = learn(
        learn_key, learner, memory, episodes, network, optimizer, config, discount, axis_name
    )
    distances = jnp.where(on_first_task[None], trace.goal_distances, jnp.inf)
    trace = dataclasses.replace(trace, goal_distances=distances)
    if config.method == "pqn" and config.learner.restart_at_goal:
        restart_keys = own_share(jax.random.split(restart_key, config.num_envs), axis_name)
        fleet, restarted = restart_at_goal(restart_keys, fleet, network, env_params)
        on_first_task &= ~restarted
    return (learner, memory, fleet, on_first_task), (trace, metrics)


def train_chunk(
    runner: RunnerState, env_params: EnvParams, config: TrainConfig, mesh: Mesh | None
) -> tuple[RunnerState, dict[str, Array]]:
    """Scan over `rounds_per_chunk` rounds; nothing returns to the host in between.

    Args:
        runner: donated; with `num_seeds` > 1 every array has a leading axis [K].
        env_params: the world, shared by all seeds.
        config: static.
        mesh: static, devices to divide the robots between; None for one alone.

    Returns:
        The new state and metrics [rounds] ([K, rounds] for several seeds).
    """
    if mesh is None:
        return _share_of_chunk(runner, env_params, config=config, axis_name=None)
    held = runner_specs(config)
    return jax.shard_map(
        partial(_share_of_chunk, config=config, axis_name=AXIS),
        mesh=mesh,
        in_specs=(held, PartitionSpec()),
        out_specs=(held, PartitionSpec()),
        check_vma=False,  # Loops in the simulator begin with constants, which vary nowhere.
    )(runner, env_params)


def _share_of_chunk(
    runner: RunnerState, env_params: EnvParams, *, config: TrainConfig, axis_name: str | None
) -> tuple[RunnerState, dict[str, Array]]:
    """What one device does."""
    body = partial(train_round, env_params=env_params, config=config, axis_name=axis_name)

    def scan(one: RunnerState) -> tuple[RunnerState, dict[str, Array]]:
        return jax.lax.scan(body, one, None, length=config.rounds_per_chunk)

    return scan(runner) if config.num_seeds == 1 else jax.vmap(scan)(runner)


def runner_specs(config: TrainConfig) -> RunnerState:
    """How the arrays of a state are divided between devices: only what the replay stores is."""
    whole: Any = PartitionSpec()
    memory: Any = None
    if config.method == "r2d2":
        seeds = () if config.num_seeds == 1 else (None,)
        stored: Any = PartitionSpec(*seeds, None, AXIS)
        memory = ReplayState(stored, whole, whole, whole, whole)
    return RunnerState(learner=whole, memory=memory, key=whole, round=whole)


_jitted_train_chunk = jax.jit(
    train_chunk, static_argnames=("config", "mesh"), donate_argnames="runner"
)


def start_run(env_params: EnvParams, config: TrainConfig, mesh: Mesh | None = None) -> RunnerState:
    """State of a new run: seed `config.seed`, or several with consecutive seeds side by side.

    Run i of several has the same key as a single run with seed `config.seed + i`. With a mesh, the
    arrays lie on its devices.
    """
    return place(_start_run(env_params, config), mesh, runner_specs(config))


@partial(jax.jit, static_argnames="config")
def _start_run(env_params: EnvParams, config: TrainConfig) -> RunnerState:
    if config.num_seeds == 1:
        return init_runner(jax.random.key(config.seed), env_params, config)
    keys = jax.vmap(jax.random.key)(config.seed + jnp.arange(config.num_seeds))
    return jax.vmap(lambda key: init_runner(key, env_params, config))(keys)


def runner_shapes(
    env_params: EnvParams, config: TrainConfig, mesh: Mesh | None = None
) -> RunnerState:
    """Shapes, dtypes and places of what `start_run` makes, without computing anything."""
    shapes = jax.eval_shape(partial(_start_run, config=config), env_params)
    return placed_shapes(shapes, mesh, runner_specs(config))


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
    env_params: EnvParams, config: TrainConfig, mesh: Mesh | None = None
) -> tuple[ChunkProgram, float]:
    """Compile `train_chunk`; returns it and the seconds it took.

    It is compiled from shapes: arrays from a checkpoint are bound to their device, and a program
    made for those is not the one that a new run has compiled and kept.
    """
    started = time.perf_counter()
    world = placed_shapes(jax.eval_shape(lambda x: x, env_params), mesh)
    runner = runner_shapes(env_params, config, mesh)
    lowered = _jitted_train_chunk.lower(runner, world, config, mesh)
    program = lowered.compile()
    return program, time.perf_counter() - started


def run(
    runner: RunnerState,
    env_params: EnvParams,
    config: TrainConfig,
    program: ChunkProgram | None = None,
    mesh: Mesh | None = None,
) -> Iterator[tuple[RunnerState, ChunkReport]]:
    """Train chunk by chunk from any state to the end, yielding after each.

    The yielded state is donated to the next chunk: use it before asking for the next one.
    `program` comes from `compile_chunk`; without one the first chunk waits for it. With a mesh,
    `runner` lies on its devices.
    """
    env_params = place(env_params, mesh)
    if program is None:
        program, _ = compile_chunk(env_params, config, mesh)
    rounds_done = int(np.max(np.asarray(runner.round)))
    for chunk in range(rounds_done // config.rounds_per_chunk + 1, config.num_chunks + 1):
        started = time.perf_counter()
        runner, metrics = program(runner, env_params)
        host_metrics = jax.device_get(metrics)
        seconds = time.perf_counter() - started
        yield runner, ChunkReport(chunk, _average(host_metrics, config), seconds)


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
