"""`sqn train`."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import re
import shlex
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
    """Start a run, or go on with one."""
    parser = _parser()
    given, unknown = parser.parse_known_args(normalized(arguments))
    settings = {
        name: value
        for name, value in vars(given).items()
        if name in _SETTINGS and value is not None
    }
    preset = given.preset or "quick"
    if given.help:
        parser.set_defaults(**configs.flat(configs.to_dict(PRESETS[preset])))
        parser.print_help()
        return 0
    if given.resume:
        config = _resumed_config(given, settings, unknown)
        return _run_training(config, given.run_dir, given)
    if unknown:
        raise ValueError(f"unrecognized arguments: {' '.join(unknown)}{_nearest(unknown, given)}")
    config = with_settings(PRESETS[preset], settings)
    run_dir = given.run_dir or _default_run_dir(config, preset)
    return _run_training(config, run_dir, given)


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
    # Not argparse's own: the defaults shown are those of the preset, which may be named after it.
    add("-h", "--help", action="store_true", help="show this and exit")
    add(
        "--preset",
        choices=list(PRESETS),
        help="where settings that are not given come from; their defaults below are those of the "
        "preset named beside --help (default: quick)",
    )
    add("--run-dir", type=folder, metavar="DIR", help="where to write (default: runs/NAME)")
    add(
        "--resume",
        action="store_true",
        help="go on with the run in --run-dir; takes no setting but --total-episodes",
    )
    add_device(parser)
    add(
        "--num-devices",
        type=int,
        metavar="N",
        help="divide the robots between N cores of the CPU or N accelerators (default: as many "
        "cores as help, or one accelerator)",
    )
    add(
        "--tensorboard",
        action="store_true",
        help="write for TensorBoard into the run folder, too",
    )
    add_settings(parser)
    return parser


def _formatter(prog: str) -> argparse.HelpFormatter:
    """Options and their descriptions side by side where the terminal is wide enough for that."""
    width = min(shutil.get_terminal_size().columns, 120) - 2
    return argparse.HelpFormatter(prog, max_help_position=40 if width > 100 else 8, width=width)


def _nearest(unknown: list[str], given: argparse.Namespace) -> str:
    """A proposal for an option that is misspelled, if one is near."""
    name = next((each for each in unknown if each.startswith("-")), "").partition("=")[0]
    options = [option(dotted) for dotted in vars(given)]
    near = [each for each in options if each.endswith(f".{name.lstrip('-')}")]
    near = near or difflib.get_close_matches(name, options, n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def _resumed_config(
    given: argparse.Namespace, settings: dict[str, Any], unknown: list[str]
) -> TrainConfig:
    """The settings in a run folder, perhaps with another number of episodes."""
    if given.run_dir is None:
        raise ValueError("--resume needs --run-dir, the folder of the run to go on with")
    excess = [
        option(name, value) + ("" if isinstance(value, bool) else f" {value}")
        for name, value in settings.items()
        if name != "total_episodes"
    ]
    excess += ([f"--preset {given.preset}"] if given.preset else []) + unknown
    if excess:
        raise ValueError(
            "--resume takes every setting from the run folder, expected no option but --run-dir, "
            "--total-episodes, --device, --num-devices and --tensorboard, got "
            f"{' '.join(excess)}"
        )
    from sqn_jax.storage.run_folder import RunFolder

    _, config = RunFolder.open(given.run_dir)
    return with_settings(config, settings)


def _default_run_dir(config: TrainConfig, preset: str) -> Path:
    stamp = time.strftime("%Y-%m-%d_%H%M%S")
    name = re.sub(r"[^A-Za-z0-9-]+", "_", config.maps.stem)[:40]
    return Path("runs") / f"{stamp}_{config.algo}_{name}_{preset}"


def _run_training(config: TrainConfig, run_dir: Path, given: argparse.Namespace) -> int:
    from sqn_jax.runs.train import train_session
    from sqn_jax.training import devices

    devices.use_cores()
    devices.require(given.device)
    config = _with_absolute_paths(config)
    command = f"sqn train --run-dir {shlex.quote(str(run_dir))} --resume"
    for name in ("device", "num_devices"):  # On others it would not be the same to the bit.
        value = getattr(given, name)
        command += "" if value is None else f" --{name.replace('_', '-')} {value}"
    train_session(
        config,
        run_dir,
        resume=given.resume,
        num_devices=given.num_devices,
        tensorboard=given.tensorboard,
        go_on=f"`{command}`",
    )
    return 0


def _with_absolute_paths(config: TrainConfig) -> TrainConfig:
    """Files and folders stay findable when the run is resumed from another folder."""
    from sqn_jax.policies.pretrained import PREFIX

    start = config.start_from
    if start and not start.startswith(PREFIX):
        start = str(Path(start).resolve())
    return dataclasses.replace(config, map=str(config.maps.resolved()), start_from=start)
