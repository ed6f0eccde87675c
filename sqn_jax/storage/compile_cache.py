"""Compiled programs cached on disk, so that the next start reads them instead of compiling.

JAX does the keeping (its persistent compilation cache). What is read is executed: the folder is
private, and one that others can write to is not used. Whoever imports the library gets no cache.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache
from tqdm import tqdm

from sqn_jax.outside.messages import say, shown
from sqn_jax.outside.reading import read_at_most
from sqn_jax.storage.files import probe_writable

VARIABLE = "SQN_JAX_CACHE"
"""Environment variable: a folder to use instead of the user's own, or `off`."""

LARGEST_BYTES = 2**28
"""What the folder may hold when a run starts; all programs of a run take a few MB."""

LARGEST_ARRAYS = 2**26
"""What the arrays beside the programs may take (`cached_arrays`)."""

ARRAYS = "arrays-"
"""How the names of files with arrays begin."""

ENTRY = "-cache"
"""How JAX's files end; a checksum lies beside each."""

SEAL = "-sha256"
"""How the names of the checksums end."""

_SEAL_NAME = re.compile(rf"-[0-9a-f]{{64}}{SEAL}$")

LEFTOVER_AGE = 3600.0
"""After how many seconds an unfinished file was left by a process that was killed."""

_TROUBLE = re.compile(
    r"Error (reading|writing) persistent compilation cache entry for '([^']*)': (.*)", re.DOTALL
)
"""How JAX warns of a program it cannot use; it then compiles as if there were none."""


_in_use: list[Path] = []
"""The folders of the open contexts of `cached_programs`, the innermost last."""


def folder_in_use() -> Path | None:
    """Where compiled programs are kept now, if they are."""
    return _in_use[-1] if _in_use else None


@contextmanager
def cached_programs() -> Iterator[None]:
    """Keep and reuse compiled programs within this context, if a folder for them can be used.

    If not, one line on stderr says why. A cache the user has set up for JAX itself
    (`JAX_COMPILATION_CACHE_DIR`) is left as it is.
    """
    chosen = os.environ.get(VARIABLE, "").strip()
    is_decided = _setting("jax_compilation_cache_dir") or not _setting(
        "jax_enable_compilation_cache"
    )
    folder = None if is_decided or chosen.lower() == "off" else _open_folder(chosen)
    if folder is None:
        yield
        return
    options: dict[str, Any] = {
        "jax_compilation_cache_dir": str(folder),
        # Two dozen small programs of a run take a second together.
        "jax_persistent_cache_min_compile_time_secs": 0.0,
    }
    before = {name: _setting(name) for name in options}
    for name, value in options.items():
        jax.config.update(name, value)
    _in_use.append(folder)
    try:
        with _sealed(folder), _warnings_in_one_line(folder):
            yield
    finally:
        _in_use.pop()
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()


