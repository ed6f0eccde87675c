"""Compiled programs kept on disk, so that the next start reads them instead of compiling.

JAX does the keeping (its persistent compilation cache); this module says where and for how long,
finds what is damaged, and tells what is wrong in one line. JAX's key holds the program, the
versions, the flags and the instruction set of the processor: a home shared by different machines
is no danger.

What is read is executed. The folder is therefore private, and one that others can write to is not
used. Whoever imports the library gets no cache: only what trains, evaluates, renders or writes a
report asks for one.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache
from tqdm import tqdm

from sqn_jax.storage.files import probe_writable

VARIABLE = "SQN_JAX_CACHE"
"""Environment variable: a folder to use instead of the user's own, or `off`."""

LARGEST_BYTES = 2**28
"""What the folder may hold when a run starts; all programs of a run take a few MB."""

ENTRY, SEAL = "-cache", "-sha256"
"""Endings: of JAX's entries, and of the checksum beside each."""

_TROUBLE = re.compile(
    r"Error (?P<verb>reading|writing) persistent compilation cache entry "
    r"for '(?P<program>[^']*)': (?P<reason>.*)",
    re.DOTALL,
)
"""How JAX warns of an entry it cannot use; it then compiles as if there were none."""


@contextmanager
def kept_programs() -> Iterator[None]:
    """Keep and reuse compiled programs within this context, if a folder for them can be used.

    If not, one line on stderr says why. A cache the user has set up for JAX itself
    (`JAX_COMPILATION_CACHE_DIR`) is left as it is.
    """
    folder = None if _is_decided() else _open_folder()
    if folder is None:
        yield
        return
    options: dict[str, object] = {"jax_compilation_cache_dir": str(folder)}
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # Two dozen small programs of a run take a second together.
        options["jax_persistent_cache_min_compile_time_secs"] = 0.0
    before = {name: _setting(name) for name in options}
    for name, value in options.items():
        jax.config.update(name, value)
    try:
        with _sealed(folder), _told_in_one_line(folder):
            yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()


@contextmanager
def watched_compilation() -> Iterator[Callable[[], bool]]:
    """Watch what is compiled in this context.

    Yields:
        A function that tells whether all of it was read from the cache.
    """
    seen: Counter[str] = Counter()

    def note(event: str, **_: object) -> None:
        seen[event.removeprefix("/jax/compilation_cache/")] += 1

    jax.monitoring.register_event_listener(note)
    try:
        yield lambda: 0 < seen["compile_requests_use_cache"] == seen["cache_hits"]
    finally:
        jax.monitoring.unregister_event_listener(note)


def _is_decided() -> bool:
    """Whether the user has decided otherwise: against a cache, or for one of JAX's own."""
    if os.environ.get(VARIABLE, "").strip().lower() == "off":
        return True
    is_on = _setting("jax_enable_compilation_cache")
    return bool(_setting("jax_compilation_cache_dir")) or not is_on


def _setting(name: str) -> object:
    return getattr(jax.config, name)


def _open_folder() -> Path | None:
    """The folder, made where it is missing and tidied; None, and a line why, if it is no use."""
    try:
        folder = _folder().resolve()
        for each in (*reversed(folder.parents), folder):
            each.mkdir(mode=0o700, exist_ok=True)
        fault = _danger(folder)
        if fault is None:
            probe_writable(folder)
            _delete_damaged(folder)
            _delete_oldest(folder, LARGEST_BYTES)
            return folder
    except OSError as error:
        fault = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except RuntimeError as error:  # Nobody's home.
        fault = str(error)
    print(f"compiled programs are not kept: {fault}", file=sys.stderr)
    return None


def _folder() -> Path:
    """Where programs are to be kept."""
    chosen = os.environ.get(VARIABLE, "").strip()
    if chosen:
        return Path(chosen).expanduser()
    caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not caches.is_absolute():  # Unset, or what its specification says to ignore.
        caches = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
    return caches / "sqn_jax" / "compiled"


