"""Rows of metrics.jsonl, read with suspicion: an edited or damaged file is refused by its line."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sqn_jax.outside.messages import named, one_line
from sqn_jax.outside.reading import open_regular, parse_json

Row = dict[str, Any]

MAX_LINE_BYTES = 2**24
"""Size of a row at most; that of one seed has a kilobyte."""

MAX_FILE_BYTES = 2**30


def read_rows(path: Path) -> tuple[list[Row], str | None]:
    """The sound rows at the beginning of the file, and what is wrong with the line after them.

    A last line without an end is what a power cut leaves: it is left out without a word. No file
    is no row.

    Args:
        path: the file.

    Returns:
        The rows, of the chunks 1, 2, ...; and one line that names the file and the first line that
        is none of them: it is damaged, lacks or has other metrics than the first row, or is that of
        another chunk. None if all are sound.

    Raises:
        ValueError: it is no regular file, or cannot be read.
    """
    rows: list[Row] = []
    try:
        with os.fdopen(open_regular(path), "rb") as file:
            if os.fstat(file.fileno()).st_size > MAX_FILE_BYTES:
                return [], f"{named(path)}: larger than {MAX_FILE_BYTES} bytes"
            while line := file.readline(MAX_LINE_BYTES + 1):
                try:
                    rows.append(_row(line, rows))
                except ValueError as error:
                    is_torn = not (line.endswith(b"\n") or isinstance(error, _OutOfPlace))
                    if is_torn and len(line) <= MAX_LINE_BYTES:
                        break
                    return rows, f"{named(path)}: line {len(rows) + 1} {error}"
    except FileNotFoundError:
        return [], None
    except OSError as error:
        raise ValueError(f"{named(path)}: cannot be read ({error.strerror})") from None
    return rows, None


def evaluated_rows(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The rows of chunks after which the policies were evaluated: points of the learning curve."""

    def is_known(value: Any) -> bool:
        if isinstance(value, list):
            return all(map(is_known, value))
        return value is not None and math.isfinite(value)

    return [row for row in rows if is_known(row.get("eval_mean_reward"))]


def to_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as they stand in the file."""
    return "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)


class _OutOfPlace(ValueError):
    """A line is whole, but not the row that belongs there."""


def _row(line: bytes, before: Sequence[Row]) -> Row:
    """The row in a line that follows others; the error goes on after "line N"."""
    if len(line) > MAX_LINE_BYTES:
        raise ValueError(f"is damaged (longer than {MAX_LINE_BYTES} bytes), {_EXPECTED}")
    try:
        row = parse_json(line)
    except ValueError as error:
        raise ValueError(f"is damaged ({one_line(error)[:80]}), {_EXPECTED}") from None
    if not isinstance(row, dict) or type(row.get("chunk")) is not int:
        raise _OutOfPlace(f"is damaged, {_EXPECTED}")
    if row["chunk"] != len(before) + 1:
        raise _OutOfPlace(
            f"is that of chunk {row['chunk']}, expected chunk {len(before) + 1}: rows were added, "
            "removed or moved"
        )
    first = before[0] if before else row
    for name in dict.fromkeys([*first, *row]):
        if name not in row:
            raise _OutOfPlace(f"is damaged: it lacks {name[:80]!r}, which line 1 has")
        form = _form(row[name])
        if form is None or (name in first and form != _form(first[name])):
            raise _OutOfPlace(
                f"is damaged: {name[:80]!r} is {repr(row[name])[:80]}, expected "
                + ("numbers" if form is None else "as many numbers as in line 1")
            )
    for name in ("episodes", "env_steps"):
        if name in first and row[name] != row["chunk"] * first[name]:
            raise _OutOfPlace(
                f"is damaged: {name!r} is {row[name]}, expected {row['chunk'] * first[name]}, "
                f"{row['chunk']} times that of line 1"
            )
    return row


_EXPECTED = "expected an object with a chunk number"


def _form(value: object) -> tuple[int, ...] | None:
    """The shape of numbers in lists, null among them; None for anything else."""
    if value is None or isinstance(value, int | float):
        return ()
    if not isinstance(value, list) or not value:
        return None
    forms = {_form(item) for item in value}
    form = forms.pop()
    return None if forms or form is None else (len(value), *form)
