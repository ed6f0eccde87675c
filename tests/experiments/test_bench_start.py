"""The breakdown of a start: a command ends its process at once, and is measured all the same."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_the_parts_of_a_command_add_up_to_its_time(tmp_path: Path) -> None:
    out = tmp_path / "start.json"
    command = ["map", "check", str(ROOT / "maps" / "column.yaml")]
    script = str(ROOT / "experiments" / "bench_start.py")
    options = ["--repeats", "1", "--only", "cold", "--out", str(out)]
    done = subprocess.run(
        [sys.executable, script, *options, *command], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    record = json.loads(out.read_text(encoding="utf-8"))
    assert record["command"] == command
    cold = record["cold"]
    assert set(record) == {"command", "cold"}
    assert {"import", "other", "start and end of Python"} <= set(cold["seconds"])
    assert sum(cold["seconds"].values()) == pytest.approx(cold["whole"], abs=0.1)
    assert 0 < cold["seconds"]["import"] < cold["whole"]
