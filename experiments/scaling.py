"""How a run grows from one device to several, and from one process to two on this machine.

    python -m experiments.scaling --out FILE

Each row trains the preset `quick` in processes of its own, with one core for each device. Of the
time on one device, a part stays whatever the number of devices (Amdahl's law): with T1 seconds a
round on one and T2 on two, 2 T2 / T1 - 1 of T1.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax

from experiments.common import run
from experiments.timing import Timing, four_digits
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import make_env
from sqn_jax.maps import load_map
from sqn_jax.storage.files import probe_file, write_json
from sqn_jax.training import devices, loop, processes
from sqn_jax.training.processes import Cluster
from sqn_jax.training.state import params_shapes

LAYOUTS = ((1, 1), (1, 2), (2, 1))
"""Processes, and devices of each."""

CONFIG = dataclasses.replace(PRESETS["quick"], rounds_per_chunk=1)


def main() -> None:
    """Measure every layout and write the record."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="the record")
    parser.add_argument("--repeats", type=int, default=5, help="rounds that are timed")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.repeats < 1:
        raise ValueError(f"--repeats is {options.repeats}, expected at least 1")
    if options.worker:
        port, count, process, of_each = map(int, options.worker.split(","))
        work(Cluster(f"localhost:{port}", count, process), of_each, options.repeats)
        return
    if options.out:
        probe_file(options.out)
    rows = [measured(count, of_each, options.repeats) for count, of_each in LAYOUTS]
    alone, *divided = rows
    for row in divided:
        ratio = row["seconds_a_round"] / alone["seconds_a_round"]
        row["undivided_fraction"] = four_digits(2 * ratio - 1)
    leaves = jax.tree.leaves(params_shapes(CONFIG))
    record = {
        "preset": "quick",
        "device": devices.describe(),
        "num_envs": CONFIG.num_envs,
        "batch_size": CONFIG.learner.batch_size,
        "gradient_bytes_an_update": sum(leaf.size * leaf.dtype.itemsize for leaf in leaves),
        "rows": rows,
    }
    print(json.dumps(record, indent=1))
    if options.out:
        write_json(options.out, record)


def measured(count: int, of_each: int, repeats: int) -> dict[str, Any]:
    """Start the processes of one layout; what the first has measured."""
    port = 20_000 + (os.getpid() + 10 * count + of_each) % 10_000
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(of_each)}
    command = [sys.executable, "-m", "experiments.scaling", "--repeats", str(repeats), "--worker"]
    started = [
        subprocess.Popen(
            [*command, f"{port},{count},{process},{of_each}"],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        for process in range(count)
    ]
    texts = [process.communicate()[0] for process in started]
    if any(process.returncode for process in started):
        raise RuntimeError(f"{count} processes of {of_each} devices: one has failed")
    row: dict[str, Any] = json.loads(texts[0].splitlines()[-1])
    return row


def work(cluster: Cluster, of_each: int, repeats: int) -> None:
    """Be one of the processes of a layout: train, and print the times of the rounds."""
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[of_each * int(cluster.process_id or 0) :][:of_each])
    processes.join(cluster)
    count = jax.process_count()
    mesh = devices.choose(CONFIG, count * of_each)
    occupancy_map = load_map(CONFIG.maps, robot_radius=CONFIG.env.robot_radius)
    env_params = make_env(occupancy_map, CONFIG.env)
    program = loop.make_program(env_params, CONFIG, mesh)
    compiled, _ = loop.compile_chunk(env_params, program)
    runner, env_params = loop.start_run(program), devices.place(env_params, mesh)
    seconds = []
    for _ in range(1 + repeats):
        processes.gather(None)
        started = time.perf_counter()
        runner, metrics = compiled(runner, env_params)
        jax.block_until_ready(metrics)
        seconds.append(time.perf_counter() - started)
    timing = Timing(seconds[0], tuple(seconds[1:]))
    steps = CONFIG.num_envs * program.max_steps
    row = {
        "processes": count,
        "devices_of_each": of_each,
        "seconds_a_round": four_digits(timing.median),
        "steps_per_second_a_device": four_digits(steps / timing.median / (count * of_each)),
        "updates_per_second": four_digits(program.updates_per_round / timing.median),
        "slowest": round(max(timing.seconds), 3),
        "fastest": round(min(timing.seconds), 3),
    }
    print(json.dumps(row), flush=True)
    processes.leave()


if __name__ == "__main__":
    run(main)
