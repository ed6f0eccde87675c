"""The command line: `sqn train`, `sqn evaluate`, `sqn render`, `sqn report`, `sqn play`,
`sqn export`, `sqn map check`, `sqn tasks`.

It only passes arguments to functions.

Exit codes: 0 success, 1 failure, 2 wrong arguments or unusable input (one line, no traceback); 130,
143, 129 and 141 in a shell: stopped by SIGINT, SIGTERM, SIGHUP or a reader that left. If there is
something to save, it is saved first. If not, the signal itself ends the process at once; Python's
`subprocess` reports this as -2, -15 and -1.
"""

from __future__ import annotations

import gc
import os
import shutil
import sys
import textwrap
import warnings
from collections.abc import Callable, Sequence
from typing import NoReturn

from sqn_jax import __version__
from sqn_jax.cli.evaluate import evaluate
from sqn_jax.cli.export import export
from sqn_jax.cli.maps import check_map
from sqn_jax.cli.pictures import render, report
from sqn_jax.cli.play import play
from sqn_jax.cli.tasks import tasks
from sqn_jax.cli.train import train
from sqn_jax.outside.messages import say, say_lines
from sqn_jax.runs import streams
from sqn_jax.runs.signals import Interrupted, end_at_once

_SUMMARIES = {
    "train": "train a robot, evaluate it, and draw what it did",
    "evaluate RUN ...": "compare trained robots and baselines on any maps, with noise",
    "report RUN ...": "the same as a page with pictures, the worst episodes first",
    "render RUN ...": "animations and pictures of what trained robots do on a map",
    "play POLICY": "a page that runs a trained robot in the browser, on maps that you draw",
    "export POLICY": "write a trained robot's policy for its computer: ONNX, or NumPy alone",
    "map check FILE": "describe a map, or say what is wrong with it",
    "tasks ACTION": "make or check a suite of tasks, on public benchmarks or fresh maps",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    try:
        return _dispatch(list(sys.argv[1:] if arguments is None else arguments))
    except Interrupted as stop:
        say(f"sqn: {stop}", start="\n", error=True)
        return stop.exit_code


def run() -> NoReturn:
    """Run `main` and end the process with its exit code, at once: all files are written.

    To take down what JAX has traced takes Python a second, and after a signal or a failure threads
    of XLA or Orbax may still be running, which would crash or print errors meanwhile, and JAX would
    wait for other processes of a run.
    """
    end_at_once()
    streams.install()
    # What JAX traces is a million objects that stay: to look through them for garbage as often as
    # Python does by default takes a tenth of the time of a start.
    gc.set_threshold(50_000, 20, 100)
    code = main()
    failure = streams.failure()
    if failure is not None and code == 0:
        code = _fail(failure) if failure else 1
    os._exit(code)


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        say_lines(_usage().splitlines())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        say(f"sqn {__version__}")
        return 0
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
    except OSError as error:  # A full disk, say.
        has_file = error.filename and error.strerror
        return _fail(f"{error.filename}: {error.strerror}" if has_file else str(error))
    except ValueError as error:
        code = _refuse(str(error))
        if table := getattr(error, "table", ""):
            say_lines(table.split("\n"), error=True)
        return code
    except FloatingPointError as error:  # The run has diverged.
        return _fail(str(error))


def _usage() -> str:
    """The commands, in lines that fit the terminal."""
    width = shutil.get_terminal_size().columns
    ends = (
        "`sqn COMMAND --help` lists the options of a command, `sqn --version` prints the version."
    )
    indent = " " * 25
    commands = [
        textwrap.fill(f"{'  sqn ' + name:25}{summary}", width, subsequent_indent=indent)
        for name, summary in _SUMMARIES.items()
    ]
    return "\n".join(
        ["usage: sqn COMMAND [OPTIONS]", "", *commands, "", textwrap.fill(ends, width)]
    )


def _refuse(message: str) -> int:
    say(f"sqn: {' '.join(message.split())}", error=True)
    return 2


def _fail(message: str) -> int:
    _refuse(message)
    return 1


def _show_warning(message: Warning | str, *_: object) -> None:
    say(f"sqn: warning: {message}", error=True)


_COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": train,
    "evaluate": evaluate,
    "report": report,
    "render": render,
    "play": play,
    "export": export,
    "map": check_map,
    "tasks": tasks,
}
