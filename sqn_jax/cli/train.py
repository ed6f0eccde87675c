"""`sqn train`."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import re
import shutil
import time
from pathlib import Path
from typing import Any

from sqn_jax import config as configs
from sqn_jax.cli.arguments import CACHE, Parser, add_device, folder
from sqn_jax.cli.settings import add_settings, normalized, option, with_settings
from sqn_jax.config import TrainConfig
from sqn_jax.config.presets import PRESETS


def train(arguments: list[str]) -> int:
    """Start a run, or resume one."""
    parser = _parser()
    options, unknown = parser.parse_known_args(normalized(arguments))
    settings = {
        name: value
        for name, value in vars(options).items()
        if name in _SETTINGS and value is not None
    }
    preset = options.preset or "quick"
    if options.help:
        parser.set_defaults(**configs.flat(configs.to_dict(PRESETS[preset])))
        parser.print_help()
        return 0
    if options.resume:
        config = _resumed_config(options, settings, unknown)
        return _run_training(config, options.run_dir, options)
    if unknown:
        raise ValueError(
            f"unrecognized arguments: {' '.join(unknown)}{_suggestion(unknown, options)}"
        )
    config = with_settings(PRESETS[preset], settings)
    run_dir = options.run_dir or _default_run_dir(config, preset)
    return _run_training(config, run_dir, options)


_SETTINGS = frozenset(configs.flat(configs.to_dict(TrainConfig())))
"""Dotted names of all settings."""


def _parser() -> Parser:
    parser = Parser(
        prog="sqn train",
        usage="sqn train [--preset NAME] [--run-dir DIR] [--SETTING VALUE ...]\n"
        "       sqn train --resume --run-dir DIR [--total-episodes N]",
        description="Train an agent, evaluate it, and draw what it did.",
        epilog=CACHE,
        formatter_class=_formatter,
        add_help=False,
        allow_abbrev=False,
    )
    add = parser.add_argument
    # Not that of argparse: it shows the defaults of the preset, which may be given after it.
    add("-h", "--help", action="store_true", help="show this and exit")
    add(
        "--preset",
        choices=list(PRESETS),
        help="the defaults of settings that are not given; --help shows those of the preset given "
        "with it (default: quick)",
    )
    add("--run-dir", type=folder, metavar="DIR", help="the run folder (default: runs/NAME)")
    add(
        "--resume",
        action="store_true",
        help="resume the run in --run-dir; the only setting allowed is --total-episodes",
    )
    add_device(parser)
    add(
        "--num-devices",
        type=int,
        metavar="N",
        help="divide the robots between N cores of the CPU or N accelerators (default: as many "
        "cores as speed it up, or one accelerator)",
    )
    add(
        "--tensorboard",
        action="store_true",
        help="also write for TensorBoard into the run folder",
    )
    add_settings(parser)
    return parser


def _formatter(prog: str) -> argparse.HelpFormatter:
    """Options and descriptions side by side if the terminal is wide enough."""
    width = min(shutil.get_terminal_size().columns, 120) - 2
    return argparse.HelpFormatter(prog, max_help_position=40 if width > 100 else 8, width=width)


def _suggestion(unknown: list[str], options: argparse.Namespace) -> str:
    """A suggestion for a misspelled option, if a similar one exists."""
    name = next((argument for argument in unknown if argument.startswith("-")), "")
    name = name.partition("=")[0]
    known = [option(dotted) for dotted in vars(options)]
    similar = [spelling for spelling in known if spelling.endswith(f".{name.lstrip('-')}")]
    similar = similar or difflib.get_close_matches(name, known, n=1)
    return f" (did you mean {similar[0]}?)" if similar else ""


def _resumed_config(
    options: argparse.Namespace, settings: dict[str, Any], unknown: list[str]
) -> TrainConfig:
    """The settings in a run folder, maybe with another number of episodes."""
    if options.run_dir is None:
        raise ValueError("--resume needs --run-dir, the folder of the run to resume")
    excess = [
        option(name, value) + ("" if isinstance(value, bool) else f" {value}")
        for name, value in settings.items()
        if name != "total_episodes"
    ]
    excess += ([f"--preset {options.preset}"] if options.preset else []) + unknown
    if excess:
        raise ValueError(
            "--resume takes every setting from the run folder, expected no option but --run-dir, "
            "--total-episodes, --device, --num-devices and --tensorboard, got "
            f"{' '.join(excess)}"
        )
    from sqn_jax.storage.run_folder import RunFolder

    _, config = RunFolder.open(options.run_dir)
    return with_settings(config, settings)


def _default_run_dir(config: TrainConfig, preset: str) -> Path:
    stamp = time.strftime("%Y-%m-%d_%H%M%S")
    name = re.sub(r"[^A-Za-z0-9-]+", "_", config.maps.stem)[:40]
    return Path("runs") / f"{stamp}_{config.algo}_{name}_{preset}"


def _run_training(config: TrainConfig, run_dir: Path, options: argparse.Namespace) -> int:
    from sqn_jax.runs.train import train_session
    from sqn_jax.storage.run_folder import resume_command
    from sqn_jax.training import devices

    devices.use_cores()
    devices.require(options.device)
    config = _with_absolute_paths(config)
    same = ""
    for name in ("device", "num_devices"):  # With others the results would differ.
        value = getattr(options, name)
        same += "" if value is None else f" --{name.replace('_', '-')} {value}"
    train_session(
        config,
        run_dir,
        resume=options.resume,
        num_devices=options.num_devices,
        tensorboard=options.tensorboard,
        resume_command=f"`{resume_command(run_dir, same)}`",
    )
    return 0


def _with_absolute_paths(config: TrainConfig) -> TrainConfig:
    """Absolute paths, so that the run can be resumed from another folder."""
    from sqn_jax.policies.pretrained import PREFIX

    start = config.start_from
    if start and not start.startswith(PREFIX):
        start = str(Path(start).resolve())
    return dataclasses.replace(config, map=str(config.maps.resolved()), start_from=start)
