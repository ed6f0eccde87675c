"""What a run came to is on the disk before anybody is told."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest

from sqn_jax.cli import main
from sqn_jax.config import TrainConfig
from sqn_jax.runs.final_evaluation import conclude
from sqn_jax.storage.run_folder import RunFolder

TIMING = {"train_seconds": 2.0, "env_steps": 300.0, "num_devices": 1, "compile_seconds": 1.0}
RESULTS = [
    {
        "tasks": "random pairs",
        "success": {"mean": 0.5, "ci95": [0.25, 0.75]},
        "time_steps": {"mean": 30.0},
    }
]


class ClosedPipe(io.StringIO):
    def write(self, _: str) -> int:
        raise BrokenPipeError


def test_the_summary_is_written_though_the_reader_has_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "run", TrainConfig())
    monkeypatch.setattr(sys, "stdout", ClosedPipe())
    with pytest.raises(BrokenPipeError):
        conclude(RESULTS, TIMING | {"compiled_earlier": False}, False, TrainConfig(), folder)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["random_pairs"] == {"success": 0.5, "time_steps": 30.0}
    assert summary["steps_per_second"] == 150


def test_a_process_without_standard_output_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    assert main(["--help"]) == 0
