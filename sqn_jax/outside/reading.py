"""Reading files from outside: regular files only, up to a limit, and JSON without surprises."""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from collections import Counter
from pathlib import Path
from typing import Any, NoReturn

from sqn_jax.outside.messages import named, one_line

MAX_DEPTH = 32
"""How deep lists and objects of a JSON file may be nested."""

MAX_DIGITS = 20
"""Digits of a whole number in a JSON file: more than 64 bits need."""

_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def open_regular(path: Path, flags: int = os.O_RDONLY, *, follow: bool = False) -> int:
    """Open a regular file, and nothing else; never waits.

    Args:
        path: the file.
        flags: of `os.open`.
        follow: open what a symbolic link leads to.

    Returns:
        The descriptor.

    Raises:
        OSError: the file is of another kind, or cannot be opened.
    """
    flags |= os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
    try:
        if not flags & os.O_EXCL:
            _require_regular(path, follow=follow)  # To open a device may set it going.
        descriptor = os.open(path, flags, 0o666)
    except ValueError:  # It holds NUL, or what this system's encoding lacks.
        raise OSError(errno.EINVAL, "no file can have this name", str(path)) from None
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "is not a regular file", str(path))
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _require_regular(path: Path, *, follow: bool) -> None:
    try:
        mode = path.stat(follow_symlinks=follow).st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"is {kind_of(mode)}, expected a regular file", str(path))


def kind_of(mode: int) -> str:
    """What a file is that is no regular one, by its mode."""
    return _KINDS.get(stat.S_IFMT(mode), "a special file")


def no_file(path: Path) -> str | None:
    """What stands in the place of a file that is none: a folder or a pipe, say; None for a file."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return "no such file"
    return None if stat.S_ISREG(mode) else f"is {kind_of(mode)}"


def read_at_most(path: Path, limit: int, expected: str, *, follow: bool = True) -> bytes:
    """The contents of a regular file of at most `limit` bytes; a larger one is not read.

    Args:
        path: the file.
        limit: bytes.
        expected: what the file should have been, for the errors.
        follow: read what a symbolic link leads to.

    Raises:
        ValueError: one line naming the file: there is none, it cannot be read, or it is larger.
    """
    try:
        if (place := no_file(path)) is not None:
            raise ValueError(f"{named(path)}: {place}, expected {expected}")
        with os.fdopen(open_regular(path, follow=follow), "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size > limit:
                raise ValueError(f"{named(path)}: larger than {limit} bytes, expected {expected}")
            return file.read(size)
    except OSError as error:
        raise ValueError(f"{named(path)}: cannot be read ({error.strerror})") from None


def read_json(path: Path, limit: int, expected: str, *, follow: bool = True) -> Any:
    """The value in a JSON file, see `read_at_most` and `parse_json`.

    Raises:
        ValueError: one line naming the file.
    """
    data = read_at_most(path, limit, expected, follow=follow)
    try:
        return parse_json(data)
    except ValueError as error:
        raise ValueError(f"{named(path)}: not valid JSON ({one_line(error)})") from None


def parse_json(data: bytes) -> Any:
    """The value of a JSON text in UTF-8, as the standard has it.

    Raises:
        ValueError: it is no JSON, a key stands twice, a number is not finite or has more than
            `MAX_DIGITS` digits, or it is nested deeper than `MAX_DEPTH`.
    """
    try:
        value = json.loads(
            data.decode("utf-8"),
            object_pairs_hook=_object,
            parse_constant=_no_number,
            parse_int=_whole_number,
            parse_float=_number,
        )
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    level = [value]
    for _ in range(MAX_DEPTH):
        level = [item for outer in level for item in _items(outer)]
        if not level:
            return value
    raise ValueError(_TOO_DEEP)


_TOO_DEEP = f"nested deeper than {MAX_DEPTH} levels"


def _items(value: object) -> list[Any]:
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    contents = dict(pairs)
    if len(contents) < len(pairs):
        twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"the key {twice[:80]!r} stands twice")
    return contents


def _whole_number(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"a whole number has {len(digits)} digits")
    return int(digits)


def _number(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"the number {digits[:40]} is too large")
    return number


def _no_number(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")
