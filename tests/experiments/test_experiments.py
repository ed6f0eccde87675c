"""The scripts of the paper's table and figure: what they write, and that they train only once."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import jax
import pytest

from experiments import bench_simulator, benchmark, common, robustness, table1
from sqn_jax.evaluation.settings import Settings

TOLD = {"mean": 0.5, "std": 0.5, "ci95": [0.4, 0.6], "std_of_means": 0.025}
STEPS = {"mean": 250.0, "std": 9.0, "ci95": [240.0, 260.0], "std_of_means": 4.0}


def entry(agent: str, name: str, radius: float) -> dict[str, Any]:
    return {
        **{"agent": agent, "algorithm": agent, "map": name, "goal_radius": radius},
        **{"tasks": "evaluation points", "velocity_noise": 0.0, "range_noise": 0.0},
        **{"training_seeds": [0], "success": TOLD, "time_steps": STEPS, "spl": TOLD},
        **{"time_steps_success": None, "collisions": STEPS, "mean_reward": TOLD},
    }


def test_the_table_sets_our_numbers_beside_the_paper_s() -> None:
    results = [
        entry(agent, name, radius)
        for agent in ("sqn", "oracle")
        for name in ("maze", "cave")
        for radius in (0.3, 0.5)
    ]
    header, _, sqn, oracle = table1.paper_table(results).splitlines()
    assert [cell.strip() for cell in header.split("|")[2:4]] == ["maze", "cave"]
    assert "0.50 ± 0.03, 250.0 ± 4.0 (paper 0.98, 181.1)" in sqn
    assert "(paper 0.82, 767.5)" in sqn
    assert "paper" not in oracle
    once = entry("sqn", "maze", 0.3) | {"success": {**TOLD, "std_of_means": None}}
    assert "| 0.50, 250.0 ± 4.0 (paper" in table1.paper_table([once])
    page = table1.report({"results": results, "comparisons": []}, Settings(maps=("maze", "cave")))
    assert "goal radius 0.3 m" in page
    assert "success 0.5 m" in page


def call(main: Any, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["script", *words])
    common.run(main)


@pytest.mark.long
def test_both_scripts_at_a_tiny_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--preset", "smoke", "--algos", "sqn", "dqn", "--num-seeds", "2", "--episodes", "3"]
    words += ["--eval-seeds", "2", "--runs", str(tmp_path / "runs")]
    call(table1.main, [*words, "--maps", "maze", "column"], monkeypatch)
    results = json.loads((tmp_path / "runs" / "table1.json").read_text())
    assert len(results["results"]) == 4 * 2 * 2  # Agents with the references, maps, radii.
    assert {(told["first"], told["second"]) for told in results["comparisons"]} == {
        ("sqn", "dqn"),
        ("dqn", "sqn"),
    }
    assert "paper" in (tmp_path / "runs" / "table1.md").read_text()
    assert (tmp_path / "runs" / "learning_curves.png").stat().st_size > 10_000
    capsys.readouterr()
    call(robustness.main, words, monkeypatch)
    assert capsys.readouterr().out.count("is trained") == 2
    results = json.loads((tmp_path / "runs" / "robustness.json").read_text())
    assert len(results["results"]) == 2 * 7 * 2  # Agents, noises, radii.
    assert (tmp_path / "runs" / "robustness.png").stat().st_size > 10_000


def test_the_benchmark_times_every_simulator_and_writes_what_it_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["--parts", "simulator", "--maps", "maze", "--envs", "2", "3", "--steps", "4"]
    words += ["--repeats", "3", "--out", str(tmp_path / "speed.json")]
    with jax.numpy_rank_promotion("allow"):  # JaxNav, where it is installed, relies on it.
        call(benchmark.main, words, monkeypatch)
    found = json.loads((tmp_path / "speed.json").read_text())
    assert found["command"] == " ".join(["experiments/benchmark.py", *words])
    assert "learner" not in found
    assert found["cpu"]
    ours = [entry for entry in found["simulator"] if entry["program"] == "sqn_jax, maze"]
    assert [entry["num_envs"] for entry in ours] == [2, 3]
    divided = "sqn_jax, maze, 2 devices"  # Three robots cannot be.
    both = [entry for entry in found["simulator"] if entry["program"] == divided]
    assert [entry["num_envs"] for entry in both] == [2]
    printed = capfd.readouterr().out
    for entry in ours:
        assert 0 < entry["slowest"] <= entry["steps_per_second"] <= entry["fastest"]
        assert f"{entry['steps_per_second']:,}" in printed
    # 401 observations of 71 bytes and 2 x 2, 400 actions, rewards and ends of 6, a priority of 4.
    assert found["memory"]["replay_bytes"] == 10_000 * (401 * 75 + 400 * 6 + 4) + 12
    assert "10,000 episodes" in printed
    has_jaxnav = "jaxmarl" in found["versions"]
    assert ("jaxmarl is not installed" in printed) is not has_jaxnav
    assert any(entry["program"] == "JaxNav" for entry in found["simulator"]) is has_jaxnav


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["--steps", "0"], "--steps is 0"),
        (["--envs", "64", "0"], "--envs holds 0"),
        (["--torch-threads", "-1"], "--torch-threads holds -1"),
    ],
)
def test_a_benchmark_of_nothing_is_refused(
    words: list[str],
    fault: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as stopped:
        call(benchmark.main, words, monkeypatch)
    assert stopped.value.code == 2
    assert fault in capsys.readouterr().err


def test_a_benchmark_is_told_in_times_of_jaxnav_at_its_best_with_as_many_robots() -> None:
    entries = [
        {"program": "sqn_jax, maze", "num_envs": 64, "steps_per_second": 300_000},
        {"program": "sqn_jax, maze", "num_envs": 256, "steps_per_second": 500_000},
        {"program": "JaxNav", "num_envs": 64, "steps_per_second": 40_000},
        {"program": "JaxNav, 2 devices", "num_envs": 64, "steps_per_second": 50_000},
    ]
    rows = bench_simulator.table(entries).splitlines()[2:]
    assert [row.split("|")[-2].strip() for row in rows] == ["6.0", "-", "0.8", "1.0"]


def test_the_seeds_of_an_agent_are_trained_side_by_side_in_one_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = []
    monkeypatch.setattr(
        common, "train_unless_done", lambda config, folder: trained.append((config, folder))
    )
    for num_seeds in ("3", "1"):
        parser = argparse.ArgumentParser()
        common.add_options(parser)
        words = ["--algos", "sqn", "dqn", "--num-seeds", num_seeds, "--runs", str(tmp_path)]
        common.train_missing(parser.parse_args(words))
    expected = [("sqn", 3), ("dqn", 3), ("sqn", 1), ("dqn", 1)]
    assert [(config.algo, config.num_seeds) for config, _ in trained] == expected
    names = ["sqn_seeds0to2", "dqn_seeds0to2", "sqn_seed0", "dqn_seed0"]
    assert [folder.name for _, folder in trained] == names
    assert {config.seed for config, _ in trained} == {0}


def test_runs_with_other_settings_are_not_taken_for_these(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "sqn_seed0"
    folder.mkdir()
    from sqn_jax.config import save
    from sqn_jax.config.presets import PRESETS

    save(PRESETS["paper"], folder / "config.json")
    with pytest.raises(SystemExit) as stopped:
        call(table1.main, ["--preset", "smoke", "--runs", str(tmp_path)], monkeypatch)
    assert stopped.value.code == 2
    told = capsys.readouterr().err
    assert "holds a run with other settings" in told
    assert told.count("\n") == 1
