"""The command line: `sqn train`, `sqn evaluate`, `sqn render`, `sqn report`, `sqn map check`,
`sqn tasks`.

It only passes arguments to functions.

Exit codes: 0 success, 1 failure, 2 wrong arguments or unusable input (one line, no traceback); 130,
143 and 129 in a shell: stopped by SIGINT, SIGTERM or SIGHUP. If there is something to save, it is
saved first. If not, the signal itself ends the process at once; Python's `subprocess` reports this
as -2, -15 and -1.
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
from sqn_jax.cli.tasks import tasks
from sqn_jax.cli.train import train
from sqn_jax.runs.signals import Interrupted, end_at_once

USAGE = """usage: sqn COMMAND [OPTIONS]

  sqn train              train a robot, evaluate it, and draw what it did
  sqn evaluate RUN ...   compare trained robots and baselines on any maps, with noise
  sqn report RUN ...     the same as a page with pictures, the worst episodes first
  sqn render RUN ...     animations and pictures of what trained robots do on a map
  sqn map check FILE     describe a map, or say what is wrong with it
  sqn tasks ACTION       make or check a suite of tasks, on public benchmarks or fresh maps

`sqn COMMAND --help` lists the options of a command.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    try:
        code = _dispatch(list(sys.argv[1:] if arguments is None else arguments))
        _flush()
    except Interrupted as stop:
        print(f"\nsqn: {stop}", file=sys.stderr)
        code = stop.exit_code
    except BrokenPipeError:  # The reader, say `head`, has closed the pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    return code


def run() -> NoReturn:
    """Run `main` and end the process with its exit code.

    After a signal or a failure the process ends at once: threads of XLA or Orbax may still be
    running, and would crash or print errors while Python shuts down.
    """
    end_at_once()
    code = main()
    if code == 1 or code > 128:
        _flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _flush() -> None:
    if sys.stdout is not None:  # It is None where a process is started without one.
        sys.stdout.flush()


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0 if arguments else 2
    name, *command_arguments = arguments
    command = _COMMANDS.get(name)
    if command is None:
        return _refuse(f"unknown command {name!r}, expected one of {', '.join(_COMMANDS)}")
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            return command(command_arguments)
    except SystemExit as stop:  # After a help text.
        return int(stop.code or 0)
    except BrokenPipeError:
        raise
    except OSError as error:  # A full disk, say.
        has_file = error.filename and error.strerror
        return _fail(f"{error.filename}: {error.strerror}" if has_file else str(error))
    except ValueError as error:
        code = _refuse(str(error))
        if table := getattr(error, "table", ""):
            print(table, file=sys.stderr)
        return code
    except FloatingPointError as error:  # The run has diverged.
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
    "tasks": tasks,
}
