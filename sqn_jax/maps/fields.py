"""The YAML file of a map as a mapping of keys to text."""

from __future__ import annotations

import difflib
import reprlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import yaml

from sqn_jax.outside.messages import named, one_line
from sqn_jax.outside.reading import read_at_most

MAX_YAML_BYTES = 2**20
_SHOWN_KEYS = 4


def fail(path: Path, field: str, value: object, expected: str) -> NoReturn:
    """Raise the one line every unusable file ends in; long and deep values are shortened."""
    shown = reprlib.repr(value)[:100]
    raise ValueError(f"{named(path)}: {field}: {shown}, expected {expected}")


class _TextLoader(yaml.BaseLoader):
    """The safest of YAML's loaders, and no key may stand twice.

    It builds nothing but text, lists and mappings, so that what counts as a number is decided
    elsewhere, the same for 0.05, 5e-2 and "0.05".
    """

    def scan_to_next_token(self) -> None:
        """Skip blanks; a tab is one, as YAML has it, but in the indentation of a line."""
        line, is_after_token = self.line, self.column > 0  # type: ignore[has-type]
        super().scan_to_next_token()  # type: ignore[no-untyped-call]
        while self.peek() == "\t" and (self.flow_level or (is_after_token and self.line == line)):
            self.forward()
            super().scan_to_next_token()  # type: ignore[no-untyped-call]

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping; readers differ on which of two equal keys counts, so there is to be one."""
        mapping: dict[Any, Any] = super().construct_mapping(node, deep=deep)
        if len(mapping) < len(node.value):
            counts = Counter(key.value for key, _ in node.value)
            twice = max(counts, key=counts.__getitem__)
            raise ValueError(f"{reprlib.repr(twice)} stands twice, expected every key once")
        return mapping


def read_fields(
    path: Path, required: Sequence[str], optional: Sequence[str]
) -> tuple[Mapping[str, Any], str | None]:
    """The YAML file as a mapping of its keys to text (or nested lists of text).

    Args:
        path: the file.
        required: keys that must be there.
        optional: keys that may be there.

    Returns:
        The mapping, and one line about keys that are none of these, if any.

    Raises:
        ValueError: one line naming the file: it is no mapping in YAML, or a key is missing.
    """
    data = read_at_most(path, MAX_YAML_BYTES, "a map's YAML file")
    try:
        fields = yaml.load(data, Loader=_TextLoader)
    # The parser raises a dozen kinds of error on damaged files: each means unusable.
    except Exception as error:
        reason = one_line(error)[:200]
        raise ValueError(f"{named(path)}: not readable as YAML ({reason})") from error
    if not isinstance(fields, dict):
        fail(path, "file", fields, "a mapping with the keys of a map_server YAML file")
    unknown = {
        str(key): _nearest(str(key), {*required, *optional} - set(fields))
        for key in fields
        if key not in (*required, *optional)
    }
    for key in required:
        if key not in fields:
            meant = next((written for written in unknown if unknown[written] == key), None)
            hint = "" if meant is None else f" (is {_shown(meant)} meant?)"
            keys = ", ".join(required)
            raise ValueError(f"{named(path)}: {key}: missing{hint}, expected the keys {keys}")
    return fields, f"{named(path)}: {_ignored(unknown)}" if unknown else None


def _nearest(key: str, known: Collection[str]) -> str | None:
    """The known key that is most like this one, if one is."""
    nearest = difflib.get_close_matches(key[:100].lower(), sorted(known), n=1)
    return nearest[0] if nearest else None


def _ignored(unknown: Mapping[str, str | None]) -> str:
    """One line about unknown keys, the first of them by name."""
    shown = [
        _shown(key) + ("" if nearest is None else f" (is {nearest} meant?)")
        for key, nearest in list(unknown.items())[:_SHOWN_KEYS]
    ]
    more = len(unknown) - len(shown)
    return (
        f"unknown {'key' if len(unknown) == 1 else 'keys'} {', '.join(shown)}"
        + (f" and {more} more" if more else "")
        + ": no effect"
    )


def _shown(key: str) -> str:
    return repr(key if len(key) <= 40 else key[:37] + "...")
