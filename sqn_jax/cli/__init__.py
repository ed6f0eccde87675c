"""The command line: `sqn train`, `sqn evaluate`, `sqn render`, `sqn report`, `sqn map check`.

It wires arguments to functions, no more.

Exit codes: 0 done, 1 failure, 2 wrong arguments or unusable input (one line, no traceback); 130,
143 and 129 as a shell sees them: stopped by SIGINT, SIGTERM or SIGHUP, after saving where there was
something to save. Where not, the signal itself ends the process, at once, which a parent that is
no shell sees as such (-2, -15 and -1 in Python's `subprocess`).
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import NoReturn

from sqn_jax.cli.evaluate import evaluate
from sqn_jax.cli.maps import check_map
from sqn_jax.cli.pictures import render, report
from sqn_jax.cli.train import train
from sqn_jax.runs.signals import Interrupted, end_at_once

USAGE = """usage: sqn COMMAND [OPTIONS]

  sqn train              train a robot, evaluate it, and draw what it did
  sqn evaluate RUN ...   compare trained robots on any maps, with noise, beside references
  sqn report RUN ...     the same as a page with pictures, what went worst first
  sqn render RUN ...     films and pictures of what trained robots do on a map
  sqn map check FILE     say what a map offers, or what is wrong with it

`sqn COMMAND --help` lists the options of a command.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    try:
        code = _dispatch(list(sys.argv[1:] if arguments is None else arguments))
        sys.stdout.flush()
    except Interrupted as stop:
        print(f"\nsqn: {stop}", file=sys.stderr)
        code = stop.exit_code
    except BrokenPipeError:  # Whoever read along, say `head`, has enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    return code


def run() -> NoReturn:
    """The process `sqn`: end with the exit code of `main`.

    After a signal or a failure at once: threads of XLA or Orbax may still be at work, and would
    crash or complain while Python is taken down.
    """
    end_at_once()
    code = main()
    if code == 1 or code > 128:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0 if arguments else 2
    name, *of_command = arguments
    command = _COMMANDS.get(name)
    if command is None:
        return _refuse(f"unknown command {name!r}, expected one of {', '.join(_COMMANDS)}")
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            return command(of_command)
    except SystemExit as stop:  # After a help text.
        return int(stop.code or 0)
    except BrokenPipeError:
        raise
    except OSError as error:  # A full disk, say.
        named = error.filename and error.strerror
        return _fail(f"{error.filename}: {error.strerror}" if named else str(error))
    except ValueError as error:
        code = _refuse(str(error))
        if table := getattr(error, "table", ""):
            print(table, file=sys.stderr)
        return code
    except FloatingPointError as error:  # Learning has diverged.
        return _fail(str(error))


def _refuse(message: str) -> int:
    print(f"sqn: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _fail(message: str) -> int:
    _refuse(message)
    return 1


def _show_warning(message: Warning | str, *_: object) -> None:
    print(f"sqn: warning: {message}", file=sys.stderr)


_COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": train,
    "evaluate": evaluate,
    "report": report,
    "render": render,
    "map": check_map,
}
