"""The parser of the commands, options that several of them have, and types of arguments."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

from sqn_jax.config.map_names import parse

if TYPE_CHECKING:
    from sqn_jax.policies.run_policies import Policy

TASKS: dict[str, Literal["evaluation points", "random pairs"]] = {
    "points": "evaluation points",
    "pairs": "random pairs",
}

CACHE = (
    "Programs, tables of maps and plans of the oracle are stored in the user's cache folder for "
    "the next start. The environment variable SQN_JAX_CACHE=DIR selects another folder; "
    "SQN_JAX_CACHE=off stores none."
)


_NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*(?:e[+-]?[0-9]+)?|\.[0-9]+(?:e[+-]?[0-9]+)?|nan|inf(?:inity)?)"


class Parser(argparse.ArgumentParser):
    """Reports errors as a ValueError, without the usage text."""

    def error(self, message: str) -> NoReturn:
        """Raise the message that argparse would print."""
        raise ValueError(message)

    def _print_message(self, message: str, file: Any = None) -> None:
        # Not that of argparse, which says nothing of a disk that is full.
        print(message, end="", file=file)


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the option --device."""
    parser.add_argument(
        "--device", choices=["cpu", "gpu", "tpu"], help="default: the fastest there is"
    )


def add_no_baselines(parser: argparse.ArgumentParser) -> None:
    """Add the option --no-baselines, and the name that it had."""
    what = "leave out the oracle and the wall follower"
    parser.add_argument("--no-baselines", action="store_true", help=what)
    parser.add_argument(
        "--no-references", action="store_true", dest="no_baselines", help=argparse.SUPPRESS
    )


def add_checkpoint(parser: argparse.ArgumentParser) -> None:
    """Add the option --checkpoint."""
    parser.add_argument(
        "--checkpoint",
        type=checkpoint,
        default="newest",
        metavar="WHICH",
        help="of a run: newest (default), best (in training) or the number of its chunks",
    )


def add_params(parser: argparse.ArgumentParser) -> None:
    """Add the option --params."""
    parser.add_argument(
        "--params",
        choices=["shipped", "latest", "average", "target"],
        default="shipped",
        help="which parameters of a run act: those it ships (default: the average where it keeps "
        "one), the latest, the average, or those of the target network",
    )


def tasks(argument: str) -> str:
    """Tasks to evaluate on: points, pairs, or a file."""
    if argument in TASKS or argument.endswith(".json"):
        return argument
    known = ", ".join(TASKS)
    raise argparse.ArgumentTypeError(f"is {argument!r}, expected {known} or a file ending in .json")


def suite_file(names: Sequence[str], given: Mapping[str, object]) -> Path | None:
    """The file of tasks among the values of --tasks, if there is one.

    Args:
        names: the values.
        given: options that the file has a say in, and their values; false where not given.

    Raises:
        ValueError: a file and something else, or an option that the file replaces.
    """
    files = [name for name in names if name not in TASKS]
    if not files:
        return None
    if len(names) > 1:
        raise ValueError(f"--tasks {' '.join(names)}: expected one file alone")
    for option, value in given.items():
        if value:
            raise ValueError(f"{option}: not with --tasks {files[0]}, where the file says it")
    return Path(files[0])


def add_epsilon(parser: argparse.ArgumentParser) -> None:
    """Add the option --epsilon with one value."""
    parser.add_argument(
        "--epsilon",
        type=number,
        default=0.0,
        metavar="E",
        help="probability of a random action in each step (default 0: greedy)",
    )


def find_policies(options: argparse.Namespace) -> list[Policy]:
    """The policies of `runs`, with the parameters and on the robot that other options say.

    Raises:
        ValueError: there is none of a name, it is damaged, or an option is out of its range.
    """
    from sqn_jax.policies.pretrained import find_policy
    from sqn_jax.policies.run_policies import with_bumper

    return [
        with_bumper(find_policy(name, options.checkpoint, options.params), options.bumper)
        for name in options.runs
    ]


def refuse_fixed_bumper(bumper: float | None, robot: Sequence[tuple[str, float]]) -> None:
    """Refuse --bumper beside a suite whose robot has one: the suite would win.

    Raises:
        ValueError: both say it.
    """
    if bumper is not None and "bumper" in dict(robot):
        raise ValueError("--bumper: not with a file of tasks whose robot says it")


def add_bumper(parser: argparse.ArgumentParser) -> None:
    """Add the option --bumper."""
    parser.add_argument(
        "--bumper",
        type=number,
        default=None,
        metavar="M",
        help="m; a move that would bring the body so near to what the beams show is not made "
        "(default: as trained, mostly none)",
    )


def pick(argument: str) -> int | Literal["worst"]:
    """A task of a suite by its number, or worst."""
    if argument == "worst":
        return "worst"
    if argument.isascii() and argument.isdigit() and len(argument) < 10:
        return int(argument)
    raise argparse.ArgumentTypeError(f"is {argument!r}, expected the number of a task or worst")


def checkpoint(argument: str) -> int | str:
    """A checkpoint of a run: newest, best, or its number of chunks."""
    if argument in ("newest", "best"):
        return argument
    if argument.isascii() and argument.isdigit():
        return int(argument)
    raise argparse.ArgumentTypeError(f"is {argument}, expected newest, best or a number")


def integer(argument: str) -> int:
    """A whole number in plain digits; Python would also take `1_000`, and digits of any script."""
    if not re.fullmatch(r"[+-]?[0-9]{1,30}", argument):
        raise argparse.ArgumentTypeError(f"is {argument!r}, expected an integer")
    return int(argument)


def number(argument: str) -> float:
    """A number in plain digits; whether it may be infinite or none is for others to say."""
    if not re.fullmatch(_NUMBER, argument, re.IGNORECASE):
        raise argparse.ArgumentTypeError(f"is {argument!r}, expected a number")
    return float(argument)


def folder(argument: str) -> Path:
    """The path of a folder."""
    if not argument.strip():
        raise argparse.ArgumentTypeError("is empty, expected the name of a folder")
    if any("\ud800" <= sign <= "\udfff" for sign in argument):
        raise argparse.ArgumentTypeError(f"is {argument!a}, expected a name in UTF-8")
    return Path(argument)


def single_maps(arguments: Sequence[str]) -> tuple[str, ...]:
    """The name of each single map that the arguments stand for."""
    return tuple(str(name) for argument in arguments for name in parse(argument).names)
