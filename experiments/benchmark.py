"""How fast simulator, learner and training are, beside other programs where those are installed.

    .venv/bin/python experiments/benchmark.py [--parts simulator learner ...] [--out FILE]

`simulator`: steps a second with random actions, beside JaxNav (`bench_simulator.py`). `learner`:
R2D2 updates of the preset `paper`, beside PyTorch and beside the machine's rate of matrix products
(`bench_learner.py`). `train`: the compiled training program of a preset (`bench_train.py`).
`breakdown`: the pieces of a step and of a training window (`bench_breakdown.py`). What is compared
takes turns; times are medians. `.venv/bin/python -m pip install -e ".[bench]"` installs JaxNav and
PyTorch.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import itertools
import os
import sys
from pathlib import Path
from typing import Any

import sqn_jax
from experiments import bench_breakdown, bench_learner, bench_simulator, bench_train
from experiments.common import ALGORITHMS, run
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import make_env
from sqn_jax.storage.files import write_json
from sqn_jax.training import devices

PARTS = ("simulator", "learner", "train", "breakdown")


def simulator(options: argparse.Namespace) -> dict[str, Any]:
    """Measure and print the simulator's part."""
    if _version("jaxmarl") is None:
        print("jaxmarl is not installed: no comparison with JaxNav\n")
    entries = bench_simulator.measure(options.maps, options.envs, options.steps, options.repeats)
    print(bench_simulator.table(entries), end="\n\n")
    return {"simulator": entries}


def learner(options: argparse.Namespace) -> dict[str, Any]:
    """Measure and print the learner's part."""
    config = PRESETS["paper"]
    missing = bench_learner.missing_torch()
    if missing:
        print(missing, end="\n\n")
    results = bench_learner.measure(
        config,
        make_env(config.map, config.env),
        options.algos,
        options.repeats,
        torch_threads=() if missing else options.torch_threads,
    )
    size = results["products_size"]
    rates = "; ".join(f"{name}: {rate:.0f}" for name, rate in results["products_gflops"].items())
    print(bench_learner.table(results))
    print(f"\nGFLOP/s in products of float32 matrices [{size}, {size}]: {rates}", end="\n\n")
    return {"learner": results}


def training(options: argparse.Namespace) -> dict[str, Any]:
    """Measure and print the part of whole training programs."""
    entries = []
    for preset, num_seeds in itertools.product(options.presets, options.num_seeds):
        config = dataclasses.replace(PRESETS[preset], num_seeds=num_seeds)
        env_params = make_env(config.map, config.env)
        measured = bench_train.measure(config, env_params, options.repeats)
        entries.append({"preset": preset, **measured})
    print(bench_train.table(entries), end="\n\n")
    return {"train": entries}


def breakdown(options: argparse.Namespace) -> dict[str, Any]:
    """Measure and print where the time of a step and of a training window goes."""
    config = PRESETS["quick"]
    env_params = make_env(config.map, config.env)
    entries = bench_breakdown.measure(config, env_params, options.steps, options.repeats)
    print(bench_breakdown.table(entries), end="\n\n")
    return {"breakdown": entries}


def memory() -> dict[str, Any]:
    """Print what the preset `paper` keeps in memory, and what this process held at most."""
    config = PRESETS["paper"]
    sizes = bench_train.memory(config, make_env(config.map, config.env))
    megabytes = {name: value / 1e6 for name, value in sizes.items() if name.endswith("bytes")}
    print(
        f"Preset paper: {megabytes['replay_bytes']:.0f} MB for a replay of "
        f"{sizes['replay_episodes']:,} episodes, {megabytes['run_bytes']:.0f} MB with those of a "
        f"round. This process held {megabytes['peak_process_bytes']:.0f} MB at most."
    )
    return {"memory": sizes}


def machine() -> dict[str, Any]:
    """What the numbers were taken on and with."""
    versions = {name: _version(name) for name in ("jax", "torch", "jaxmarl")}
    return {
        "command": " ".join(["experiments/benchmark.py", *sys.argv[1:]]),
        "device": devices.describe(),
        "cpu": devices.cpu_model(),
        "cpu_count": os.cpu_count(),
        "versions": {"sqn_jax": sqn_jax.__version__}
        | {name: version for name, version in versions.items() if version is not None},
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def parse() -> argparse.Namespace:
    """The options.

    Raises:
        ValueError: one of them is not positive.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--repeats", type=int, default=9, help="turns (default 9)")
    parser.add_argument("--maps", nargs="+", default=["maze", "cave"], help="of the simulator")
    parser.add_argument("--envs", nargs="+", type=int, default=[64, 256, 1024, 4096])
    parser.add_argument("--steps", type=int, default=100, help="of the simulator, in one call")
    parser.add_argument("--algos", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS))
    cores = sorted({1, os.cpu_count() or 1})
    parser.add_argument("--torch-threads", nargs="+", type=int, default=cores)
    parser.add_argument("--presets", nargs="+", choices=list(PRESETS), default=["quick"])
    parser.add_argument("--num-seeds", nargs="+", type=int, default=[1], help="of the presets")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    for name in ("steps", "repeats"):
        if getattr(options, name) < 1:
            raise ValueError(f"--{name} is {getattr(options, name)}, expected at least 1")
    for name in ("envs", "torch_threads", "num_seeds"):
        least = min(getattr(options, name))
        if least < 1:
            raise ValueError(f"--{name.replace('_', '-')} holds {least}, expected at least 1")
    return options


def main() -> None:
    """Parse the options, measure, write."""
    options = parse()
    devices.use_cores()
    measures = {
        "simulator": simulator,
        "learner": learner,
        "train": training,
        "breakdown": breakdown,
    }
    results = machine()
    for part in PARTS:
        if part in options.parts:
            results |= measures[part](options)
    results |= memory()
    if options.out is not None:
        write_json(options.out, results)


if __name__ == "__main__":
    run(main)
