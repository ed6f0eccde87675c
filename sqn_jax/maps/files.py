"""Files from outside: what errors call them, and reading them up to a limit."""

from __future__ import annotations

from pathlib import Path


def named(path: Path) -> str:
    """The path as errors and warnings show it: one line that can be printed, whatever its name."""
    return str(path) if str(path).isprintable() else repr(str(path))


def one_line(reason: object) -> str:
    """What a library says about a damaged file, without line breaks or what cannot be seen."""
    shown = (letter if letter.isprintable() else " " for letter in str(reason))
    return " ".join("".join(shown).split())


def no_file(path: Path) -> str:
    """What stands in the place of a file that is none: nothing, a folder, or a pipe, say."""
    if path.is_dir():
        return "a folder"
    return "not a regular file" if path.exists() else "no such file"


def read_at_most(path: Path, limit: int, expected: str) -> bytes:
    """The contents of a regular file of at most `limit` bytes; a larger one is not read.

    Args:
        path: the file.
        limit: bytes.
        expected: what the file should have been, for the errors.

    Raises:
        ValueError: one line naming the file: there is none, it cannot be read, or it is larger.
    """
    try:
        if not path.is_file():
            raise ValueError(f"{named(path)}: {no_file(path)}, expected {expected}")
        size = path.stat().st_size
        if size > limit:
            raise ValueError(f"{named(path)}: larger than {limit} bytes, expected {expected}")
        with path.open("rb") as file:
            return file.read(size)
    except OSError as error:
        raise ValueError(f"{named(path)}: cannot be read ({error.strerror})") from error
