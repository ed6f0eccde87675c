"""Runs in two processes on this machine: beside one process, stopped, killed, and resumed.

The run in one process is the oracle.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from tiny_runs import TinyRuns, wait_for

from sqn_jax.policies.run_policies import load_policy

DEVICES = 4


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port


def start(
    runs: TinyRuns,
    run: str,
    *more: str,
    count: int = 2,
    resume: bool = False,
    alter: Sequence[str] = (),
) -> list[subprocess.Popen[str]]:
    """Start the processes of a run, which have four devices together; `alter` is for the last."""
    arguments = runs.arguments(run, resume=resume)
    arguments += ["--num-devices", str(DEVICES), *more]
    environment = {**runs.environment, "JAX_NUM_CPU_DEVICES": str(DEVICES // count)}
    port, started = free_port(), []
    for process in range(count):
        place = ["--coordinator", f"127.0.0.1:{port}", "--num-processes", str(count)]
        place += ["--process-id", str(process)]
        place += alter if process == count - 1 else []
        started.append(
            subprocess.Popen(
                [sys.executable, "-m", "sqn_jax", *arguments, *(place if count > 1 else [])],
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    return started


def ended(processes: Sequence[subprocess.Popen[str]]) -> list[tuple[int, str, str]]:
    """Exit code, stdout and stderr of each."""
    try:
        texts = [process.communicate(timeout=300) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(p.returncode, *text) for p, text in zip(processes, texts, strict=True)]


def finish(runs: TinyRuns, run: str, *more: str, count: int = 2, resume: bool = False) -> str:
    """Run to the end; what the first process said. The others say nothing."""
    results = ended(start(runs, run, *more, count=count, resume=resume))
    assert [code for code, _, _ in results] == [0] * count, results
    assert all(text == "" for _, *others in results[1:] for text in others), results
    return results[0][1]


def assert_alike(runs: TinyRuns, run: str, other: str) -> None:
    """Metrics and episodes to the rounding of sums, and as many of them."""
    for ours, theirs in zip(runs.rows(run), runs.rows(other), strict=True):
        assert ours.keys() == theirs.keys()
        for name, value in ours.items():
            np.testing.assert_allclose(
                np.array(value, float), np.array(theirs[name], float), 1e-3, 1e-4, err_msg=name
            )
    texts = [(runs.folder / name / "evaluation.jsonl").read_text() for name in (run, other)]
    rewards = [[json.loads(line)["mean_reward"] for line in text.splitlines()] for text in texts]
    np.testing.assert_allclose(*rewards, atol=1e-4)
    ours, theirs = (load_policy(runs.folder / name).params for name in (run, other))
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-4), ours, theirs)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> TinyRuns:
    folder = tmp_path_factory.mktemp("tiny")
    return TinyRuns(folder, chunks=4, eval__curve_points="0", network__num_skills="2")


def test_two_processes_make_the_run_that_one_makes(tiny: TinyRuns) -> None:
    said = finish(tiny, "two")
    assert "x 4 in 2 processes" in said
    finish(tiny, "one", count=1)
    assert tiny.saved("two") == tiny.saved("one")
    assert_alike(tiny, "two", "one")


def stop(
    runs: TinyRuns, run: str, number: int, *, count: int = 2, victim: int = 0
) -> list[tuple[int, str, str]]:
    """Start or resume a run, and send a signal to one of its processes when it has saved."""
    before = max(runs.saved(run), default=0)
    processes = start(runs, run, count=count, resume=before > 0)
    try:
        wait_for(lambda: max(runs.saved(run), default=0) > before, seconds=300)
    finally:
        processes[victim].send_signal(number)
    return ended(processes)


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("num_seeds", ["1", "2"])
def test_a_checkpoint_of_two_processes_resumes_on_one_and_back(
    tmp_path: Path, num_seeds: str
) -> None:
    """With a replay, of which each process has a part; and seeds, of which each has one."""
    more = {"replay__capacity": "16", "replay__min_episodes": "8", "updates_per_round": "2"}
    runs = TinyRuns(tmp_path, chunks=10, method="r2d2", num_seeds=num_seeds, **more)
    finish(runs, "straight", count=1)
    for count in (2, 1):
        for code, _, err in stop(runs, "moved", signal.SIGTERM, count=count):
            assert code == 128 + signal.SIGTERM, err
            assert "sqn: stopped by SIGTERM after saving" in err
            assert "Traceback" not in err
    finish(runs, "moved", resume=True)
    assert_alike(runs, "moved", "straight")


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("victim", [0, 1])
def test_a_process_that_is_lost_ends_the_other_and_the_run_resumes(
    tmp_path: Path, victim: int
) -> None:
    runs = TinyRuns(tmp_path, chunks=30, eval__curve_points="0")
    finish(runs, "straight")
    results = stop(runs, "killed", signal.SIGKILL, victim=victim)
    assert results[victim][0] == -signal.SIGKILL
    code, _, err = results[1 - victim]
    assert code == 1, err
    (line,) = [line for line in err.splitlines() if line and "episodes [" not in line]
    assert line.startswith("sqn: another process of this run has ended or cannot be reached")
    finish(runs, "killed", resume=True)
    assert runs.digests("killed") == runs.digests("straight")
    assert runs.rows("killed") == runs.rows("straight")


@pytest.mark.long
@pytest.mark.timeout(600)
def test_processes_that_do_not_meet_or_agree_say_so_in_one_line(
    tiny: TinyRuns, tmp_path: Path
) -> None:
    alone, other = start(tiny, "alone", "--process-timeout", "5")
    other.kill()
    code, _, err = ended([alone, other])[0]
    assert (code, err.count("\n")) == (1, 1), err
    assert err.startswith("sqn: not all 2 processes have come to 127.0.0.1:")
    different = start(tiny, "different", alter=["--seed", "7"])
    for code, _, err in ended(different):
        assert (code, err) == (2, "sqn: process 1: seed is 7, expected 0 as in process 0\n")
    assert not (tiny.folder / "different").exists()
    elsewhere = start(tiny, "here", alter=["--run-dir", str(tmp_path / "there")])
    codes = [(code, err.count("\n")) for code, _, err in ended(elsewhere)]
    assert codes == [(2, 1), (2, 1)]


@pytest.mark.long
@pytest.mark.timeout(600)
def test_slurm_says_where_the_processes_are(tiny: TinyRuns) -> None:
    """They differ in their seeds, so that no run need be trained to see that they have met."""
    slurm = {"JOB_ID": os.getpid(), "STEP_NODELIST": "localhost", "NTASKS": 2}
    started = []
    for process in range(2):
        places = {**slurm, "PROCID": process, "LOCALID": process}
        started.append(
            subprocess.Popen(
                [
                    *(sys.executable, "-m", "sqn_jax", *tiny.arguments("slurm")),
                    *("--num-devices", "4", "--distributed", "auto", "--seed", str(process)),
                ],
                env={
                    **tiny.environment,
                    **{f"SLURM_{name}": str(value) for name, value in places.items()},
                    "JAX_NUM_CPU_DEVICES": "2",
                },
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    for code, _, err in ended(started):
        assert (code, err) == (2, "sqn: process 1: seed is 1, expected 0 as in process 0\n")
