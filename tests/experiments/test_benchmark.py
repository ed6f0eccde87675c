"""The benchmark's parts: everything is timed and told of, turns are fair."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from rooms import small_room

from experiments import (
    bench_breakdown,
    bench_learner,
    bench_simulator,
    bench_train,
    timing,
)
from sqn_jax.config import LearnerConfig, NetworkConfig, ReplayConfig, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import navigation
from sqn_jax.training import devices

SIZES = NetworkConfig(hidden_size=6, num_skills=3)
LEARNER = LearnerConfig(burn_in_length=3, n_step=2, discount=0.9, max_grad_norm=0.05)


def test_programs_take_turns() -> None:
    calls: list[tuple[str, int]] = []
    programs = {name: lambda turn, name=name: calls.append((name, turn)) for name in "ab"}
    timings = timing.time_in_turns(programs, 2)
    assert calls == [("a", 0), ("b", 0), ("a", 0), ("b", 0), ("a", 1), ("b", 1)]
    assert all(len(found.seconds) == 2 and min(found.seconds) > 0 for found in timings.values())


def test_rates_are_told_to_four_digits() -> None:
    found = timing.Timing(first_call=1.2345, seconds=(4.0, 0.5, 3.0))
    assert found.median == 3.0
    assert found.rates(2, unit="updates_per_second") == {
        "updates_per_second": 0.6667,
        "slowest": 0.5,
        "fastest": 4.0,
        "first_call_seconds": 1.23,
    }
    assert found.rates(370_000, unit="steps_per_second")["steps_per_second"] == 123_333


def tiny_config(**changes: Any) -> TrainConfig:
    """Two robots in a small room, two rounds a chunk."""
    preset = PRESETS["smoke"]
    return dataclasses.replace(
        preset,
        num_envs=2,
        network=NetworkConfig(hidden_size=4, layer_norm=True),
        learner=dataclasses.replace(preset.learner, batch_size=2, window_length=6),
        replay=ReplayConfig(capacity=6, min_episodes=6),
        **changes,
    )


@pytest.mark.long
def test_updates_and_robots_divided_between_devices_are_those_of_one() -> None:
    """From the same batches: the same priorities, and priorities tell the parameters."""
    config = dataclasses.replace(
        PRESETS["smoke"], network=SIZES, learner=dataclasses.replace(LEARNER, batch_size=4)
    )
    problem = bench_learner.make_problem(config, small_room(12), 3)
    with compiling_quickly():
        one, two = (bench_learner.drawn_program(problem, mesh)(0) for mesh in devices.one_and_all())
    assert one[0].shape == (3, 4)
    np.testing.assert_allclose(two[0], one[0], rtol=1e-3)
    mesh = devices.first_devices(2)

    def drive(key: jax.Array, world: jax.Array, num_envs: int) -> jax.Array:
        return jax.random.uniform(key, (7, num_envs)) + world

    alone, both = (
        bench_simulator.program(drive, jnp.float32(5), 6, chosen)(1) for chosen in (None, mesh)
    )
    assert alone.shape == both.shape == (7, 6)
    assert len(np.unique(both)) == 42, "each device has chance of its own"
    assert 5 <= both.min() <= both.max() < 6


def is_sane(entry: dict[str, Any], unit: str) -> bool:
    return 0 < entry["slowest"] <= entry[unit] <= entry["fastest"]


@pytest.mark.parametrize(
    "agents", [("dqn",), pytest.param(("sqn", "dqn"), marks=pytest.mark.long)], ids=" and ".join
)
def test_the_learner_is_timed_for_every_agent_and_program(agents: tuple[Any, ...]) -> None:
    threads = () if bench_learner.missing_torch() or "sqn" not in agents else (1, 2)
    config = dataclasses.replace(PRESETS["smoke"], network=SIZES)
    learner = dataclasses.replace(config.learner, batch_size=2, learning_rate=3e-4)
    with compiling_quickly():
        told = bench_learner.measure(
            dataclasses.replace(config, num_envs=2, learner=learner),
            small_room(12),
            agents,
            3,
            torch_threads=threads,
            num_updates=2,
            product_size=16,
        )
    found = {(entry["algo"], entry["program"]): entry for entry in told["updates"]}
    theirs = [f"PyTorch, {'1 thread' if count == 1 else f'{count} threads'}" for count in threads]
    ours, places = ("JAX", "JAX, with sampling"), ("", ", 2 devices")
    assert set(found) == {
        *((algo, what + where) for algo in agents for what in ours for where in places),
        *(("sqn", program) for program in theirs),
    }
    best = max(told["products_gflops"].values())
    for entry in found.values():
        assert is_sane(entry, "updates_per_second")
        assert (entry["batch_size"], entry["num_steps"]) == (2, 12)
        rate = entry["updates_per_second"]
        np.testing.assert_allclose(entry["milliseconds"], 1e3 / rate, rtol=1e-2)
        np.testing.assert_allclose(entry["gflops"], entry["operations"] * rate / 1e9, rtol=1e-2)
        np.testing.assert_allclose(entry["share_of_products"], entry["gflops"] / best, rtol=1e-2)
    operations = [found[algo, "JAX"]["operations"] for algo in agents]
    assert operations == sorted(set(operations), reverse=True)
    if threads:
        assert told["torch_td_error_difference"] < 1e-4


@pytest.mark.long
def test_the_pieces_of_a_step_add_up_to_the_step_itself() -> None:
    """Not in time, which is noisy, but in what they do: each leaves the robot where a step does."""
    room = small_room(12)
    start, action_key = jax.random.split(jax.random.key(3))
    _, state = navigation.reset(start, room)
    pieces = {name: jax.jit(piece) for name, piece in bench_breakdown.PIECES.items()}
    for action in jax.random.randint(action_key, (12,), 0, 5):
        ends = {name: piece(state, action, room) for name, piece in pieces.items()}
        state, (obs, _) = ends["whole step"]
        for name in ("motion", "motion, rays", "motion, rays, coverage"):
            np.testing.assert_allclose(ends[name][0].pose, state.pose, atol=1e-6)
        drawn, (ranges, _) = ends["motion, rays, coverage"]
        np.testing.assert_array_equal(drawn.covered, state.covered)
        np.testing.assert_allclose(ends["motion, rays"][1] / 5.0, obs.ranges, atol=1e-6)
        np.testing.assert_allclose(ranges / 5.0, obs.ranges, atol=1e-6)


@pytest.mark.long
def test_the_breakdown_tells_of_every_piece_and_of_both_halves_of_a_window() -> None:
    config = dataclasses.replace(PRESETS["smoke"], network=SIZES, num_envs=8)
    with compiling_quickly():
        entries = bench_breakdown.measure(config, small_room(30), 5, 2)
    assert [entry["piece"] for entry in entries] == [
        *bench_breakdown.PIECES,
        *("roll out a window", "learn from a window"),
    ]
    for entry in entries:
        assert 0 < entry["fastest"] <= entry["microseconds"] <= entry["slowest"]
    assert len(bench_breakdown.table(entries).splitlines()) == 2 + len(entries)


def test_pytorch_at_its_best_is_what_the_learner_is_told_in_times_of() -> None:
    def entry(algo: str, program: str, milliseconds: float) -> dict[str, Any]:
        told = {"algo": algo, "program": program, "milliseconds": milliseconds}
        return told | {
            "updates_per_second": 1e3 / milliseconds,
            "operations": 5e10,
            "gflops": 90.0,
            "share_of_products": 0.31,
        }

    entries = [
        entry("sqn", "JAX", 400.0),
        entry("sqn", "PyTorch, 1 thread", 600.0),
        entry("sqn", "PyTorch, 2 threads", 500.0),
        entry("dqn", "JAX", 300.0),
    ]
    rows = bench_learner.table({"updates": entries}).splitlines()[2:]
    assert [row.split("|")[-2].strip() for row in rows] == ["1.25", "0.83", "1.00", "-"]


def test_without_pytorch_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_learner.importlib.util, "find_spec", lambda name: None)
    told = bench_learner.missing_torch()
    assert told is not None
    assert "torch is not installed" in told
    assert "\n" not in told


@pytest.mark.parametrize(
    ("method", "num_seeds"), [("pqn", 2), pytest.param("r2d2", 1, marks=pytest.mark.long)]
)
def test_training_is_timed_with_rollouts_and_updates(method: Any, num_seeds: int) -> None:
    config = tiny_config(method=method, num_seeds=num_seeds)
    with compiling_quickly():
        entry = bench_train.measure(config, small_room(12), 3)
    assert entry["steps_per_chunk"] == num_seeds * 2 * 2 * 12  # Rounds, robots, steps.
    assert is_sane(entry, "steps_per_second")
    assert entry["compile_seconds"] > 0
    # A round makes 4 updates by r2d2, and by pqn one for each of its two windows.
    updates = {"r2d2": 2 * 4, "pqn": num_seeds * 2 * 2}[method]
    seconds = entry["steps_per_chunk"] / entry["steps_per_second"]
    np.testing.assert_allclose(entry["updates_per_second"] * seconds, updates, rtol=1e-2)
    # The whole run in calls of two rounds.
    calls = config.total_episodes / (2 * config.num_envs)
    np.testing.assert_allclose(entry["run_seconds"] / calls, seconds, rtol=1e-2)
    row = bench_train.table([{"preset": "tiny", **entry}]).splitlines()[-1]
    assert f"{entry['steps_per_second']:,}" in row


def test_memory_is_that_of_the_replay_and_of_a_round() -> None:
    env_params = small_room(12)
    # An episode: 13 observations of 71 + 2 x 2 bytes, 12 steps of 1 + 4 + 1, a priority of 4.
    told = bench_train.memory(tiny_config(method="r2d2"), env_params)
    assert told["replay_episodes"] == 6
    assert told["replay_bytes"] == 6 * (13 * 75 + 12 * 6 + 4) + 12
    assert told["run_bytes"] > told["replay_bytes"]
    told = bench_train.memory(tiny_config(), env_params)
    assert (told["replay_episodes"], told["replay_bytes"]) == (0, 0)


def test_the_peak_of_memory_is_told_in_bytes() -> None:
    status = Path("/proc/self/status")
    if not status.is_file():
        pytest.skip("the system does not tell")
    lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
    peak = int(lines["VmHWM"].split()[0]) * 1024
    np.testing.assert_allclose(bench_train.peak_bytes(), peak, rtol=0.05)