def _danger(folder: Path) -> str | None:
    """Who else could put programs there, in words; None if nobody."""
    if folder.stat().st_uid != os.geteuid():
        return f"{folder} belongs to somebody else"
    for each in (folder, *folder.parents):
        mode = each.stat().st_mode
        # Where the sticky bit is set, as on /tmp, nobody can replace what others have there.
        is_sticky = each != folder and mode & stat.S_ISVTX
        if mode & (stat.S_IWGRP | stat.S_IWOTH) and not is_sticky:
            return f"others may write to {each}"
    return None


def _delete_damaged(folder: Path) -> None:
    """Delete entries that are not what was written, and say how many.

    JAX reads whatever it finds. An entry cut short it notices; but where it compresses by
    Zstandard, which keeps no checksum, a single wrong bit ends in a crash or in wrong numbers. An
    entry without a seal was not finished, one it cannot read would not be replaced.
    """
    damaged = 0
    for entry in folder.glob(f"*{ENTRY}"):
        with suppress(OSError):  # Another run may be tidying up too.
            seal = _seal_of(entry)
            is_sealed = seal.exists()
            if not is_sealed or seal.read_bytes() != _digest(entry):
                damaged += is_sealed
                entry.unlink(missing_ok=True)
                seal.unlink(missing_ok=True)
    if damaged:
        print(
            f"compiled programs in {folder}: {damaged} damaged, deleted (to be compiled again)",
            file=sys.stderr,
        )


def _delete_oldest(folder: Path, largest: int) -> None:
    """Delete files, the oldest first, until the rest take no more than `largest` bytes.

    JAX has a limit of its own, which needs another package and a lock around every access.
    """
    files = []
    for path in folder.rglob("*"):  # On a GPU, folders of XLA's too.
        with suppress(OSError):
            found = path.lstat()
            if stat.S_ISREG(found.st_mode):
                files.append((found.st_mtime, found.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= largest:
            break
        with suppress(OSError):
            path.unlink(missing_ok=True)
        total -= size


@contextmanager
def _sealed(folder: Path) -> Iterator[None]:
    """Put a checksum beside every entry, as soon as it is written."""

    def seal(event: str = "", *_: object, **__: object) -> None:
        if event and event != "/jax/core/compile/backend_compile_duration":
            return
        for entry in folder.glob(f"*{ENTRY}"):
            with suppress(OSError):
                if not _seal_of(entry).exists():
                    _seal_of(entry).write_bytes(_digest(entry))

    jax.monitoring.register_event_duration_secs_listener(seal)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(seal)
        seal()


def _seal_of(entry: Path) -> Path:
    return entry.with_name(entry.name.removesuffix(ENTRY) + SEAL)


def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).hexdigest().encode()


@contextmanager
def _told_in_one_line(folder: Path) -> Iterator[None]:
    """Tell of the first entry that cannot be read or written, and delete each such entry."""
    told: set[str] = set()
    with warnings.catch_warnings():
        show_others = warnings.showwarning

        def show(message: Warning | str, *rest: object, **named: object) -> None:
            trouble = _TROUBLE.match(str(message))
            if trouble is None:
                show_others(message, *rest, **named)  # type: ignore[arg-type]
                return
            verb, program, reason = trouble.group("verb", "program", "reason")
            with suppress(OSError):  # The folder itself may be gone.
                for path in folder.iterdir():
                    if path.name.startswith(f"{program}-"):
                        path.unlink(missing_ok=True)
            if verb not in told:
                reason = " ".join(reason.split())
                # Through tqdm, since a progress bar may be on the screen.
                tqdm.write(
                    f"compiled programs in {folder}: {verb} {program} failed ({reason}); "
                    "the run goes on without it",
                    file=sys.stderr,
                )
            told.add(verb)

        warnings.showwarning = show  # type: ignore[assignment]
        # Every time, and never as an error, whatever filters the user has set.
        warnings.filterwarnings("always", message="Error .* persistent compilation cache entry")
        yield
