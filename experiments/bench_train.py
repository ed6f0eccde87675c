"""The whole compiled training program of a preset, and what a run takes of memory."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Sequence
from typing import Any

import jax

from experiments.timing import Timing, four_digits
from sqn_jax.agent import r2d2, replay
from sqn_jax.config import TrainConfig
from sqn_jax.env import EnvParams
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.training import devices, loop
from sqn_jax.training.state import memory_bytes, trajectory_shapes


def measure(config: TrainConfig, env_params: EnvParams, repeats: int) -> dict[str, Any]:
    """Time calls of `train_chunk`, rollouts and updates together, once updates have begun.

    Args:
        config: the run.
        env_params: its world.
        repeats: calls that are timed.

    Returns:
        Steps and updates a second (of all seeds), slowest and fastest steps a second, seconds to
        compile, of the first call, and of a whole run at this speed.
    """
    mesh = devices.choose(config)
    program = loop.make_program(env_params, config, mesh)
    runner = loop.start_run(program)
    compiled, compile_seconds = loop.compile_chunk(env_params, program)
    env_params = devices.place(env_params, mesh)
    warm_up = 0.0
    seconds: list[float] = []
    updates = 0
    while len(seconds) < repeats:
        started = time.perf_counter()
        runner, metrics = compiled(runner, env_params)
        jax.block_until_ready((runner, metrics))
        lasted = time.perf_counter() - started
        if updates:
            seconds.append(lasted)
        warm_up = warm_up or lasted
        updates = int(metrics["updates"].max())
    timing = Timing(warm_up, tuple(seconds))
    rounds = config.rounds_per_chunk * config.num_seeds
    steps = rounds * config.num_envs * env_params.max_steps
    updates_a_chunk = rounds * program.updates_per_round
    return {
        "algo": config.algo,
        "method": config.method,
        "map": config.map,
        "num_envs": config.num_envs,
        "num_seeds": config.num_seeds,
        "num_devices": 1 if mesh is None else mesh.size,
        "steps_per_chunk": steps,
        **timing.rates(steps, unit="steps_per_second"),
        "updates_per_second": four_digits(updates_a_chunk / timing.median),
        "compile_seconds": round(compile_seconds, 2),
        "run_seconds": four_digits(config.num_chunks * timing.median),
    }


def memory(config: TrainConfig, env_params: EnvParams) -> dict[str, int]:
    """Bytes: the peak of this process so far, and what a run with this config keeps.

    `replay_bytes` is the replay (0 without one), `run_bytes` adds the episodes of one round.
    """
    program = loop.make_program(env_params, config)
    item = r2d2.packed_item(trajectory_shapes(program))
    has_replay = config.method == "r2d2"
    capacity = config.replay.capacity if has_replay else 0
    return {
        "peak_process_bytes": peak_bytes(),
        "replay_episodes": capacity,
        "replay_bytes": replay.num_bytes(item, capacity) if has_replay else 0,
        "run_bytes": memory_bytes(program),
    }


def peak_bytes() -> int:
    """The most memory that this process has held so far, bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # Elsewhere it counts KiB.


def table(entries: Sequence[dict[str, Any]]) -> str:
    """One row for each preset and number of seeds."""
    rows = []
    for entry in entries:
        row = [entry["preset"], entry["algo"], entry["method"]]
        row += [str(entry["num_envs"]), str(entry["num_seeds"])]
        row += [f"{entry['steps_per_second']:,}", f"{entry['updates_per_second']:.3g}"]
        rows.append([*row, f"{entry['compile_seconds']:.1f}", f"{entry['run_seconds']:.0f}"])
    header = ["preset", "agent", "method", "robots", "seeds", "steps a second", "updates a second"]
    return markdown_table([*header, "seconds to compile", "seconds a run"], rows)
