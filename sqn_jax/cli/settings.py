"""The settings of a run as options: one for each field of `TrainConfig` and its groups."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import itertools
import textwrap
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

from sqn_jax import config as configs
from sqn_jax.cli.arguments import integer, number
from sqn_jax.config import TrainConfig

METAVARS = {int: "INT", float: "FLOAT", str: "TEXT"}
TYPES: dict[type, Callable[[str], Any]] = {int: integer, float: number, str: str}


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add `--field VALUE` and `--group.field VALUE`, described by the docstrings of the fields.

    In the namespace a setting has the dotted name of its field; it is None if not given.
    """
    hints = typing.get_type_hints(TrainConfig)
    groups: dict[str, Any] = {
        name: cls for name, cls in hints.items() if dataclasses.is_dataclass(cls)
    }
    group = parser.add_argument_group("settings")
    _add_fields(group.add_argument, "", TrainConfig, leave_out=groups)
    for name, cls in groups.items():
        group = parser.add_argument_group(f"{name} settings", inspect.getdoc(cls))
        _add_fields(group.add_argument, f"{name}.", cls)


def option(dotted: str, value: object = None) -> str:
    """The option for a setting; a switch that is off is spelled with `no-`."""
    group, dot, name = dotted.replace("_", "-").rpartition(".")
    return f"--{group}{dot}{'no-' if value is False else ''}{name}"


def field_docstrings(cls: type) -> dict[str, str]:
    """The string that follows each field in the source of a class."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(tree, ast.ClassDef)
    return {
        field.target.id: str(text.value.value)
        for field, text in itertools.pairwise(tree.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }


def with_settings(config: TrainConfig, settings: Mapping[str, Any]) -> TrainConfig:
    """Replace settings by their dotted names.

    Raises:
        ValueError: a value is out of range; the message names the field.
    """
    data = configs.to_dict(config)
    for dotted, value in settings.items():
        group, _, name = dotted.rpartition(".")
        (data[group] if group else data)[name] = value
    return typing.cast(TrainConfig, configs.from_dict(data))


def normalized(arguments: Sequence[str]) -> list[str]:
    """Arguments with dashes for underscores in options, and `=` before negative numbers.

    argparse would list both spellings, and takes `-1e-3` for an option.
    """
    result: list[str] = []
    for argument in arguments:
        if argument.startswith("--"):
            name, equals, value = argument.partition("=")
            result.append(name.replace("_", "-") + equals + value)
        elif _is_negative(argument) and result and _expects_value(result[-1]):
            result[-1] += f"={argument}"
        else:
            result.append(argument)
    return result


def _is_negative(argument: str) -> bool:
    try:
        float(argument)
    except ValueError:
        return False
    return argument.startswith("-")


def _expects_value(argument: str) -> bool:
    return argument.startswith("--") and "=" not in argument


class _Switch(argparse.Action):
    """True by the first of its two names, False by the second."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, option_string == self.option_strings[0])


def _add_fields(
    add: Callable[..., argparse.Action], prefix: str, cls: type, leave_out: Iterable[str] = ()
) -> None:
    """One option for each field of a dataclass."""
    descriptions = field_docstrings(cls)
    for name, hint in typing.get_type_hints(cls).items():
        if name in leave_out:
            continue
        options, default = [option(f"{prefix}{name}")], "%(default)s"
        keywords: dict[str, Any] = {"type": TYPES.get(hint), "metavar": METAVARS.get(hint)}
        if hint is bool:
            options.append(option(f"{prefix}{name}", False))
            keywords = {"action": _Switch, "nargs": 0}
        elif typing.get_origin(hint) is Literal:
            keywords = {"choices": typing.get_args(hint)}
        elif hint is str:
            default = "%(default)r"
        text = " ".join(descriptions[name].split()).replace("%", "%%")
        add(*options, dest=f"{prefix}{name}", help=f"{text} (default: {default})", **keywords)
