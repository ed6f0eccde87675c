"""Steps a second through each adapter, beside the simulator in a compiled program of its own.

The bare programs are `jit(vmap(step))`, called step by step or in one scan, with neither seeds nor
resets. Adapters are called as their users do: step by step, with actions from the host where the
interface has them there, and with resets; episodes end and begin within the time that is taken.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from experiments.bench_simulator import draw_actions
from experiments.common import run
from experiments.timing import Timed, time_in_turns
from sqn_jax.adapters.gym import NavigationEnv
from sqn_jax.adapters.gym_vector import NavigationVectorEnv
from sqn_jax.adapters.gymnax import Navigation
from sqn_jax.env import make_env, reset, step
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.training import devices

MANY = (0, 0, 0, None)


def bare_programs(map_name: str, num_envs: int, num_steps: int) -> dict[str, Timed]:
    """The simulator by itself, and through the interface of gymnax within a scan."""
    env = Navigation(map_name)
    params = make_env(map_name)
    action_key, step_key = jax.random.split(jax.random.key(0))
    actions, keys = draw_actions(action_key, step_key, num_steps, num_envs)
    start_keys = jax.random.split(jax.random.key(1), num_envs)
    _, states = jax.jit(jax.vmap(reset, in_axes=(0, None)))(start_keys, params)
    advance = jax.jit(jax.vmap(step, in_axes=MANY))
    actions_on_host, keys_of_steps = np.asarray(actions), list(keys)

    def step_by_step(turn: int) -> Any:
        now: Any = states
        for number in range(num_steps):
            obs, now, reward, *_ = advance(
                keys_of_steps[number], now, actions_on_host[number], params
            )
        return obs, reward

    def scanned(one_step: Callable[..., Any]) -> Timed:
        def body(states: Any, draws: Any) -> Any:
            keys, actions = draws
            obs, states, reward, _, truncated, info = jax.vmap(one_step, in_axes=MANY)(
                keys, states, actions, params
            )
            return states, (obs, reward, truncated, info["reached"])

        program = jax.jit(lambda states, *draws: jax.lax.scan(body, states, draws))
        return lambda turn: program(states, keys, actions)

    return {
        "bare, one scan": scanned(step),
        "gymnax, one scan": scanned(env.step),
        "bare, step by step": step_by_step,
    }


def adapters(map_name: str, num_envs: int, num_steps: int) -> dict[str, Timed]:
    """The adapters that are called step by step."""
    rng = np.random.default_rng(0)
    actions = rng.integers(0, 5, (num_steps, num_envs))

    def stepping(envs: Any) -> Timed:
        def program(turn: int) -> Any:
            for number in range(num_steps):
                results = envs.step(actions[number])
            return results[0]

        return program

    timed: dict[str, Timed] = {}
    for mode in AutoresetMode:
        limit: dict[str, Any] = {"max_steps": 100_000} if mode is AutoresetMode.DISABLED else {}
        envs = NavigationVectorEnv(map_name, num_envs, autoreset_mode=mode, **limit)
        envs.reset(seed=0)
        timed[f"gymnasium vector, {mode.value}"] = stepping(envs)
    envs = NavigationVectorEnv(map_name, num_envs, arrays="jax")
    envs.reset(seed=0)
    timed["gymnasium vector, NextStep, arrays of JAX"] = stepping(envs)
    if importlib.util.find_spec("stable_baselines3"):
        from sqn_jax.adapters.sb3 import NavigationVecEnv

        vec_env = NavigationVecEnv(map_name, num_envs)
        vec_env.reset()
        timed["stable-baselines3"] = stepping(vec_env)
    else:
        print("stable_baselines3 is not installed: left out")
    return timed


def one_env(map_name: str, num_steps: int) -> Timed:
    """A single Gymnasium environment."""
    env = NavigationEnv(map_name)
    actions = np.random.default_rng(0).integers(0, 5, num_steps).tolist()

    def program(turn: int) -> Any:
        env.reset(seed=turn)
        for action in actions:
            obs, *_ = env.step(action)
        return jnp.asarray(obs)

    return program


def measure(map_name: str, num_envs: int, num_steps: int, repeats: int) -> list[dict[str, Any]]:
    """Steps a second of all, which take turns; and those of the bare program it stands beside."""
    many = bare_programs(map_name, num_envs, num_steps)
    many |= adapters(map_name, num_envs, num_steps)
    timings = time_in_turns(many | {"gymnasium, one env": one_env(map_name, num_steps)}, repeats)
    entries = []
    for name, timing in timings.items():
        count = 1 if name == "gymnasium, one env" else num_envs
        beside = "bare, one scan" if "scan" in name else "bare, step by step"
        fraction = timings[beside].median / timing.median if count > 1 else None
        entry = {"program": name, "num_envs": count}
        entry |= timing.rates(count * num_steps, "steps_per_second")
        entries.append(entry | {"of_bare": fraction and round(fraction, 3)})
    return entries


def table(entries: list[dict[str, Any]]) -> str:
    """Steps a second, and as a fraction of the bare program's that is called alike."""
    rows = []
    for entry in entries:
        fraction = "-" if entry["of_bare"] is None else f"{entry['of_bare']:.2f}"
        speed = f"{entry['steps_per_second']:,}"
        rows.append([entry["program"], str(entry["num_envs"]), speed, fraction])
    return markdown_table(["program", "robots", "steps a second", "of bare"], rows)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--map", default="maze")
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=401, help="of each robot in a turn")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    for name in ("envs", "steps", "repeats"):
        if getattr(options, name) < 1:
            raise ValueError(f"--{name} is {getattr(options, name)}, expected at least 1")
    entries = measure(options.map, options.envs, options.steps, options.repeats)
    print(table(entries))
    if options.out is not None:
        names = ("jax", "gymnasium", "stable-baselines3")
        installed = [name for name in names if importlib.util.find_spec(name.replace("-", "_"))]
        data = {
            "command": " ".join(["experiments/bench_adapters.py", *sys.argv[1:]]),
            "map": options.map,
            "device": devices.describe(),
            "cpu": devices.cpu_model(),
            "cpu_count": os.cpu_count(),
            "versions": {name: metadata.version(name) for name in installed},
            "adapters": entries,
        }
        options.out.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    run(main)
