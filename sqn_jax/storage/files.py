"""Files written as a whole or not at all, and JSON without NaN.

Nothing is written through a link: the folder may come from somebody else.
"""

from __future__ import annotations

import errno
import json
import math
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sqn_jax.outside.reading import open_regular


class NotWritten(OSError, ValueError):
    """A file could not be written: the disk is full, say."""

    def __init__(self, path: Path, error: OSError) -> None:
        super().__init__(f"{path}: cannot be written ({error.strerror or error})")


def probe_writable(folder: Path) -> None:
    """Raise OSError where no file can be written."""
    with tempfile.TemporaryFile(dir=folder):
        pass


def flush_to_disk(descriptor: int) -> None:
    """Let what was written to a file survive a power cut, where the file system can do that."""
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise


def flush_folder(folder: Path) -> None:
    """Let new names and renamings in a folder survive a power cut."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            flush_to_disk(descriptor)
        finally:
            os.close(descriptor)


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a JSON file as a whole or not at all; NaN becomes null."""
    text = json.dumps(without_nan(data), indent=2, allow_nan=False)
    write_whole(path, text + "\n")


def write_records(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Write a JSON lines file as a whole or not at all; NaN becomes null."""
    with written_whole(path) as partial, partial.open("w", encoding="utf-8") as file:
        for record in records:  # Of a large evaluation, more than should be in memory twice.
            file.write(json.dumps(without_nan(record), allow_nan=False) + "\n")


def probe_file(path: Path) -> None:
    """Raise NotWritten where a file of this name cannot be written."""
    with suppress(_Probed), written_whole(path):
        raise _Probed


class _Probed(Exception):
    """Ends a probe."""


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A hidden, empty file beside `path` to write to, which becomes `path` or vanishes.

    Raises:
        NotWritten: the file cannot be written.
    """
    partial = path.absolute().with_name(f".{path.stem[:40]}.{os.getpid()}.partial{path.suffix}")
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        # What a killed process of this number has left, or a link that leads elsewhere.
        partial.unlink(missing_ok=True)
        os.close(open_regular(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        try:
            yield partial
            partial.replace(path)
        finally:
            with suppress(OSError):
                partial.unlink()
    except OSError as error:
        raise NotWritten(path, error) from None


def write_whole(path: Path, contents: str | bytes) -> None:
    """Write a text file or bytes as a whole or not at all, on the disk when this returns."""
    data = contents.encode() if isinstance(contents, str) else contents
    with written_whole(path) as partial, partial.open("wb") as file:
        file.write(data)
        file.flush()
        flush_to_disk(file.fileno())


def append(path: Path, text: str, *, flush: bool = False) -> None:
    """Add text at the end of a file, which is made where it is missing.

    Raises:
        NotWritten: the disk is full, say.
    """
    try:
        descriptor = open_regular(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        with os.fdopen(descriptor, "ab") as file:
            file.write(text.encode())
            if flush:
                file.flush()
                flush_to_disk(file.fileno())
    except OSError as error:
        raise NotWritten(path, error) from None


def without_nan(value: Any) -> Any:
    """Replace what JSON cannot say: NaN and infinities become null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: without_nan(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return value