@contextmanager
def watched_compilation() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether all that was compiled meanwhile came from the cache."""
    seen: Counter[str] = Counter()

    def note(event: str, **_: object) -> None:
        seen[event.removeprefix("/jax/compilation_cache/")] += 1

    jax.monitoring.register_event_listener(note)
    try:
        yield lambda: 0 < seen["compile_requests_use_cache"] == seen["cache_hits"]
    finally:
        jax.monitoring.unregister_event_listener(note)


def _setting(name: str) -> Any:
    return getattr(jax.config, name)


def _open_folder(chosen: str) -> Path | None:
    """The folder, made where it is missing and tidied; None, and a line why, if it is no use."""
    try:
        caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
        if not chosen and not caches.is_absolute():  # Unset, or what XDG says to ignore.
            caches = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
        folder = Path(chosen).expanduser() if chosen else caches / "sqn_jax" / "compiled"
        folder = folder.resolve()
        for parent in (*reversed(folder.parents), folder):
            parent.mkdir(mode=0o700, exist_ok=True)
        fault = _danger(folder)
        if fault is None:
            probe_writable(folder)
            _tidy(folder)
            return folder
    except OSError as error:
        fault = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except (RuntimeError, ValueError) as error:  # Nobody's home, a circle of links, NUL.
        fault = str(error)
    say(f"compiled programs are not cached: {fault}", error=True)
    return None


def _danger(folder: Path) -> str | None:
    """Who else could put programs there; None if nobody."""
    if folder.stat().st_uid != os.geteuid():
        return f"{folder} belongs to somebody else"
    for path in (folder, *folder.parents):
        mode = path.stat().st_mode
        # Where the sticky bit is set, as on /tmp, nobody can replace what others have there.
        is_sticky = path != folder and mode & stat.S_ISVTX
        if mode & (stat.S_IWGRP | stat.S_IWOTH) and not is_sticky:
            return f"others may write to {path}"
    return None


def _tidy(folder: Path) -> None:
    """Delete programs that are not what was written, what killed processes left, and the oldest.

    The oldest are those beyond `LARGEST_BYTES`.

    JAX runs what it reads. Where it compresses by Zstandard (from Python 3.14 on, or where that
    package is installed), which keeps no checksum, one wrong bit in seven crashes the process or
    gives wrong numbers. JAX's own limit needs another package, and fails for good once a process
    was killed between an entry and its time stamp.
    """
    bytes_left, damaged = {True: LARGEST_ARRAYS, False: LARGEST_BYTES}, 0
    entries = folder.glob(f"*{ENTRY}")
    for entry in sorted(entries, key=lambda path: path.lstat().st_mtime, reverse=True):
        seal, is_arrays = seal_of(entry), entry.name.startswith(ARRAYS)
        is_sealed = os.path.lexists(seal)  # Else a process was killed before it was finished.
        sound = is_sealed and _is_sound(entry, seal)
        # Two commands that begin at once may write the two files of the same arrays in any order.
        damaged += is_sealed and not sound and not is_arrays
        bytes_left[is_arrays] -= entry.lstat().st_size if sound else 0
        if not sound or bytes_left[is_arrays] < 0:
            for path in (entry, seal):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                path.unlink(missing_ok=True)
    for path in _leftovers(folder):
        path.unlink(missing_ok=True)
    if damaged:
        say(f"compiled programs in {folder}: {damaged} damaged, to be compiled again", error=True)


def _leftovers(folder: Path) -> Iterator[Path]:
    """Unfinished files of arrays, and checksums without an entry, of processes that were killed."""
    for path in folder.iterdir():
        entry = path.with_name(path.name.removesuffix(SEAL) + ENTRY)
        is_orphan = _SEAL_NAME.search(path.name) and not os.path.lexists(entry)
        is_unfinished = path.name.startswith(f".{ARRAYS}") and ".partial" in path.name
        if is_orphan or is_unfinished:
            with suppress(FileNotFoundError):  # Another command deletes it, or is writing it.
                if path.lstat().st_mtime < time.time() - LEFTOVER_AGE:
                    yield path


@contextmanager
def _sealed(folder: Path) -> Iterator[None]:
    """Put a checksum beside every program as soon as it is written: the run may be killed."""

    seen: list[int] = []

    def seal(event: str = "compile_duration", *_: object, **__: object) -> None:
        with suppress(OSError):
            # A folder changes when a file is added; to look through all of its files takes longer.
            if not event.endswith("compile_duration") or seen == [folder.stat().st_mtime_ns]:
                return
            for entry in folder.glob(f"*{ENTRY}"):
                with suppress(OSError, ValueError):
                    if not seal_of(entry).exists():
                        seal_of(entry).write_bytes(_digest(entry))
            seen[:] = [folder.stat().st_mtime_ns]

    jax.monitoring.register_event_duration_secs_listener(seal)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(seal)
        seen.clear()  # The clock of a file system may stand still for some milliseconds.
        seal()


def seal_of(entry: Path) -> Path:
    """The file with the checksum of an entry."""
    return entry.with_name(entry.name.removesuffix(ENTRY) + SEAL)


def _is_sound(entry: Path, seal: Path) -> bool:
    """Whether an entry is what was written; links, pipes and folders are none."""
    try:
        expected = read_at_most(seal, 64, "a checksum", follow=False)
        return expected == _digest(entry)
    except (OSError, ValueError):
        return False


def _digest(path: Path) -> bytes:
    data = read_at_most(path, LARGEST_BYTES, "a compiled program", follow=False)
    return hashlib.sha256(data).hexdigest().encode()


@contextmanager
def _warnings_in_one_line(folder: Path) -> Iterator[None]:
    """Report the first program that JAX cannot read or write, and delete the files of each."""
    troubles: set[str] = set()
    with warnings.catch_warnings():
        show_others = warnings.showwarning

        def show(message: Warning | str, *rest: Any, **named: Any) -> None:
            trouble = _TROUBLE.match(str(message))
            if trouble is None:
                show_others(message, *rest, **named)
                return
            verb, program, reason = trouble.groups()
            with suppress(OSError):  # The folder itself may be gone.
                for path in folder.glob(f"{program}-*"):
                    path.unlink(missing_ok=True)
            if verb not in troubles:
                failure = f"{verb} {program} failed ({' '.join(reason.split())})"
                # Through tqdm, since a progress bar may be on the screen.
                message = shown(f"compiled programs in {folder}: {failure}; going on")
                tqdm.write(message, file=sys.stderr)
            troubles.add(verb)

        warnings.showwarning = show
        # Every time, and never as an error, whatever filters the user has set.
        warnings.filterwarnings("always", message="Error .* persistent compilation cache entry")
        yield
