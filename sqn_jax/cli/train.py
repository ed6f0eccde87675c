"""`sqn train`."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from sqn_jax import config as configs
from sqn_jax.cli.arguments import CACHE, Parser, add_device, folder, integer
from sqn_jax.cli.processes import OPTIONS, add_processes, cluster_of
from sqn_jax.cli.settings import add_settings, normalized, option, with_settings
from sqn_jax.config import TrainConfig
from sqn_jax.config.map_names import MapFile
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
    config = with_settings(PRESETS[preset], _of_start(settings) | settings)
    run_dir = options.run_dir or _default_run_dir(config, preset)
    return _run_training(config, run_dir, options)


def _of_start(settings: dict[str, Any]) -> dict[str, Any]:
    """The network and what it sees of a policy that training starts from, if any."""
    if not settings.get("start_from"):
        return {}
    from sqn_jax.policies.pretrained import config_of
    from sqn_jax.policies.run_policies import settings_to_start_from

    return settings_to_start_from(config_of(settings["start_from"]))


_DEFAULTS = configs.flat(configs.to_dict(TrainConfig()))
_SETTINGS = frozenset(_DEFAULTS)
"""Dotted names of all settings."""
_SWITCHES = [name for name, value in _DEFAULTS.items() if isinstance(value, bool)]
"""Those that are on or off."""


def _parser() -> Parser:
    parser = Parser(
        prog="sqn train",
        usage="sqn train [--preset NAME] [--run-dir DIR]\n"
        "                 [--SETTING VALUE ...]\n"
        "       sqn train --resume --run-dir DIR\n"
        "                 [--total-episodes N] [--map FILE]",
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
        help="resume the run in --run-dir; the only settings allowed are --total-episodes, and "
        "--map to say where the same map is now",
    )
    add_device(parser)
    add(
        "--num-devices",
        type=integer,
        metavar="N",
        help="divide seeds, then robots between N cores of the CPU or N accelerators, of all "
        "processes together (default: as many cores as speed it up, or one accelerator; all of "
        "several processes)",
    )
    add_processes(parser)
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
    """A suggestion for a misspelled option, if a similar one exists.

    One with `no-` in it is answered with one that switches off, and no other.
    """
    given = next((argument for argument in unknown if argument.startswith("-")), "")
    given = given.partition("=")[0]
    name = re.sub(r"(^--|\.)no-", r"\1", given)
    if is_off := name != given:
        known = {option(dotted): option(dotted, False) for dotted in _SWITCHES}
    else:
        known = {option(dotted): option(dotted) for dotted in vars(options)}
    leaf = name.lstrip("-").rpartition(".")[2]
    similar = [spelling for spelling in known if spelling.endswith(f".{leaf}")]
    similar = similar or difflib.get_close_matches(name, known, n=1, cutoff=0.7 if is_off else 0.6)
    return f" (did you mean {known[similar[0]]}?)" if similar else ""


def _resumed_config(
    options: argparse.Namespace, settings: dict[str, Any], unknown: list[str]
) -> TrainConfig:
    """The settings in a run folder, maybe with more episodes, or another place of the map."""
    if options.run_dir is None:
        raise ValueError("--resume needs --run-dir, the folder of the run to resume")
    excess = [
        option(name, value) + ("" if isinstance(value, bool) else f" {value}")
        for name, value in settings.items()
        if name not in ("total_episodes", "map")
    ]
    excess += ([f"--preset {options.preset}"] if options.preset else []) + unknown
    if excess:
        raise ValueError(
            "--resume takes every setting from the run folder, expected no option but those "
            "of several processes, --map, --run-dir, --total-episodes, --device, --num-devices and "
            "--tensorboard, got "
            f"{' '.join(excess)}"
        )
    from sqn_jax.storage.run_folder import RunFolder

    _, config = RunFolder.open(options.run_dir)
    for name in config.maps.names if "map" not in settings else ():
        if isinstance(name, MapFile) and not Path(name.path).exists():
            raise ValueError(f"map {name}: not found, expected it there, or --map with its place")
    return with_settings(config, settings)


def _default_run_dir(config: TrainConfig, preset: str) -> Path:
    stamp = time.strftime("%Y-%m-%d_%H%M%S")
    name = re.sub(r"[^A-Za-z0-9-]+", "_", config.maps.stem)[:40]
    return Path("runs") / f"{stamp}_{config.algo}_{name}_{preset}_seed{config.seed}"


@contextmanager
def _new_folder(path: Path) -> Iterator[Path]:
    """Make a folder of this name, or with a number after it that no other process has.

    Nothing is left of it where nothing was written to it.
    """
    made = next((folder for folder in (path.parent, path) if not folder.exists()), path)
    name, number = path.name, 1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            with suppress(FileExistsError):
                path.mkdir()
                break
            number += 1
            path = path.with_name(f"{name}_{number}")
    except OSError as error:
        raise ValueError(f"run folder {path}: cannot be written ({error.strerror})") from None
    try:
        yield path
    finally:
        with suppress(OSError):  # Not empty.
            path.rmdir()
            if made == path.parent:
                path.parent.rmdir()


def _run_training(config: TrainConfig, run_dir: Path, options: argparse.Namespace) -> int:
    from sqn_jax.runs.cluster import joined

    config = _with_absolute_paths(config)
    with (
        joined(cluster_of(options), options.device),
        nullcontext(run_dir) if options.run_dir else _new_folder(run_dir) as folder,
    ):
        _train(config, folder, options)
    return 0


def _train(config: TrainConfig, run_dir: Path, options: argparse.Namespace) -> None:
    from sqn_jax.runs.train import train_session
    from sqn_jax.storage.manifest import Mismatch
    from sqn_jax.storage.run_folder import resume_command

    same = ""
    for name in ("device", "num_devices", *OPTIONS):  # With others the results would differ.
        value = getattr(options, name)
        same += "" if value is None else f" --{name.replace('_', '-')} {value}"
    try:
        train_session(
            config,
            run_dir,
            resume=options.resume,
            num_devices=options.num_devices,
            tensorboard=options.tensorboard,
            resume_command=f"`{resume_command(run_dir, same)}`",
        )
    except Mismatch as error:
        if options.map is None or any(not row[0].startswith("map.") for row in error.rows):
            raise
        names = ", ".join(row[0] for row in error.rows)
        raise ValueError(
            f"--map {options.map}: differs in {names}, expected the map of the run in {run_dir}"
        ) from None


def _with_absolute_paths(config: TrainConfig) -> TrainConfig:
    """Absolute paths, so that the run can be resumed from another folder."""
    from sqn_jax.policies.pretrained import PREFIX

    start = config.start_from
    if start and not start.startswith(PREFIX):
        start = str(Path(start).resolve())
    return dataclasses.replace(config, map=str(config.maps.resolved()), start_from=start)
