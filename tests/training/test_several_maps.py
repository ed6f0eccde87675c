"""A run on several maps at once: trained on all, evaluated on the first."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from rooms import write_empty_room
from tiny_runs import TinyRuns

from sqn_jax.cli import main


def test_a_run_on_two_rooms_is_evaluated_on_the_first_and_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other").mkdir()
    runs = TinyRuns(tmp_path, chunks=2)
    second = write_empty_room(tmp_path / "other").rename(tmp_path / "other" / "second.yaml")
    first = runs.options["map"]
    monkeypatch.chdir(tmp_path)
    runs.options["map"] = "room.yaml*3,other/second.yaml"
    code, out, err = runs.call("both")
    assert code == 0, err
    config = json.loads((tmp_path / "both" / "config.json").read_text())
    assert config["map"] == f"{first}*3,{second}"  # Findable from elsewhere.
    results = json.loads((tmp_path / "both" / "evaluation.json").read_text())["results"]
    assert {entry["map"] for entry in results} == {"room"}
    monkeypatch.chdir("/")
    code, out, err = runs.call("both", "--total-episodes", "12", resume=True)
    assert code == 0, err
    assert "resuming after 2 of 3 chunks" in out
    capsys.readouterr()
    words = ["--episodes", "1", "--eval-seeds", "1", "--no-baselines", "--max-steps", "12"]
    assert main(["evaluate", str(tmp_path / "both"), "--maps", f"{first},{second}", *words]) == 0
    told = capsys.readouterr().out
    assert "room" in told
    assert "second" in told
    assert main(["render", str(tmp_path / "both"), "--map", f"{first},{second}"]) == 2
    assert "several, expected one" in capsys.readouterr().err
