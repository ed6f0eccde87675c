"""What does not fit is refused before anything is allocated, with the settings to turn."""

from __future__ import annotations

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from sqn_jax.agent.program import Program
from sqn_jax.cli import main
from sqn_jax.config.presets import PRESETS
from sqn_jax.evaluation.agents import with_baselines
from sqn_jax.evaluation.compare import load_maps, memory_bytes
from sqn_jax.evaluation.settings import Settings
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.runs.final_evaluation import require_memory
from sqn_jax.training import devices, memory_budget


def test_what_does_not_fit_is_refused_with_the_settings_that_decide(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(memory_budget, "available_bytes", lambda: 2e9)
    memory_budget.require(1.9e9, "training", "pqn")
    with pytest.raises(ValueError, match=r"training would take 2\.1 GB, but 2\.0 GB are free"):
        memory_budget.require(2.1e9, "training", "pqn")
    with pytest.raises(ValueError, match=r"lower one of --replay\.capacity, --num-envs"):
        memory_budget.require(2.1e9, "training", "r2d2")
    monkeypatch.setattr(memory_budget, "available_bytes", lambda: None)
    memory_budget.require(1e18, "training", "r2d2")


def test_a_replay_of_terabytes_is_refused_by_the_command_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, started = tmp_path / "run", time.monotonic()
    words = ["--preset", "paper", "--replay.capacity", "1000000000", "--run-dir", str(run)]
    assert main(["train", *words]) == 2
    told = capsys.readouterr().err
    # 10^9 of 32.5 kB.
    assert told.startswith("sqn: keeping its episodes would take 32,479.0 GB, but ")
    assert "--replay.capacity" in told
    assert told.count("\n") == 1
    assert not run.exists()
    assert time.monotonic() - started < 60


def test_what_is_free_is_of_the_size_of_a_machine() -> None:
    free = memory_budget.available_bytes()
    assert free is None or 1e7 < free < 1e14


def test_a_program_takes_its_arguments_results_and_what_is_in_between() -> None:
    def program(x: jax.Array) -> jax.Array:
        return jnp.sort(jnp.outer(x, x), axis=0) @ x

    compiled = jax.jit(program).lower(jnp.ones(1000)).compile()
    # A million numbers in between, twice at most; 8 kB in and out.
    assert 4e6 <= memory_budget.compiled_bytes(compiled) <= 3 * 4e6


def test_a_device_that_is_not_there_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for command in (["train"], ["evaluate", "pretrained:sqn"], ["render", "pretrained:sqn"]):
        for kind in ("gpu", "tpu"):
            assert main([*command, "--device", kind]) == 2
            told = capsys.readouterr().err
            assert told == f"sqn: --device is {kind}, expected one that JAX finds here: cpu\n"
    devices.require("cpu")


def test_a_gpu_that_jax_cannot_use_is_worth_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(devices, "_has_nvidia", lambda: True)
    devices.require(None)  # The tests have set JAX_PLATFORMS: whoever does that knows.
    assert capsys.readouterr().err == ""
    monkeypatch.delenv("JAX_PLATFORMS")
    devices.require("cpu")
    assert capsys.readouterr().err == ""
    devices.require(None)
    told = capsys.readouterr().err
    assert "running on the CPU" in told
    assert told.count("\n") == 1


def test_programs_are_given_back_before_a_process_has_too_many_mappings(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    cleared: list[bool] = []
    monkeypatch.setattr(memory_budget.jax, "clear_caches", lambda: cleared.append(True))
    monkeypatch.setattr(memory_budget, "MAPPINGS", tmp_path / "maps")
    memory_budget.bound_programs()  # Not Linux.
    for lines, expected in ((20_000, []), (20_001, [True])):
        (tmp_path / "maps").write_text("7f00-7f01 r-xp\n" * lines)
        memory_budget.bound_programs()
        assert cleared == expected


def test_an_evaluation_that_does_not_fit_is_refused_before_it_or_its_run_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    agents = with_baselines([], baselines=True)
    settings = Settings(maps=("maze",), episodes=1_000, max_steps=50)
    program = Program(PRESETS["paper"], 400, 5)
    # Both agents under 5 seeds for 2 radii, 1 kB each; x, y and heading of 50 steps twice, for the
    # 2,000 episodes that are there at once.
    expected = 2 * 5 * 1_000 * 2 * 1_000 + 2 * 50 * 2_000 * 3 * 4
    assert memory_bytes(agents, load_maps(agents, settings), settings) == expected
    monkeypatch.setattr(memory_budget, "available_bytes", lambda: expected - 1.0)
    with pytest.raises(ValueError, match=r"keeping the episodes .* lower one of --episodes, "):
        evaluate_session(agents, settings)
    # Pose, 5 values, 2 weights and 10 values of skills in 400 steps, four times.
    monkeypatch.setattr(memory_budget, "available_bytes", lambda: 100 * 400 * 4 * 20 * 4.0 - 1)
    with pytest.raises(ValueError, match=r"the final evaluation .* lower one of --eval.episodes, "):
        require_memory(program)
    monkeypatch.setattr(memory_budget, "available_bytes", lambda: 100 * 400 * 4 * 20 * 4.0)
    require_memory(program)
