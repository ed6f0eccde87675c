"""One run folder, one process that writes to it."""

from __future__ import annotations

import fcntl
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sqn_jax.outside.messages import say
from sqn_jax.outside.reading import open_regular, read_at_most

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
        file = open_regular(run_dir / NAME, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        where = f"{NAME} " if (run_dir / NAME).is_symlink() else ""
        raise ValueError(
            f"run folder {run_dir}: {where}cannot be written ({error.strerror})"
        ) from None
    try:
        _take(file, run_dir)
        left = os.read(file, 200).decode(errors="replace").strip()
        if left:
            say(f"{left}, did not end in order", error=True)
        _note(file, f"process {os.getpid()} on {platform.node()}, started {time.ctime()}")
        try:
            yield
        finally:
            _note(file, "")
    finally:
        os.close(file)


def owner(run_dir: Path) -> str:
    """What the process that trains in a folder has noted; "" where there is none."""
    try:
        return read_at_most(run_dir / NAME, 200, "a lock", follow=False).decode(errors="replace")
    except (OSError, ValueError):
        return ""


def _take(file: int, run_dir: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = os.read(file, 200).decode(errors="replace").strip() or "another process"
        raise ValueError(
            f"run folder {run_dir}: in use by {owner}; stop that one first, or name another folder"
        ) from None
    except OSError as error:  # Some network file systems have none.
        say(
            f"run folder {run_dir}: cannot be locked ({error.strerror}); "
            "let no second process train in it",
            error=True,
        )


def _note(file: int, text: str) -> None:
    """Say in the file who has it; on a full disk nobody does."""
    with suppress(OSError):
        os.ftruncate(file, 0)
        os.pwrite(file, text.encode(), 0)
