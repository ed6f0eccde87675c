"""What a policy reaches with the sensors of a robot that is not the one it was trained on.

    .venv/bin/python experiments/deployment.py [--policy pretrained:best] [--out FILE.json]

A lidar that sees 270 degrees, or 3 m: the ranges change before the network sees them. What is not
seen can be filled in as free or as blocked; the record has both.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from experiments.common import RESULTS, run
from sqn_jax.agent.networks import Params, QNetwork, QOutput
from sqn_jax.config import EnvConfig, NetworkConfig
from sqn_jax.env import Observation, make_env
from sqn_jax.env.geometry import beam_angles
from sqn_jax.evaluation.episodes import episode_keys, run_seeds
from sqn_jax.evaluation.settings import SPAWN_MODES, Settings, robot_for, task_key
from sqn_jax.evaluation.statistics import wilson_interval
from sqn_jax.policies.greedy import load_policy
from sqn_jax.storage.files import probe_file, write_json
from sqn_jax.training.state import network_of


@dataclass(frozen=True)
class Sensor:
    """How a robot sees."""

    field_of_view_deg: float = 360.0
    """Beams farther aside read `unseen`."""
    unseen: float = 1.0
    """A fraction of the range that the policy was trained with: 1 is free, 0 is blocked."""
    max_range: float = 1e6
    """m; what is farther reads `beyond`."""
    beyond: float = 1.0
    """The same fraction."""


SENSORS = {
    "as trained": Sensor(),
    "270 degrees, the rest free": Sensor(270),
    "270 degrees, the rest blocked": Sensor(270, unseen=0.0),
    "180 degrees, the rest free": Sensor(180),
    "180 degrees, the rest blocked": Sensor(180, unseen=0.0),
    "3 m, free beyond": Sensor(max_range=3.0),
    "3 m, a wall there": Sensor(max_range=3.0, beyond=0.6),
    "2 m, free beyond": Sensor(max_range=2.0),
    "270 degrees and 3 m, the rest free": Sensor(270, max_range=3.0),
}
"""Of a policy with 5 m of range."""


@dataclass(frozen=True)
class SensorNetwork:
    """A network behind a sensor, which travels with the parameters: one program for all."""

    network: QNetwork

    @property
    def config(self) -> NetworkConfig:
        """Sizes of the network."""
        return self.network.config

    def apply(self, params: Params, obs: Observation, carry: Array) -> tuple[Array, QOutput]:
        """See `agent.networks`."""
        sensor = params["sensor"]
        expanded = {name: value[None, None] for name, value in sensor.items() if value.ndim}
        beyond = jnp.where(obs.ranges > sensor["limit"], sensor["beyond"], obs.ranges)
        ranges = jnp.where(expanded["seen"] > 0, beyond, sensor["unseen"])
        seen = dataclasses.replace(obs, ranges=ranges)
        result: Any = self.network.apply(params["network"], seen, carry)
        return cast(tuple[Array, QOutput], result)


def sensor_arrays(sensor: Sensor, env: EnvConfig) -> dict[str, np.ndarray]:
    """What `SensorNetwork` takes of a sensor."""
    half = np.radians(sensor.field_of_view_deg) / 2
    return {
        "seen": (np.abs(beam_angles(env)) <= half + 1e-6).astype(np.float32),
        "unseen": np.float32(sensor.unseen),
        "limit": np.float32(sensor.max_range / env.max_range),
        "beyond": np.float32(sensor.beyond),
    }


def measure(name: str, map_name: str, episodes: int, seeds: int) -> list[dict[str, Any]]:
    """Success with each sensor in each kind of tasks."""
    policy = load_policy(name)
    env = robot_for(policy.config.env, Settings(maps=(map_name,)))
    params = [
        {"network": policy.params, "sensor": sensor_arrays(sensor, env)}
        for sensor in SENSORS.values()
    ]
    stacked = jax.tree.map(lambda *x: np.stack(x), *params)
    network: Any = SensorNetwork(network_of(policy.config))
    results: list[dict[str, Any]] = []
    for tasks, spawn in SPAWN_MODES.items():
        world = make_env(map_name, env, spawn=spawn)
        keys = [episode_keys(task_key(1_000 + seed, tasks), episodes) for seed in range(seeds)]
        for label, found in zip(
            SENSORS, run_seeds(jnp.concatenate(keys), stacked, world, network), strict=True
        ):
            metrics = found.metrics[0]
            count = len(metrics.success)
            results.append(
                {
                    "sensor": label,
                    "tasks": tasks,
                    "episodes": count,
                    "success": float(np.mean(metrics.success)),
                    "ci95": wilson_interval(int(np.sum(metrics.success)), count),
                    "time_steps": float(np.mean(metrics.time_steps)),
                    "collisions": float(np.mean(metrics.collisions)),
                }
            )
            print(json.dumps(results[-1]), flush=True)
    return results


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--policy", default="pretrained:best")
    parser.add_argument("--map", default="maze")
    parser.add_argument("--episodes", type=int, default=100, help="under each evaluation seed")
    parser.add_argument("--eval-seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS / "deployment.json")
    options = parser.parse_args()
    for name in ("episodes", "eval_seeds"):
        if getattr(options, name) < 1:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} is {getattr(options, name)}, expected 1 or more")
    probe_file(options.out)
    results = measure(options.policy, options.map, options.episodes, options.eval_seeds)
    record = {
        "command": " ".join(["python experiments/deployment.py", *sys.argv[1:]]),
        "policy": options.policy,
        "map": options.map,
        "eval_seeds": options.eval_seeds,
        "goal_radius_m": 0.3,
        "results": results,
    }
    write_json(options.out, record)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    run(main)
