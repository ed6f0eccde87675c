"""A run folder: what a training run leaves on disk, and how it is read back.

config.json      every setting
metrics.jsonl    one object a chunk
checkpoints/     the state of the run
evaluation.json  statistics of the final evaluation; evaluation.jsonl has every episode
figures/*.png    learning curve, trajectories
summary.json     what it came to
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.storage.files import (
    NotWritten,
    flush_to_disk,
    probe_writable,
    without_nan,
    write_json,
    write_records,
    write_whole,
)

CONFIG = "config.json"
METRICS = "metrics.jsonl"
SUMMARY = "summary.json"
CHECKPOINTS = "checkpoints"
OWN_NAMES = ("config", "evaluation", "metrics", "summary")
"""Names of a run's own files, whatever they end in."""


class RunFolder:
    """Paths and files of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.figures = path / "figures"

    @classmethod
    def create(cls, path: Path, config: TrainConfig) -> RunFolder:
        """Make a folder for a new run and write its config.

        Raises:
            ValueError: the folder already holds a run, or cannot be written.
        """
        folder = cls(path)
        if (path / CONFIG).exists():
            raise ValueError(
                f"run folder {path}: already holds a run; continue it with "
                f"`sqn train --run-dir {path} --resume`, or name another folder"
            )
        left = [name for name in (METRICS, CHECKPOINTS) if os.path.lexists(path / name)]
        if left:
            raise ValueError(
                f"run folder {path}: holds {left[0]} of a run without its {CONFIG}, expected "
                "another folder"
            )
        try:
            path.mkdir(parents=True, exist_ok=True)
            probe_writable(path)
            folder.write_config(config)
        except NotWritten as error:
            raise ValueError(f"run folder {path}: {error}") from None
        except OSError as error:
            raise ValueError(f"run folder {path}: cannot be written ({error.strerror})") from None
        return folder

    @classmethod
    def open(cls, path: Path) -> tuple[RunFolder, TrainConfig]:
        """Open the folder of an earlier run.

        Raises:
            ValueError: it is no run folder, or its config is unusable.
        """
        if not (path / CONFIG).is_file():
            raise ValueError(f"run folder {path}: holds no run, expected a {CONFIG} in it")
        return cls(path), configs.load(path / CONFIG)

    def write_config(self, config: TrainConfig) -> None:
        """Write config.json as a whole or not at all."""
        write_whole(self.path / CONFIG, json.dumps(configs.to_dict(config), indent=2) + "\n")

    def unfinish(self) -> None:
        """Remove the mark that the run is finished: it is resumed."""
        (self.path / SUMMARY).unlink(missing_ok=True)

    def append_metrics(self, row: Mapping[str, Any]) -> None:
        """Add one line to metrics.jsonl; NaN becomes null.

        Raises:
            NotWritten: the disk is full, say.
        """
        line = json.dumps(without_nan(row), allow_nan=False) + "\n"
        try:
            with (self.path / METRICS).open("a", encoding="utf-8") as file:
                file.write(line)
        except OSError as error:
            raise NotWritten(self.path / METRICS, error) from None

    def flush_metrics(self) -> None:
        """Let the rows so far survive a power cut."""
        try:
            with (self.path / METRICS).open("a", encoding="utf-8") as file:
                flush_to_disk(file.fileno())
        except OSError as error:
            raise NotWritten(self.path / METRICS, error) from None

    def read_metrics(self) -> list[dict[str, Any]]:
        """The rows of metrics.jsonl; a half-written last line is left out.

        Raises:
            ValueError: another line is damaged.
        """
        path = self.path / METRICS
        rows = []
        lines = path.read_bytes().splitlines() if path.is_file() else []
        for number, line in enumerate(lines, start=1):
            try:
                row = json.loads(line.decode("utf-8"))
            except (ValueError, RecursionError):
                if number == len(lines):
                    break
                row = None
            if not isinstance(row, dict) or not isinstance(row.get("chunk"), int):
                raise ValueError(
                    f"{path}: line {number} is damaged, expected an object with a chunk number"
                )
            rows.append(row)
        return rows

    def train_seconds(self) -> float:
        """How long the run has trained, by its last row; 0 where none says so."""
        rows = self.read_metrics()
        return float(rows[-1].get("wall_seconds") or 0.0) if rows else 0.0

    def keep_metrics(self, chunks: int) -> None:
        """Drop the rows past `chunks` chunks, which a resumed run will write again."""
        path = self.path / METRICS
        if path.exists() and not path.is_file():
            raise ValueError(f"{path}: expected a file")
        rows = [row for row in self.read_metrics() if row["chunk"] <= chunks]
        write_whole(self.path / METRICS, "".join(json.dumps(row) + "\n" for row in rows))

    def write_json(self, name: str, data: Mapping[str, Any]) -> None:
        """Write a JSON file of the folder as a whole or not at all."""
        write_json(self.path / name, data)

    def write_records(self, name: str, records: Iterable[Mapping[str, Any]]) -> None:
        """Write a JSON lines file of the folder as a whole or not at all."""
        write_records(self.path / name, records)
