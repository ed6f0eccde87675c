"""One run folder, one process that writes to it."""

from __future__ import annotations

import fcntl
import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

NAME = ".lock"


@contextmanager
def locked(run_dir: Path) -> Iterator[None]:
    """Keep other processes from training in a folder, which is made where it is missing.

    The system drops the lock with its process, however that ends: what a killed one leaves behind
    is its name in the file, which does not keep anybody off.

    Raises:
        ValueError: another process has it, or the folder cannot be written.
    """
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        file = os.open(run_dir / NAME, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise ValueError(f"run folder {run_dir}: cannot be written ({error.strerror})") from None
    try:
        _take(file, run_dir)
        left = os.read(file, 200).decode(errors="replace").strip()
        if left:
            print(f"{left}, did not end in order", file=sys.stderr)
        _note(file, f"process {os.getpid()} on {platform.node()}, started {time.ctime()}")
        try:
            yield
        finally:
            _note(file, "")
    finally:
        os.close(file)


def _take(file: int, run_dir: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = os.read(file, 200).decode(errors="replace").strip() or "another process"
        raise ValueError(
            f"run folder {run_dir}: in use by {owner}; stop that one first, or name another folder"
        ) from None
    except OSError as error:  # Some network file systems have none.
        print(
            f"run folder {run_dir}: cannot be locked ({error.strerror}); "
            "let no second process train in it",
            file=sys.stderr,
        )


def _note(file: int, text: str) -> None:
    """Say in the file who has it; on a full disk nobody does."""
    with suppress(OSError):
        os.ftruncate(file, 0)
        os.pwrite(file, text.encode(), 0)
