"""How fast the simulator is, beside JaxNav where that is installed.

    .venv/bin/python experiments/benchmark.py [--maps maze cave] [--envs 64 256 1024] [--out FILE]

Steps a second of many robots with random actions: rays, coverage, reward and observation for ours;
rays, reward and observation for JaxNav (`pip install jaxmarl`), with one robot, 71 beams of 5 m,
with and without its reset in every step. All programs are compiled and warmed up first and then
take turns, so that a busy moment of the machine hits all of them; told are medians.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
from jax import Array

import sqn_jax
from experiments.common import run
from sqn_jax.env import NUM_ACTIONS, EnvParams, make_env, reset, step
from sqn_jax.runlog import write_json
from sqn_jax.scores import markdown_table

Program = Callable[[Array], Any]


@partial(jax.jit, static_argnames=("num_envs", "num_steps"))
def drive_ours(key: Array, params: EnvParams, num_envs: int, num_steps: int) -> Any:
    """Observations and rewards of robots with random actions."""
    start_key, drive_key = jax.random.split(key)
    _, states = jax.vmap(reset, in_axes=(0, None))(jax.random.split(start_key, num_envs), params)

    def body(states: Any, key: Array) -> tuple[Any, Any]:
        action_key, step_key = jax.random.split(key)
        actions = jax.random.randint(action_key, (num_envs,), 0, NUM_ACTIONS)
        keys = jax.random.split(step_key, num_envs)
        obs, states, reward, _, _, info = jax.vmap(step, in_axes=(0, 0, 0, None))(
            keys, states, actions, params
        )
        return states, (obs, reward, info["reached"])

    return jax.lax.scan(body, states, jax.random.split(drive_key, num_steps))[1]


def jaxnav(num_envs: int, num_steps: int, *, resets: bool) -> Program | None:
    """The same for JaxNav; None where it is not installed."""
    try:
        from jaxmarl.environments.jaxnav import JaxNav  # type: ignore[import-not-found]
    except ImportError:
        return None
    world = JaxNav(num_agents=1, act_type="Discrete", lidar_num_beams=71, lidar_max_range=5.0)
    advance = world.step if resets else world.step_env

    def drive(key: Array) -> Any:
        start_key, drive_key = jax.random.split(key)
        _, states = jax.vmap(world.reset)(jax.random.split(start_key, num_envs))

        def body(states: Any, key: Array) -> tuple[Any, Any]:
            action_key, step_key = jax.random.split(key)
            actions = {"agent_0": jax.random.randint(action_key, (num_envs,), 0, NUM_ACTIONS)}
            keys = jax.random.split(step_key, num_envs)
            obs, states, reward, *_ = jax.vmap(advance)(keys, states, actions)
            return states, (obs["agent_0"], reward["agent_0"])

        return jax.lax.scan(body, states, jax.random.split(drive_key, num_steps))[1]

    return jax.jit(drive)


def programs(options: argparse.Namespace) -> dict[tuple[str, int], Program]:
    """What is timed, by name and number of robots."""
    found: dict[tuple[str, int], Program] = {}
    for name in options.maps:
        params = make_env(name)
        for count in options.envs:
            ours = partial(drive_ours, params=params, num_envs=count, num_steps=options.steps)
            found[f"sqn_jax, {name}", count] = ours
    for resets, name in ((False, "JaxNav"), (True, "JaxNav, reset in every step")):
        for count in options.envs:
            theirs = jaxnav(count, options.steps, resets=resets)
            if theirs is not None:
                found[name, count] = theirs
    return found


def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """One entry a program: steps a second, its quartiles, and the seconds to compile."""
    timed = programs(options)
    compile_seconds: dict[tuple[str, int], float] = {}
    seconds: dict[tuple[str, int], list[float]] = {key: [] for key in timed}
    for key, program in timed.items():
        started = time.perf_counter()
        jax.block_until_ready(program(jax.random.key(0)))
        compile_seconds[key] = time.perf_counter() - started
    for turn in range(options.repeats):
        for key, program in timed.items():
            started = time.perf_counter()
            jax.block_until_ready(program(jax.random.key(turn)))
            seconds[key].append(time.perf_counter() - started)
    entries = []
    for (name, count), times in seconds.items():
        steps = count * options.steps
        entries.append(
            {
                "program": name,
                "num_envs": count,
                "steps_per_second": round(steps / statistics.median(times)),
                "slowest": round(steps / max(times)),
                "fastest": round(steps / min(times)),
                "first_call_seconds": round(compile_seconds[name, count], 2),
            }
        )
    return entries


def table(entries: list[dict[str, Any]]) -> str:
    """Steps a second, and how many times those of JaxNav with as many robots."""
    base = {e["num_envs"]: e["steps_per_second"] for e in entries if e["program"] == "JaxNav"}
    rows = []
    for entry in entries:
        ratio = entry["steps_per_second"] / base.get(entry["num_envs"], float("nan"))
        told = f"{ratio:.1f}" if entry["num_envs"] in base else "-"
        speed = f"{entry['steps_per_second']:,}"
        rows.append([entry["program"], str(entry["num_envs"]), speed, told])
    return markdown_table(["program", "robots", "steps a second", "times JaxNav"], rows)


def main() -> None:
    """Parse the options, measure, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--maps", nargs="+", default=["maze", "cave"])
    parser.add_argument("--envs", nargs="+", type=int, default=[64, 256, 1024])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    for name in ("steps", "repeats"):
        if getattr(options, name) < 1:
            raise ValueError(f"--{name} is {getattr(options, name)}, expected at least 1")
    if min(options.envs) < 1:
        raise ValueError(f"--envs holds {min(options.envs)}, expected at least 1")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # JaxNav's.
        entries = measure(options)
    print(table(entries))
    if options.out is not None:
        device = jax.devices()[0]
        told = {
            "command": " ".join(["experiments/benchmark.py", *sys.argv[1:]]),
            "device": f"{device.platform} ({device.device_kind})",
            "cpu_count": os.cpu_count(),
            "versions": {"sqn_jax": sqn_jax.__version__, "jax": jax.__version__},
            "simulator": entries,
        }
        write_json(options.out, told)


if __name__ == "__main__":
    run(main)
