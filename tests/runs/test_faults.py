"""Runs that are killed, stopped, cut off from the disk or sent astray: nothing is lost or wrong.

The undisturbed run is the oracle: what was disturbed and resumed must end in the same bits.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from compiling import compiling_quickly
from tiny_runs import TinyRuns, wait_for

from sqn_jax.env import make_env
from sqn_jax.evaluation.episodes import episode_keys, run_episodes
from sqn_jax.maps import load_map
from sqn_jax.policies.run_policies import load_policy
from sqn_jax.runs import streams, train
from sqn_jax.runs.learning_curve import METRICS
from sqn_jax.storage.run_folder import RunFolder
from sqn_jax.training.state import network_of


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> TinyRuns:
    """Ten chunks, and `straight`, which nothing disturbs."""
    runs = TinyRuns(tmp_path_factory.mktemp("tiny"), chunks=10)
    code, _, err = runs.call("straight")
    assert code == 0, err
    return runs


# Kill -9.


def kill_at_random_times(runs: TinyRuns, kills: int, seed: int) -> list[int]:
    """Start, kill -9, resume, kill -9 ...; returns what each resumption had to go on from."""
    rng = random.Random(seed)
    found, started = [], time.monotonic()
    with runs.start("killed") as process:  # How long until the first is saved, on this machine.
        wait_for(lambda: runs.saved("killed"))
        ready = time.monotonic() - started
        process.kill()
    found.append(max(runs.saved("killed")))
    while len(found) < kills:
        with runs.start("killed", resume=True) as process:
            time.sleep(rng.uniform(0.2, 1.3) * ready)
            is_over = process.poll() is not None
            process.kill()
        assert not is_over, "the run is too short for as many kills"
        found.append(max(runs.saved("killed")))
    return found


def assert_kills_leave_no_trace(runs: TinyRuns, kills: int, seed: int) -> None:
    runs.finish("straight", "--checkpoint-minutes", "10")
    found = kill_at_random_times(runs, kills, seed)
    told = runs.finish("killed", resume=True)
    assert "resuming after" in told
    assert "damaged" not in told
    assert found == sorted(found)  # Nothing saved is ever lost again.
    runs.assert_equal("killed", "straight")
    assert not list((runs.folder / "killed" / "checkpoints").glob(".*"))


def test_a_run_killed_twice_while_it_saves_ends_in_the_same_bits(tiny: TinyRuns) -> None:
    """Once is not enough: the second time there is something to go on from."""
    rng = random.Random(1)
    for saved in (2, 6):
        with tiny.start("killed", resume=saved > 2) as process:
            wait_for(lambda saved=saved: max(tiny.saved("killed"), default=0) >= saved)
            time.sleep(rng.uniform(0.0, 0.3))
            process.kill()
    code, out, err = tiny.call("killed", resume=True)
    assert code == 0, err
    assert "resuming after" in out
    assert "damaged" not in err
    tiny.assert_equal("killed", "straight")
    assert not list((tiny.folder / "killed" / "checkpoints").glob(".*"))


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("method", ["pqn", "r2d2"])
def test_a_run_killed_thirty_times_ends_in_the_same_bits(tmp_path: Path, method: str) -> None:
    more = {"replay__capacity": "16", "replay__min_episodes": "8", "updates_per_round": "2"}
    runs = TinyRuns(tmp_path, chunks=200, method=method, **more)
    assert_kills_leave_no_trace(runs, kills=30, seed=2)


# Signals. One that comes in a chunk is in test_cli.py.


def assert_stopped(runs: TinyRuns, run: str, number: int, code: int, err: str) -> None:
    assert code == 128 + number, err
    assert f"sqn: stopped by {signal.Signals(number).name} after saving" in err
    assert go_on(runs, run) in err
    assert "Traceback" not in err
    assert not (runs.folder / run / "summary.json").exists()


def go_on(runs: TinyRuns, run: str) -> str:
    return f"resume with `sqn train --run-dir {runs.folder / run} --resume --num-devices 1`"


def end_at_once(process: subprocess.Popen[str], upon: str, number: signal.Signals) -> str:
    """Send a signal once a process has said something; returns what it had said until then."""
    assert process.stdout is not None
    out = ""
    while not out.endswith(upon):
        out += process.stdout.read(1)
    process.send_signal(number)
    sent = time.monotonic()
    _, err = process.communicate(timeout=100)
    assert time.monotonic() - sent < 5
    assert process.returncode == -number  # 128 + number, as a shell sees it.
    assert "Traceback" not in err
    return out


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_a_signal_in_compilation_ends_a_run_that_starts_again_from_the_beginning(
    tiny: TinyRuns, number: signal.Signals
) -> None:
    run = f"compiling{number}"
    with tiny.start(run) as process:
        out = end_at_once(process, "compiling ...", number)
    assert f"if it is stopped, {go_on(tiny, run)}\n" in out
    assert tiny.saved(run) == []
    code, out, err = tiny.call(run, resume=True)
    assert code == 0, err
    assert "starting from the beginning" in out
    tiny.assert_equal(run, "straight")


def test_a_signal_in_the_evaluation_leaves_a_trained_run_to_be_evaluated(tiny: TinyRuns) -> None:
    with tiny.start("evaluating") as process:
        wait_for(lambda: max(tiny.saved("evaluating"), default=0) == tiny.chunks)
        time.sleep(0.3)  # It closes its bar.
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=100)
    assert process.returncode == -signal.SIGTERM, err
    assert go_on(tiny, "evaluating") in out
    assert "Traceback" not in err
    assert not (tiny.folder / "evaluating" / "summary.json").exists()
    code, out, err = tiny.call("evaluating", resume=True)
    assert code == 0, err
    assert "compil" not in out  # There is nothing to train.
    tiny.assert_equal("evaluating", "straight")


@pytest.mark.long
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_a_random_time_and_a_resumed_run_is_the_same(
    tmp_path: Path, number: signal.Signals
) -> None:
    """Ten of each, over the whole of a start: imports, map, compilation, chunks, evaluation."""
    runs, rng = TinyRuns(tmp_path, chunks=10), random.Random(number)
    started = time.monotonic()
    runs.finish("straight")
    whole = time.monotonic() - started
    for index in range(10):
        run = f"run{index}"
        with runs.start(run) as process:
            time.sleep(rng.uniform(0.2, 1.0) * whole)
            process.send_signal(number)
            _, err = process.communicate(timeout=100)
        assert process.returncode in (0, -number, 128 + number), err  # -n: where nothing is lost.
        assert "Traceback" not in err or not (runs.folder / run / "config.json").exists()
        if (runs.folder / run / "config.json").exists():
            runs.finish(run, resume=True)
            runs.assert_equal(run, "straight")


def stop_after(runs: TinyRuns, run: str, chunks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a new run stop as if it had been asked to."""
    row = train._row

    def signalled(report: Any, *rest: Any) -> Any:
        if report.chunk == chunks:
            os.kill(os.getpid(), signal.SIGTERM)
        return row(report, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(train, "_row", signalled)
        code, _, err = runs.call(run)
    assert_stopped(runs, run, signal.SIGTERM, code, err)
    assert runs.saved(run) == [chunks - 1, chunks]


def test_a_reader_that_leaves_stops_a_run_as_a_closed_terminal_does(
    tiny: TinyRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunks = []
    with monkeypatch.context() as patch:
        patch.setattr(streams, "reader_left", lambda: chunks.append(None) or len(chunks) == 3)
        code, _, err = tiny.call("unread")
    assert code == 128 + signal.SIGPIPE
    assert "stopped by SIGPIPE after saving, resume with `sqn train" in err
    assert tiny.saved("unread")[-1] == 3
    code, _, err = tiny.call("unread", resume=True)
    assert code == 0, err
    tiny.assert_equal("unread", "straight")


def test_a_run_goes_on_where_its_map_lies_now_if_it_is_the_same(tiny: TinyRuns) -> None:
    for name in ("moved", "moved_map"):
        shutil.rmtree(tiny.folder / name, ignore_errors=True)
    shutil.copytree(tiny.folder / "straight", tiny.folder / "moved")
    config_file = tiny.folder / "moved" / "config.json"
    original = Path(json.loads(config_file.read_text())["map"])
    config_file.write_text(config_file.read_text().replace(original.name, f"no_{original.name}"))
    code, _, err = tiny.call("moved", resume=True)
    assert code == 2
    assert f"no_{original.name}: not found" in err
    assert "--map" in err
    code, _, err = tiny.call("moved", "--map", "maze", resume=True)
    assert code == 2
    assert "--map maze: differs in map.cells" in err
    assert err.count("\n") == 1
    moved = shutil.copytree(original.parent, tiny.folder / "moved_map", ignore=only_maps)
    code, _, err = tiny.call("moved", "--map", str(moved / original.name), resume=True)
    assert code == 0, err
    assert json.loads(config_file.read_text())["map"] == str(moved / original.name)
    tiny.assert_equal("moved", "straight")


def only_maps(folder: str, names: list[str]) -> list[str]:
    """What of the folder is no file of a map."""
    return [name for name in names if not name.endswith((".yaml", ".pgm", ".png"))]


# Disks.


@contextmanager
def files_no_larger_than(size: int) -> Iterator[None]:
    """What writes beyond it fails, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_ends_a_run_in_one_line_and_costs_no_more_than_the_last_chunk(
    tiny: TinyRuns, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Of the three limits, one strikes the manifest, one Orbax's files, one the metrics."""
    stop_after(tiny, "full", 4, monkeypatch)
    digests = tiny.digests("full", 4)
    metrics = (tiny.folder / "full" / "metrics.jsonl").read_bytes()
    largest = max(file.stat().st_size for file in (tiny.folder / "full").rglob("d/*"))
    limits = {20_000: "checkpoints/5", len(metrics) + 10: "metrics.jsonl"}
    assert largest < 20_000
    for limit, fault in limits.items():
        with files_no_larger_than(limit):
            code, _, err = tiny.call("full", resume=True)
        (line,) = [line for line in err.splitlines() if line.startswith("sqn: ")]
        assert code == 1, err
        assert fault in line
        assert "cannot be written (File too large)" in line
        assert "Traceback" not in err + capfd.readouterr().err
        assert tiny.saved("full") == [3, 4]
        assert tiny.digests("full", 4) == digests
    code, _, err = tiny.call("full", resume=True)
    assert code == 0, err
    tiny.assert_equal("full", "straight")


def test_a_damaged_newest_checkpoint_costs_a_warning_and_its_chunk(
    tiny: TinyRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop_after(tiny, "rotten", 6, monkeypatch)
    step = tiny.folder / "rotten" / "checkpoints" / "6"
    (step / "rest" / "manifest.ocdbt").unlink()
    code, out, err = tiny.call("rotten", resume=True)
    assert code == 0, err
    assert "resuming after 5 of 10 chunks" in out
    assert (
        f"sqn: warning: checkpoint {step}: damaged, rest/manifest.ocdbt is missing; "
        "going on from chunk 5\n"
    ) in err
    tiny.assert_equal("rotten", "straight")


# The learning curve.


def test_a_run_trains_to_the_same_bits_whether_or_not_it_is_evaluated_on_the_way(
    tiny: TinyRuns,
) -> None:
    code, out, err = tiny.call("unseen", "--eval.curve-points", "0")
    assert code == 0, err
    assert "learning curve" not in out
    assert tiny.digests("unseen") == tiny.digests("straight")
    for own, other in zip(tiny.rows("unseen"), tiny.rows("straight"), strict=True):
        assert {name for name in own if own[name] != other[name]} <= set(METRICS)
        has_point = other["chunk"] % 2 == 0  # Five points in ten chunks.
        assert all((other[name] is None) != has_point for name in METRICS)
        assert all(own[name] is None for name in METRICS)


def test_a_point_of_the_curve_is_the_greedy_policy_that_is_shipped_on_tasks_of_its_own(
    tiny: TinyRuns,
) -> None:
    """The last point, by the policy read from the folder and a mean over its steps."""
    config = RunFolder.open(tiny.folder / "straight")[1]
    policy = load_policy(tiny.folder / "straight")
    room = load_map(config.map, robot_radius=config.env.robot_radius)
    world = make_env(room, config.env, spawn="evaluation")
    keys = episode_keys(jax.random.fold_in(jax.random.key(1_000), 3), 8)
    with compiling_quickly():
        (metrics,), trajectory = run_episodes(
            keys, policy.params[0], world, network_of(config), fields=("poses", "goals", "rewards")
        )
    last = tiny.rows("straight")[-1]
    assert last["eval_mean_reward"] == pytest.approx(trajectory.rewards.mean(), rel=1e-5)
    assert last["eval_success"] == metrics.success.mean()
    assert last["eval_time_steps"] == metrics.time_steps.mean()
    places = np.concatenate([trajectory.poses[0, :, :2], trajectory.goals])
    distances = np.linalg.norm(places[:, None] - room.evaluation_points, axis=-1)
    assert distances.min(axis=1).max() <= room.spawn_radius + 1e-6
    summary = json.loads((tiny.folder / "straight" / "summary.json").read_text())
    assert summary["learning_curve"]["points"] == 5
    assert summary["learning_curve"]["mean_reward"] == last["eval_mean_reward"]
    assert summary["learning_curve"]["paper_mean_reward"] is None  # Not the maze.


# Settings.


def test_another_network_or_map_is_a_table_and_not_a_stack_trace(tiny: TinyRuns) -> None:
    config, room = tiny.folder / "straight" / "config.json", tiny.folder / "room.yaml"
    for file, then, now, difference in (
        (config, '"hidden_size": 8', '"hidden_size": 16', ["network.hidden_size", "8", "16"]),
        (config, '"seed": 0', '"seed": 7', ["seed", "0", "7"]),
        (room, "resolution: 0.1", "resolution: 0.2", ["map.resolution", "0.1", "0.2"]),
    ):
        whole = file.read_text()
        file.write_text(whole.replace(then, now, 1))
        try:
            code, _, err = tiny.call("straight", resume=True)
        finally:
            file.write_text(whole)
        assert code == 2
        first, header, *rows = err.splitlines()
        assert first.startswith("sqn: checkpoint ")
        assert first.endswith("not of this run as it is set up here")
        assert header.split() == ["checkpoint", "here"]
        assert difference in [row.split() for row in rows]
        assert len(rows) < 4


def test_two_processes_do_not_train_in_one_folder(tiny: TinyRuns) -> None:
    with tiny.start("shared") as process:
        wait_for((tiny.folder / "shared" / "config.json").exists)
        code, _, err = tiny.call("shared", resume=True)
        process.kill()
    assert code == 2
    assert f"in use by process {process.pid} on" in err
    assert err.count("\n") == 1


def test_a_finished_run_goes_on_when_it_is_given_more_episodes(tiny: TinyRuns) -> None:
    code, _, err = tiny.call("longer")
    assert code == 0, err
    code, out, err = tiny.call("longer", "--total-episodes", "48", resume=True)
    assert code == 0, err
    assert "resuming after 10 of 12 chunks" in out
    assert [row["episodes"] for row in tiny.rows("longer")] == list(range(4, 52, 4))
    assert tiny.rows("longer")[:10] == tiny.rows("straight")
    assert json.loads((tiny.folder / "longer" / "config.json").read_text())["total_episodes"] == 48
    assert json.loads((tiny.folder / "longer" / "summary.json").read_text())["episodes"] == 48
    assert tiny.digests("longer", 12) != tiny.digests("straight")
    for more, fault in (
        (("--total-episodes", "40"), "total_episodes is 40, expected at least the 48"),
        (("--num-envs", "8"), "--num-envs 8"),
    ):
        code, _, err = tiny.call("longer", *more, resume=True)
        assert code == 2
        assert fault in err
        assert err.count("\n") == 1


def test_a_run_without_its_replay_goes_on_and_says_it_is_not_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    more = {"replay__capacity": "16", "replay__min_episodes": "8", "updates_per_round": "1"}
    runs = TinyRuns(tmp_path, chunks=6, method="r2d2", **more)
    runs.options["no-checkpoint-replay"] = ""
    stop_after(runs, "light", 4, monkeypatch)
    assert not list((tmp_path / "light" / "checkpoints" / "4").glob("memory*"))
    code, out, err = runs.call("light", resume=True)
    assert code == 0, err
    assert "resuming with an empty one, not exactly as before" in out
    updates = [row["updates"] for row in runs.rows("light")]
    assert updates == [0, 1, 2, 3, 3, 4]  # The replay has to fill again.


# Learning gone astray.


def test_a_run_that_diverges_stops_with_a_dump_and_saves_nothing_of_it(tiny: TinyRuns) -> None:
    """A step so large that the next loss overflows: from then on every update is skipped."""
    runs = TinyRuns(tiny.folder, chunks=10, learner__learning_rate="1e30", max_skipped_updates="5")
    code, _, err = runs.call("astray")
    assert code == 1, err
    (line,) = [line for line in err.splitlines() if line.startswith("sqn: ")]
    assert "seed 0" in line
    assert "had a loss or gradient that is not finite, more than max_skipped_updates (5)" in line
    dump = json.loads((tiny.folder / "astray" / "divergence.json").read_text())
    skipped = [row["skipped_updates"] for row in runs.rows("astray")]
    assert skipped[-1] > 5
    assert skipped[-2] <= 5
    assert dump["chunk"] == len(skipped)
    assert dump["seeds"] == [0]
    worst, *_ = dump["arrays"].values()
    assert worst["largest"] > 1e29
    assert all(each["not_finite"] == 0 for each in dump["arrays"].values())
    assert max(runs.saved("astray")) == len(skipped) - 1


# Folders that lack something.


def test_a_run_whose_checkpoints_are_out_of_sight_does_not_start_again(
    tiny: TinyRuns, tmp_path: Path
) -> None:
    """A disk that is not mounted, say: its metrics would be gone."""
    shutil.copytree(tiny.folder / "straight", tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    metrics = (tmp_path / "run" / "metrics.jsonl").read_bytes()
    for odd in (True, False):
        if odd:
            (tmp_path / "run" / "checkpoints").symlink_to(tmp_path / "nowhere")
        else:
            (tmp_path / "run" / "checkpoints").unlink()
        code, _, err = tiny.call(str(tmp_path / "run"), "--total-episodes", "60", resume=True)
        assert code == 2
        fault = "checkpoints is a symbolic link" if odd else "holds no checkpoint that can be used"
        assert fault in err
        assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == metrics
        assert (tmp_path / "run" / "summary.json").exists()


def test_a_new_run_is_not_mixed_with_the_rest_of_an_old_one(tiny: TinyRuns, tmp_path: Path) -> None:
    shutil.copytree(tiny.folder / "straight", tmp_path / "run")
    (tmp_path / "run" / "config.json").unlink()
    code, _, err = tiny.call(str(tmp_path / "run"))
    assert code == 2
    assert "holds metrics.jsonl of a run without its config.json" in err
