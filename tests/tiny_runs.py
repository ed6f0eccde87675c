"""Whole runs of a few seconds that save after every chunk, in this process or their own."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

from compiling import compiling_quickly
from rooms import write_empty_room

from sqn_jax.cli import main

TIMES = ("wall_seconds", "steps_per_second")


class TinyRuns:
    """One setting, whose programs are compiled once for all runs."""

    def __init__(self, folder: Path, *, chunks: int, method: str = "pqn", **more: str) -> None:
        self.folder = folder
        self.chunks = chunks
        self.options = {
            "preset": "smoke",
            "method": method,
            "map": str(write_empty_room(folder)),
            "network.hidden-size": "8",
            "env.max-steps": "12",
            "learner.window-length": "6",
            "learner.batch-size": "4",
            "num-envs": "4",
            "total-episodes": str(4 * chunks),
            "rounds-per-chunk": "1",
            "checkpoint-minutes": "1e-6",
            "eval.episodes": "2",
            "eval.curve-points": "5",
            "num-devices": "1",
            **{name.replace("__", ".").replace("_", "-"): value for name, value in more.items()},
        }
        self.environment = {
            **os.environ,
            "SQN_JAX_CACHE": str(folder / "cache"),
            "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        }

    def arguments(self, run: str, *more: str, resume: bool = False) -> list[str]:
        """The command line of a new run or of one to go on with."""
        arguments = ["--run-dir", str(self.folder / run)]
        if resume:
            arguments += ["--resume", "--num-devices", "1"]
        else:
            for name, value in self.options.items():
                arguments += [f"--{name}", value] if value else [f"--{name}"]
        arguments += more
        return ["train", *arguments]

    def start(self, run: str, *more: str, resume: bool = False) -> subprocess.Popen[str]:
        """Start a process, which keeps its compiled programs for the others."""
        return subprocess.Popen(
            [sys.executable, "-m", "sqn_jax", *self.arguments(run, *more, resume=resume)],
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def call(self, run: str, *more: str, resume: bool = False) -> tuple[int, str, str]:
        """Run to the end in this process, with the programs kept: exit code, stdout, stderr."""
        out, err = io.StringIO(), io.StringIO()
        with (
            patch.dict(os.environ, SQN_JAX_CACHE=self.environment["SQN_JAX_CACHE"]),
            redirect_stdout(out),
            redirect_stderr(err),
            warnings.catch_warnings(),
            compiling_quickly(),
        ):
            warnings.simplefilter("always")
            code = main(self.arguments(run, *more, resume=resume))
        return code, out.getvalue(), err.getvalue()

    def finish(self, run: str, *more: str, resume: bool = False) -> str:
        """Run to the end in a process of its own; what it said."""
        with self.start(run, *more, resume=resume) as process:
            out, err = process.communicate(timeout=600)
        assert process.returncode == 0, err
        assert "Traceback" not in err
        return out + err

    def rows(self, run: str) -> list[dict[str, Any]]:
        """Its metrics without times."""
        text = (self.folder / run / "metrics.jsonl").read_text()
        rows = [json.loads(line) for line in text.splitlines()]
        return [{name: row[name] for name in row if name not in TIMES} for row in rows]

    def saved(self, run: str) -> list[int]:
        """The chunks it has checkpoints of."""
        folder = self.folder / run / "checkpoints"
        names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
        return sorted(int(name) for name in names if name.isdigit())

    def digests(self, run: str, chunk: int | None = None) -> dict[str, str]:
        """SHA-256 of every array of its state at a chunk, by default at the last."""
        step = self.folder / run / "checkpoints" / str(chunk or self.chunks)
        leaves = json.loads((step / "manifest.json").read_text())["contents"]["leaves"]
        return {path: leaf["sha256"] for path, leaf in leaves.items()}

    def assert_equal(self, run: str, other: str) -> None:
        """State, metrics and evaluation, to the bit."""
        assert self.digests(run) == self.digests(other)
        assert self.rows(run) == self.rows(other)
        assert [row["chunk"] for row in self.rows(run)] == list(range(1, self.chunks + 1))
        for name in ("evaluation.json", "evaluation.jsonl"):
            texts = [(self.folder / label / name).read_text() for label in (run, other)]
            assert texts[0].replace(run, "RUN") == texts[1].replace(other, "RUN")


def wait_for(condition: Callable[[], Any], seconds: float = 120) -> Any:
    """Ask until it holds; what it returned."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if result := condition():
            return result
        time.sleep(0.005)
    raise AssertionError("waited in vain")
