"""The command line: `sqn train` and `sqn map check`. It wires words to functions, no more.

Exit codes: 0 done, 1 failure, 2 wrong arguments or unusable input (one line, no traceback),
130 and 143 stopped by SIGINT or SIGTERM after saving.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import re
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from sqn_jax.config import TrainConfig
from sqn_jax.presets import PRESETS

USAGE = """usage: sqn COMMAND [OPTIONS]

  sqn train            train a robot, evaluate it, and draw what it did
  sqn map check FILE   say what a map offers, or what is wrong with it

`sqn COMMAND --help` lists the options of a command.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0 if words else 2
    command = _COMMANDS.get(words[0])
    if command is None:
        return _refuse(f"unknown command {words[0]!r}, expected one of {', '.join(_COMMANDS)}")
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            return command(words[1:])
    except ValueError as error:
        return _refuse(str(error))


def _refuse(message: str) -> int:
    print(f"sqn: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _show_warning(message: Warning | str, *_: object) -> None:
    print(f"sqn: warning: {message}", file=sys.stderr)


class _Parser(argparse.ArgumentParser):
    """Reports what is wrong as a ValueError, without the usage text."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(message)


def _train(words: list[str]) -> int:
    parser = _Parser(prog="sqn train", add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", choices=list(PRESETS))
    parser.add_argument("--run-dir", "--run_dir", type=Path)
    parser.add_argument("--resume", action="store_true")
    own, others = parser.parse_known_args(words)
    if own.resume:
        if own.run_dir is None:
            raise ValueError("--resume needs --run-dir, the folder of the run to go on with")
        if others or own.preset:
            raise ValueError(
                "--resume takes every setting from the run folder, expected no option but "
                f"--run-dir, got {' '.join(others) or '--preset'}"
            )
        from sqn_jax.runlog import RunFolder

        _, config = RunFolder.open(own.run_dir)
        return _run_training(config, own.run_dir, resume=True)
    preset = own.preset or "quick"
    config = _parse_config(others, preset)
    run_dir = own.run_dir or _default_run_dir(config, preset)
    return _run_training(config, run_dir, resume=False)


def _parse_config(words: list[str], preset: str) -> TrainConfig:
    """Overwrite a preset's fields by options `--field value` and `--group.field value`."""
    import tyro

    description = (
        "Train an agent, evaluate it, and draw what it did. Besides the options below: "
        f"--preset {{{','.join(PRESETS)}}} (default quick) chooses the defaults shown here, "
        "--run-dir DIR where to write (default runs/NAME), --resume goes on with --run-dir."
    )
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(
                TrainConfig,
                prog="sqn train",
                description=description,
                default=PRESETS[preset],
                args=words,
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise ValueError(_condense(told.getvalue())) from None


def _condense(box: str) -> str:
    """One line out of the framed error message that tyro prints."""
    lines = [re.sub(r"^[│\s]+|[│\s]+$", "", line) for line in box.splitlines()]
    message: list[str] = []
    for line in lines:
        if line.startswith(("╭", "╰")) or not line:
            continue
        if line.startswith("─"):
            break
        message.append(line)
    told = " ".join(message) or "wrong arguments"
    # "Error parsing learner: learner.n_step is 0, ...": the group is said twice.
    return re.sub(r"^Error parsing (?:(--\S+: )|\S+: )", r"\1", told)


def _default_run_dir(config: TrainConfig, preset: str) -> Path:
    stamp = time.strftime("%Y-%m-%d_%H%M%S")
    return Path("runs") / f"{stamp}_{config.algo}_{Path(config.map).stem}_{preset}"


def _run_training(config: TrainConfig, run_dir: Path, *, resume: bool) -> int:
    from sqn_jax.session import Stopped, train_session

    config = _with_absolute_map(config)
    try:
        train_session(config, run_dir, resume=resume)
    except Stopped as stop:
        print(f"saved; go on with `sqn train --run-dir {run_dir} --resume`", file=sys.stderr)
        return stop.exit_code
    return 0


def _with_absolute_map(config: TrainConfig) -> TrainConfig:
    """A map file stays findable when the run is resumed from another folder."""
    path = Path(config.map)
    if path.suffix and path.exists():
        return dataclasses.replace(config, map=str(path.resolve()))
    return config


def _map(words: list[str]) -> int:
    parser = _Parser(prog="sqn map", description="Look at maps.", allow_abbrev=False)
    parser.add_argument("action", choices=["check"], help="check: report on a map")
    parser.add_argument("file", help="a ROS map_server YAML file, or a map of the project by name")
    parser.add_argument("--robot-radius", type=float, default=0.1, help="m (default 0.1)")
    options = parser.parse_args(words)
    from sqn_jax.maps import load_map
    from sqn_jax.maps.check import describe

    occupancy_map = load_map(options.file, robot_radius=options.robot_radius)
    print(describe(occupancy_map, options.robot_radius))
    return 0


_COMMANDS: dict[str, Callable[[list[str]], int]] = {"train": _train, "map": _map}
