"""A run folder: what a training run leaves on disk, and how it is read back.

config.json      every setting
metrics.jsonl    one object a chunk
checkpoints/     the state of the run
evaluation.json  statistics of the final evaluation; evaluation.jsonl has every episode
figures/*.png    learning curve, trajectories
summary.json     what it came to

The folder may come from somebody else: nothing in it is read or written through a link.
"""

from __future__ import annotations

import json
import os
import shlex
import stat
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.outside.messages import named
from sqn_jax.outside.reading import kind_of, read_json
from sqn_jax.storage import metrics
from sqn_jax.storage.files import (
    NotWritten,
    append,
    flush_folder,
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

MAX_JSON_BYTES = 2**20
"""Size of config.json and summary.json at most; they have a few kilobytes."""

_MISREAD = "\\*?["
"""Characters that the libraries for checkpoints take for separators or patterns, and then lose or
mix up files without a word."""

_FOLDERS = (CHECKPOINTS, "figures", "tensorboard")
_FILES = (
    *(CONFIG, METRICS, SUMMARY, "evaluation.json", "evaluation.jsonl"),
    *("divergence.json", ".lock"),
)


def require_usable(path: Path) -> None:
    """Refuse a run folder before anything is read of it or written to it.

    The folder itself may be a symbolic link, what a run keeps in it may not.

    Raises:
        ValueError: its path holds what the libraries for checkpoints misread, or what cannot be
            printed; or a file of the run is none of its own.
    """
    place = path.absolute()
    odd = [letter for letter in str(place) if letter in _MISREAD or not letter.isprintable()]
    odd += [part for part in place.parts if part.endswith(":")]
    if odd:
        raise ValueError(
            f"run folder {named(path)}: its path holds {odd[0]!r}, expected one without any "
            f"of {_MISREAD}, without a colon at the end of a name, and with nothing that cannot be "
            "printed"
        )
    try:
        for name in _FILES:
            _require_kind(path / name, stat.S_IFREG, path)
        for name in _FOLDERS:
            if _require_kind(path / name, stat.S_IFDIR, path):
                for entry in _tree(path / name):
                    _require_kind(entry, stat.S_IFREG, path)
    except OSError as error:
        raise ValueError(f"run folder {path}: cannot be read ({error.strerror})") from None


def _require_kind(entry: Path, kind: int, run_dir: Path) -> bool:
    """Whether there is an entry; refuse it where it is of another kind."""
    try:
        mode = entry.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return False
    if stat.S_IFMT(mode) != kind:
        name = entry.relative_to(run_dir)
        actual = "a file" if stat.S_ISREG(mode) else kind_of(mode)
        wanted = "a folder" if kind == stat.S_IFDIR else "a file"
        raise ValueError(f"run folder {run_dir}: {name} is {actual}, expected {wanted} of its own")
    return True


def _tree(folder: Path) -> Iterator[Path]:
    """Everything in a folder and those below it but folders."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                yield from _tree(Path(entry.path))
            else:
                yield Path(entry.path)


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
        require_usable(path)
        if (path / CONFIG).exists():
            raise ValueError(
                f"run folder {path}: already holds a run; continue it with "
                f"`{resume_command(path)}`, or name another folder"
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
        require_usable(path)
        if not os.path.lexists(path / CONFIG):
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
        append(self.path / METRICS, metrics.to_text([without_nan(row)]))

    def flush_metrics(self) -> None:
        """Let the rows so far survive a power cut."""
        append(self.path / METRICS, "", flush=True)
        flush_folder(self.path)

    def read_metrics(self) -> list[dict[str, Any]]:
        """The rows of metrics.jsonl; a half-written last line is left out.

        Raises:
            ValueError: the file was edited or damaged; the message names the line.
        """
        rows, fault = metrics.read_rows(self.path / METRICS)
        if fault is not None:
            raise ValueError(fault)
        return rows

    def read_summary(self) -> dict[str, Any]:
        """The contents of summary.json; empty for a run that is not finished.

        Raises:
            ValueError: it cannot be read, or is no object.
        """
        path = self.path / SUMMARY
        if not os.path.lexists(path):
            return {}
        summary = read_json(path, MAX_JSON_BYTES, "a summary", follow=False)
        if not isinstance(summary, dict):
            raise ValueError(f"{path}: holds {type(summary).__name__}, expected an object")
        return summary

    def train_seconds(self) -> float:
        """How long the run has trained, by its last row; 0 where none says so."""
        rows, _ = metrics.read_rows(self.path / METRICS)
        return float(rows[-1].get("wall_seconds") or 0.0) if rows else 0.0

    def rows_of(self, chunks: int, config: TrainConfig) -> list[dict[str, Any]]:
        """The rows of the chunks that a checkpoint has behind it; those after it are left out.

        What a power cut has damaged lies after the checkpoint: rows are on the disk before it.

        Raises:
            ValueError: the file was edited or damaged; the message names the line.
        """
        path = self.path / METRICS
        rows, fault = metrics.read_rows(path)
        if len(rows) < chunks:
            raise ValueError(
                fault
                or f"{path}: line {len(rows) + 1} is missing, expected the rows of the {chunks} "
                "chunks that the checkpoint has behind it"
            )
        if fault is not None:
            warnings.warn(f"{fault}; left out with all after chunk {chunks}", stacklevel=2)
        episodes = config.rounds_per_chunk * config.num_envs
        if rows[:chunks] and rows[0].get("episodes") != episodes:
            raise ValueError(
                f"{path}: line 1 is damaged: 'episodes' is {rows[0].get('episodes')}, expected "
                f"{episodes}"
            )
        return rows[:chunks]

    def write_metrics(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Write metrics.jsonl as a whole or not at all."""
        write_whole(self.path / METRICS, metrics.to_text(list(rows)))

    def sweep(self) -> None:
        """Delete what a killed process has left of unfinished files."""
        for folder in (self.path, self.figures):
            for path in folder.glob(".*.partial*"):
                with suppress(OSError):
                    path.unlink()

    def write_json(self, name: str, data: Mapping[str, Any]) -> None:
        """Write a JSON file of the folder as a whole or not at all."""
        write_json(self.path / name, data)

    def write_records(self, name: str, records: Iterable[Mapping[str, Any]]) -> None:
        """Write a JSON lines file of the folder as a whole or not at all."""
        write_records(self.path / name, records)


def resume_command(run_dir: Path, options: str = "") -> str:
    """The command that resumes a run, as one types it into a shell."""
    name = shlex.quote(str(run_dir))
    # What begins with a dash would be taken for an option.
    return f"sqn train --run-dir{'=' if name.startswith('-') else ' '}{name} --resume{options}"
