"""What a GPU computes beside what the CPU does: python experiments/check_gpu.py [--out FILE]

The simulator drives the same robots with the same random actions on both. The recurrence of the GRU
runs as scans, as everywhere, and as the kernels of `sqn_jax/agent/gru_kernel.py`; both are timed.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from experiments.common import run
from experiments.timing import time_in_turns
from sqn_jax.agent import gru, gru_kernel
from sqn_jax.env import NUM_ACTIONS, EnvParams, make_env, reset, step
from sqn_jax.storage.files import write_json
from sqn_jax.training import devices

ROBOTS, STEPS = 512, 100
SIZES = ((1, 391, 64), (5, 391, 64), (1, 100, 16), (5, 100, 16))
"""Seeds, steps and robots of a minibatch: of the presets `paper` and `quick`."""
HIDDEN = 128
QUANTITIES = ("ranges", "goal", "reward", "pose", "covered_area", "collision")


def rollout(params: EnvParams, keys: Array, actions: Array) -> tuple[Array, ...]:
    """What robots [N] see and get for actions [T, N]: [T, N, ...], in the order of QUANTITIES."""
    _, states = jax.vmap(reset, in_axes=(0, None))(keys, params)

    def advance(states: Any, taken: Array) -> Any:
        step_all = jax.vmap(step, in_axes=(0, 0, 0, None))
        obs, states, reward, _, _, info = step_all(keys, states, taken, params)
        area, refused = info["covered_area"], info["collision"]
        return states, (obs.ranges, obs.goal, reward, states.pose, area, refused)

    outputs: tuple[Array, ...] = jax.lax.scan(advance, states, actions)[1]
    return outputs


def compare_simulators(map_name: str) -> dict[str, Any]:
    """Largest differences, and the share of numbers that differ by more than a thousandth.

    Robots count for as long as they are in the same place: after a ray that grazes a corner on one
    device and passes it on the other, they may part.
    """
    keys = jax.random.split(jax.random.key(1), ROBOTS)
    actions = jax.random.randint(jax.random.key(2), (STEPS, ROBOTS), 0, NUM_ACTIONS)
    given = (make_env(map_name), keys, actions)
    here, there = (
        [np.asarray(x, np.float64) for x in jax.jit(rollout)(*jax.device_put(given, device))]
        for device in (jax.devices("cpu")[0], jax.devices()[0])
    )
    moved = np.abs(here[3] - there[3]).max(axis=-1) < 1e-3
    together = np.cumprod(moved, axis=0).astype(bool)
    entry: dict[str, Any] = {"together": float(together.mean())}
    for name, ours, theirs in zip(QUANTITIES, here, there, strict=True):
        apart = np.abs(ours - theirs)[together]
        entry[name] = {"largest": float(apart.max()), "share": float((apart > 1e-3).mean())}
    return entry


def compare_recurrences(size: tuple[int, int, int], repeats: int) -> dict[str, float]:
    """Milliseconds of scans and kernels, and how far the kernels are from scans in float32."""
    seeds, steps, robots = size
    keys = jax.random.split(jax.random.key(0), 7)
    shape = (seeds, steps, robots, HIDDEN)
    projected = jax.random.normal(keys[0], (*shape[:-1], 3 * HIDDEN))
    carry = jax.random.uniform(keys[1], (seeds, robots, HIDDEN), minval=-1.0)
    square = (seeds, HIDDEN, HIDDEN)
    kernels = tuple(jax.random.normal(key, square) / HIDDEN**0.5 for key in keys[2:5])
    bias = jax.random.normal(keys[5], (seeds, HIDDEN))
    forwards = (projected, carry, kernels, bias)
    with jax.default_matmul_precision("highest"):
        exact = jax.jit(jax.vmap(gru._scan_forward))(*forwards)
        previous = jnp.concatenate([carry[:, None], exact[0][:, :-1]], axis=1)
        backwards = (jax.random.normal(keys[6], shape), previous, exact[1:], kernels)
        exact_back = jax.jit(jax.vmap(gru._scan_backward))(*backwards)
    programs = {
        "scan_forward": partial(jax.jit(jax.vmap(gru._scan_forward)), *forwards),
        "scan_backward": partial(jax.jit(jax.vmap(gru._scan_backward)), *backwards),
        "kernel_forward": partial(jax.jit(jax.vmap(gru_kernel.forward)), *forwards),
        "kernel_backward": partial(jax.jit(jax.vmap(gru_kernel.backward)), *backwards),
    }
    timings = time_in_turns({name: _of_turn(call) for name, call in programs.items()}, repeats)
    entry = {f"{name}_ms": 1e3 * timing.median for name, timing in timings.items()}
    entry["error_forward"] = _relative_error(exact, programs["kernel_forward"]())
    entry["error_backward"] = _relative_error(exact_back, programs["kernel_backward"]())
    return {name: float(f"{value:.4g}") for name, value in entry.items()}


def _of_turn(call: Any) -> Any:
    return lambda turn: call()


def _relative_error(expected: Any, found: Any) -> float:
    """The largest difference over the largest number, of the worst array."""
    pairs = zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True)
    return max(float(jnp.abs(x - y).max() / jnp.abs(x).max()) for x, y in pairs)


def main() -> None:
    """Compare, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=20, help="turns (default 20)")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    if jax.devices()[0].platform != "gpu":
        raise ValueError(
            f"JAX finds only {devices.describe()}, expected a GPU to compare with the CPU"
        )
    simulators = {name: compare_simulators(name) for name in ("maze", "cave")}
    for name, entry in simulators.items():
        print(f"{name}: {100 * entry['together']:.2f} % of the steps in the same place; largest")
        print("  " + ", ".join(f"{key} {entry[key]['largest']:.2g}" for key in QUANTITIES))
    recurrences = {}
    if gru_kernel.fits(SIZES[0][1], HIDDEN):
        for size in SIZES:
            size_text = "{} seeds, {} steps, {} robots".format(*size)
            recurrences[size_text] = compare_recurrences(size, options.repeats)
            print(
                size_text,
                *(f"{name} {value}" for name, value in recurrences[size_text].items()),
                sep="\n  ",
            )
    else:
        print("there are no kernels of the GRU for this GPU: scans everywhere")
    if options.out is not None:
        made = {"device": devices.describe(), "jax": jax.__version__}
        found = {"simulators": simulators, "recurrences": recurrences}
        write_json(options.out, made | found)


if __name__ == "__main__":
    run(main)
