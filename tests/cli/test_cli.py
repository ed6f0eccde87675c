"""The command line as a user meets it: exit codes, one clear line, and what a run leaves behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sqn_jax.cli import main
from sqn_jax.runs import train
from sqn_jax.storage.run_folder import RunFolder

TINY = ["--preset", "smoke", "--env.max-steps", "30", "--eval.episodes", "4"]


def refused(capsys: pytest.CaptureFixture[str], words: list[str]) -> str:
    """The one line that a refused command prints."""
    assert main(words) == 2
    told = capsys.readouterr().err
    assert told.startswith("sqn: ")
    assert told.count("\n") == 1, told
    assert "Traceback" not in told
    return told


def test_the_overview_loads_no_jax() -> None:
    """A second and a half, which every `sqn --help` would wait."""
    code = (
        "import sys, sqn_jax.cli; code = sqn_jax.cli.main(['--help']);"
        "sys.exit(code or 'jax' in sys.modules or 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, stdout=subprocess.PIPE)
    assert done.returncode == 0
    assert b"sqn train" in done.stdout


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["frobnicate"], ["frobnicate", "train", "map"]),
        (["train", "--preset", "fast"], ["--preset", "fast", "quick"]),
        (["train", "--bogus", "3"], ["--bogus"]),
        (["train", "--num-seeds", "0"], ["num_seeds", "0", "at least 1"]),
        (["train", "--learner.n-step", "0"], ["learner.n_step", "0", "at least 1"]),
        (["train", "--learner.learning-rate", "abc"], ["--learner.learning-rate", "abc"]),
        (["train", "--env.max-range", "-1"], ["env.max_range", "-1", "positive"]),
        (["train", "--algo", "ppo"], ["algo", "ppo", "sqn"]),
        (["train", "--resume"], ["--resume", "--run-dir"]),
        (["train", "--run-dir", ""], ["--run-dir", "empty"]),
        (["map", "check"], ["file"]),
        (["map", "check", "nowhere"], ["nowhere", "maze"]),
        (["map", "check", "maze:0-3", "--picture", "x.png"], ["--picture x.png", "4 maps"]),
        (["map", "check", "maze", "--picture", "x.jpg"], ["--picture x.jpg", ".png"]),
    ],
)
def test_wrong_words_are_named_in_one_line(
    capsys: pytest.CaptureFixture[str], words: list[str], names: list[str]
) -> None:
    told = refused(capsys, words)
    for name in names:
        assert name in told, (name, told)


def test_a_map_is_drawn_where_one_asks_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "new" / "map.png"
    assert main(["map", "check", "maze", "--picture", str(path)]) == 0
    assert capsys.readouterr().out.endswith(f"wrote {path}\n")
    with Image.open(path) as image:
        assert image.width == 1440
        image.verify()


@pytest.mark.parametrize("command", ["", "train", "evaluate", "map check"])
def test_help_into_a_pipe_that_closes_early_ends_without_a_traceback(command: str) -> None:
    program = [sys.executable, "-m", "sqn_jax", *command.split(), "--help"]
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed:
        done = subprocess.run(program, stdout=closed, stderr=subprocess.PIPE, text=True, timeout=90)
    assert done.returncode in (0, 1)
    assert done.stderr == ""


def test_an_unusable_run_leaves_nothing_behind(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    in_a_file = tmp_path / "file"
    in_a_file.touch()
    assert "run folder" in refused(capsys, ["train", *TINY, "--run-dir", str(in_a_file / "run")])
    run = tmp_path / "run"
    window = ["--learner.window-length", "7"]
    assert "window_length" in refused(capsys, ["train", *TINY, *window, "--run-dir", str(run)])
    assert "nowhere" in refused(capsys, ["train", "--map", "nowhere", "--run-dir", str(run)])
    assert "holds no run" in refused(capsys, ["train", "--resume", "--run-dir", str(run)])
    assert not run.exists()


def test_the_report_on_a_map_states_its_size_and_distances(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["map", "check", "maze"]) == 0
    told = capsys.readouterr().out
    assert "17.00 x 17.00 m" in told
    assert "340 x 340" in told


def metrics_of(run: Path) -> list[dict[str, Any]]:
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    for row in rows:
        del row["wall_seconds"], row["steps_per_second"]
    return rows


def test_a_run_stopped_by_a_signal_and_resumed_equals_one_never_stopped(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    assert main(["train", *TINY, "--tensorboard", "--run-dir", str(straight)]) == 0
    told = capsys.readouterr().out
    assert "evaluation points:" in told
    assert "random pairs:" in told

    row = train._row

    def row_and_signal(*arguments: Any) -> dict[str, Any]:
        os.kill(os.getpid(), signal.SIGTERM)
        return row(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(train, "_row", row_and_signal)
        assert main(["train", *TINY, "--run-dir", str(broken)]) == 128 + signal.SIGTERM
    assert "--resume" in capsys.readouterr().err
    assert len(metrics_of(broken)) == 1
    assert not (broken / "summary.json").exists()

    # A row written after the last checkpoint is dropped, not doubled.
    rows = (broken / "metrics.jsonl").read_text().splitlines()
    with (broken / "metrics.jsonl").open("a") as file:
        first = json.loads(rows[0])
        counted = {name: 2 * first[name] for name in ("chunk", "episodes", "env_steps")}
        second = {**first, **counted, "wall_seconds": 0.0}
        file.write(json.dumps(second) + "\n")
    assert main(["train", "--resume", "--run-dir", str(broken)]) == 0
    assert metrics_of(broken) == metrics_of(straight)
    assert [row["chunk"] for row in metrics_of(broken)] == [1, 2]
    for run in (straight, broken):  # Of the whole run, whatever of it was before the resumption.
        last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])
        told_by = json.loads((run / "summary.json").read_text())
        rate = 64 * 30 / last["wall_seconds"]
        assert told_by["steps_per_second"] == pytest.approx(rate, rel=0.1)
    evaluations = [json.loads((run / "evaluation.json").read_text()) for run in (straight, broken)]
    assert evaluations[0] == evaluations[1]
    capsys.readouterr()
    assert "already holds a run" in refused(capsys, ["train", "--run-dir", str(straight)])

    summary = json.loads((straight / "summary.json").read_text())
    records = [
        json.loads(line) for line in (straight / "evaluation.jsonl").read_text().splitlines()
    ]
    assert len(records) == 2 * 4
    for tasks in ("evaluation points", "random pairs"):
        reached = [record["success"] for record in records if record["tasks"] == tasks]
        assert summary[tasks.replace(" ", "_")]["success"] == np.mean(reached)
    (board,) = (straight / "tensorboard").iterdir()
    for tag in (b"mean_reward", b"trajectories_evaluation_points", b"learning_curve"):
        assert tag in board.read_bytes()
    drawn = sorted(path.name for path in (straight / "figures").iterdir())
    assert drawn == [
        "learning_curve.png",
        "trajectories_evaluation_points.png",
        "trajectories_random_pairs.png",
    ]


def test_a_damaged_line_of_metrics_is_named_and_a_half_written_last_one_left_out(
    tmp_path: Path,
) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'{"chunk": 1}\n{"chunk": 2}\n{"chu')
    assert RunFolder(tmp_path).read_metrics() == [{"chunk": 1}, {"chunk": 2}]
    for damaged in (b'{"chu', b"\xff\xfe", b"3", b"[1, 2]", b"null", b'{"chunk": "x"}'):
        path.write_bytes(b'{"chunk": 1}\n' + damaged + b'\n{"chunk": 3}\n')
        with pytest.raises(ValueError, match=r"metrics\.jsonl: line 2 is damaged"):
            RunFolder(tmp_path).read_metrics()
