"""Messages on the terminal. Names and files are others': what they hold never controls it."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path


def shown(text: object) -> str:
    r"""Text as one line in which everything can be seen: `\n`, `\x1b` and `\u202e` are escaped.

    So are all control characters, marks of the direction of writing, and bytes that are no text.
    """
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(text))


def named(path: Path) -> str:
    """The path as errors and warnings show it: one line that can be printed, whatever its name."""
    return str(path) if str(path).isprintable() else repr(str(path))


def one_line(reason: object) -> str:
    """What a library says about a damaged file, without line breaks or what cannot be seen."""
    letters = (letter if letter.isprintable() else " " for letter in str(reason))
    return " ".join("".join(letters).split())


def say(
    text: object, *, start: str = "", end: str = "\n", flush: bool = False, error: bool = False
) -> None:
    r"""Print one line, see `shown`; the one place from which messages reach the terminal.

    Args:
        text: the message.
        start: what stands before it as it is: `\r` overwrites the line.
        end: what follows it as it is.
        flush: do not wait for more.
        error: print to stderr.
    """
    stream = sys.stderr if error else sys.stdout
    if stream is None:  # A process without standard output.
        return
    print(f"{start}{shown(text)}", end=end, file=stream, flush=flush)


def say_lines(lines: Iterable[object], *, error: bool = False) -> None:
    """Print several lines, each see `say`."""
    for line in lines:
        say(line, error=error)
