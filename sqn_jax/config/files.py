"""Settings as plain dicts and JSON files, checked on the way back."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

from sqn_jax.config.run import TrainConfig
from sqn_jax.config.validation import require
from sqn_jax.outside.reading import read_json

MAX_BYTES = 2**20
"""Size of a file of settings at most; they have two kilobytes."""


def to_dict(config: Any) -> dict[str, Any]:
    """Return a config as nested plain dicts, ready for JSON."""
    return dataclasses.asdict(config)


def to_public_dict(config: TrainConfig) -> dict[str, Any]:
    """`to_dict` for a file that others read: of files and of a run the name, not the place."""
    maps = str(config.maps.without_folders())
    return to_dict(config) | {"start_from": Path(config.start_from).name, "map": maps}


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted names, `learner.discount` for one of a group."""
    named: dict[str, Any] = {}
    for name, value in tree.items():
        label = f"{prefix}{name}"
        named |= flat(value, f"{label}.") if isinstance(value, dict) else {label: value}
    return named


def from_dict(data: Any, cls: type[Any] = TrainConfig, prefix: str = "") -> Any:
    """Rebuild a config from `to_dict`'s output.

    Raises:
        ValueError: an unknown field, a value of the wrong type, or one out of range; the message
            names the field.
    """
    require(isinstance(data, dict), prefix.rstrip(".") or "config", data, "a mapping of fields")
    known = {item.name: item for item in fields(cls)}
    hints = typing.get_type_hints(cls)
    values = {}
    for name, value in data.items():
        require(name in known, f"{prefix}{name[:80]}", value, f"one of the fields {sorted(known)}")
        if dataclasses.is_dataclass(hints[name]):
            value = from_dict(value, typing.cast(type, hints[name]), f"{prefix}{name}.")
        else:
            value = _checked(value, hints[name], f"{prefix}{name}")
        values[name] = value
    return cls(**values)


def _checked(value: Any, hint: Any, label: str) -> Any:
    """Check one leaf against its annotation; whole numbers pass where a float is asked for."""
    if typing.get_origin(hint) is Literal:
        return value  # The dataclass checks its own choices.
    assert not isinstance(hint, types.UnionType), "config fields have one type"
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    require(type(value) is hint, label, value, f"a value of type {hint.__name__}")
    return value


def save(config: TrainConfig, path: Path) -> None:
    """Write a config as JSON."""
    path.write_text(json.dumps(to_dict(config), indent=2) + "\n", encoding="utf-8")


def load(path: Path) -> TrainConfig:
    """Read a config written by `save`.

    Raises:
        ValueError: the file is missing, is not JSON, or holds an unusable value.
    """
    data = read_json(path, MAX_BYTES, "settings", follow=False)
    try:
        return typing.cast(TrainConfig, from_dict(data))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
