"""The benchmark of the adapters: what it prints and writes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from rooms import write_empty_room

from experiments import bench_adapters, common


def call(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["bench_adapters.py", *arguments])
    common.run(bench_adapters.main)


def test_a_speed_stands_beside_that_of_the_bare_program() -> None:
    entries = [
        {"program": "a", "num_envs": 256, "steps_per_second": 412_345, "of_bare": 0.825},
        {"program": "b", "num_envs": 1, "steps_per_second": 3_000, "of_bare": None},
    ]
    rows = bench_adapters.table(entries).splitlines()[2:]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert cells == [["a", "256", "412,345", "0.82"], ["b", "1", "3,000", "-"]]


def test_a_benchmark_of_nothing_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        call(["--envs", "0"], monkeypatch)
    assert stopped.value.code == 2
    assert capsys.readouterr().err.endswith("--envs is 0, expected at least 1\n")


@pytest.mark.long
def test_every_adapter_is_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "adapters.json"
    arguments = ["--map", str(write_empty_room(tmp_path)), "--envs", "2", "--steps", "3"]
    call([*arguments, "--repeats", "1", "--out", str(out)], monkeypatch)
    entries = {entry["program"]: entry for entry in json.loads(out.read_text())["adapters"]}
    assert len([name for name in entries if name.startswith("gymnasium vector")]) == 4
    assert entries["bare, one scan"]["of_bare"] == 1
    assert entries["gymnasium, one env"]["num_envs"] == 1
    assert all(entry["steps_per_second"] > 0 for entry in entries.values())
