"""Checks of settings: each refuses by name, with the value and what was expected."""

from __future__ import annotations

import math
import typing
from typing import Literal

MAX_SHOWN = 200
"""Letters of a value that an error shows."""


def require(condition: bool, name: str, value: object, expected: str) -> None:
    """Raise ValueError, in one line, where a condition does not hold."""
    if not condition:
        text = repr(value)
        shown_value = text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."
        raise ValueError(f"{name} is {shown_value}, expected {expected}")


def require_known_choices(config: object, group: str) -> None:
    """Check every field that takes one of a few strings."""
    for name, hint in typing.get_type_hints(type(config)).items():
        if typing.get_origin(hint) is Literal:
            choices = typing.get_args(hint)
            value = getattr(config, name)
            require(value in choices, _label(group, name), value, f"one of {', '.join(choices)}")


def _label(group: str, name: str) -> str:
    return f"{group}.{name}" if group else name


def require_positive(config: object, group: str, name: str) -> None:
    """Check that a field is above 0 and finite."""
    value = getattr(config, name)
    require(0 < value < math.inf, _label(group, name), value, "a positive number")


def require_not_negative(config: object, group: str, name: str) -> None:
    """Check that a field is at least 0 and finite."""
    value = getattr(config, name)
    require(0 <= value < math.inf, _label(group, name), value, "0 or a positive number")
