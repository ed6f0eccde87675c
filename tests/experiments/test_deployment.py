"""Sensors between a policy and the simulator, beside arithmetic by hand."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import common, deployment
from experiments.deployment import SENSORS, Sensor, SensorNetwork, sensor_arrays
from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, Observation
from sqn_jax.policies.pretrained import find_policy

BEAMS = EnvConfig(num_beams=5, field_of_view_deg=320, max_range=5)  # -160, -80, 0, 80, 160 degrees.
RANGES = (0.2, 1.0, 0.6, 0.61, 0.9)


def seen(sensor: Sensor) -> list[float]:
    """What the network gets of RANGES."""
    echo = SimpleNamespace(config=None, apply=lambda params, obs, carry: (carry, obs.ranges))
    network: Any = SensorNetwork(echo)  # type: ignore[arg-type]
    params = {"network": None, "sensor": sensor_arrays(sensor, BEAMS)}
    obs = Observation(ranges=jnp.float32(RANGES)[None, None], goal=jnp.zeros((1, 1, 2)))
    _, ranges = network.apply(params, obs, None)
    return np.asarray(ranges)[0, 0].tolist()


@pytest.mark.parametrize(
    ("sensor", "expected"),
    [
        (Sensor(), RANGES),
        (Sensor(270), (1.0, 1.0, 0.6, 0.61, 1.0)),
        (Sensor(270, unseen=0.0), (0.0, 1.0, 0.6, 0.61, 0.0)),
        (Sensor(160), (1.0, 1.0, 0.6, 0.61, 1.0)),
        (Sensor(max_range=3.0), (0.2, 1.0, 0.6, 1.0, 1.0)),
        (Sensor(max_range=3.0, beyond=0.6), (0.2, 0.6, 0.6, 0.6, 0.6)),
        (Sensor(159, max_range=3.0), (1.0, 1.0, 0.6, 1.0, 1.0)),
    ],
)
def test_a_sensor_changes_what_it_does_not_see(sensor: Sensor, expected: tuple[float]) -> None:
    assert seen(sensor) == pytest.approx(expected)


def test_one_of_the_sensors_is_that_of_the_training() -> None:
    assert seen(SENSORS["as trained"]) == pytest.approx(RANGES)


def test_tasks_are_those_of_an_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """In training 0.3 of the tasks of `pretrained:best` have a near goal."""
    worlds = []

    def kept(keys: Any, params: Any, world: EnvParams, network: Any) -> list[Any]:
        worlds.append(world)
        one = np.ones(1)
        metrics = SimpleNamespace(success=one, time_steps=one, collisions=one)
        return [SimpleNamespace(metrics=[metrics])]

    monkeypatch.setattr(deployment, "run_seeds", kept)
    monkeypatch.setattr(deployment, "SENSORS", {"as trained": Sensor()})
    deployment.measure("pretrained:best", "maze", 1, 1)
    assert [float(world.near_goal_fraction) for world in worlds] == [0.0, 0.0]
    assert find_policy("pretrained:best").config.env.near_goal_fraction > 0


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["--policy", "pretrained:none"], "pretrained:none"),
        (["--map", "nowhere"], "nowhere"),
        (["--episodes", "0"], "--episodes is 0, expected 1 or more"),
        (["--out", "nowhere/a.json"], "nowhere/a.json"),
    ],
)
def test_what_is_unusable_is_a_line(
    words: list[str],
    fault: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """And nothing is written: the default of --out is the record itself."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(common, "end_at_once", lambda: None)
    monkeypatch.setattr(sys, "argv", ["deployment.py", "--out", "found.json", *words])
    with pytest.raises(SystemExit) as stopped:
        common.run(deployment.main)
    assert stopped.value.code == 2
    told = capsys.readouterr().err
    assert fault in told
    assert told.count("\n") == 1
    assert not (tmp_path / "found.json").exists()
