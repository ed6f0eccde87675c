"""Files written as a whole or not at all, and JSON without NaN."""

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


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a JSON file as a whole or not at all; NaN becomes null."""
    text = json.dumps(without_nan(data), indent=2, allow_nan=False)
    write_whole(path, text + "\n")


def write_records(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Write a JSON lines file as a whole or not at all; NaN becomes null."""
    with written_whole(path) as partial, partial.open("w", encoding="utf-8") as file:
        for record in records:  # Of a large evaluation, more than should be in memory twice.
            file.write(json.dumps(without_nan(record), allow_nan=False) + "\n")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A hidden name beside `path` to write to, which becomes `path` at the end or vanishes.

    Raises:
        NotWritten: the file cannot be written.
    """
    partial = path.absolute().with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        raise NotWritten(path, error) from None
    finally:
        with suppress(OSError):
            partial.unlink()


def write_whole(path: Path, text: str) -> None:
    """Write a text file as a whole or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
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
