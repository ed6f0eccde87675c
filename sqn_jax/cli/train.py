"""`sqn train`."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import re
import shlex
import time
from pathlib import Path

from sqn_jax.cli.words import CACHE, Parser, add_device, folder
from sqn_jax.config import TrainConfig
from sqn_jax.config.presets import PRESETS


def train(words: list[str]) -> int:
    """Start a run, or go on with one."""
    parser = Parser(prog="sqn train", add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", choices=list(PRESETS))
    parser.add_argument("--run-dir", "--run_dir", type=folder)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--num-devices", "--num_devices", type=int)
    parser.add_argument("--tensorboard", action="store_true")
    add_device(parser)
    own, others = parser.parse_known_args(words)
    if own.resume:
        config = _resumed_config(own, others)
        return _run_training(config, own.run_dir, own)
    preset = own.preset or "quick"
    config = _parse_config(others, preset)
    run_dir = own.run_dir or _default_run_dir(config, preset)
    return _run_training(config, run_dir, own)


def _resumed_config(own: argparse.Namespace, others: list[str]) -> TrainConfig:
    """The settings in a run folder, perhaps with another number of episodes."""
    if own.run_dir is None:
        raise ValueError("--resume needs --run-dir, the folder of the run to go on with")
    parser = Parser(prog="sqn train --resume", add_help=False, allow_abbrev=False)
    parser.add_argument("--total-episodes", "--total_episodes", type=int)
    changes, unknown = parser.parse_known_args(others)
    if unknown or own.preset:
        raise ValueError(
            "--resume takes every setting from the run folder, expected no option but --run-dir, "
            "--total-episodes, --device, --num-devices and --tensorboard, got "
            f"{' '.join(unknown) or '--preset'}"
        )
    from sqn_jax.storage.run_folder import RunFolder

    _, config = RunFolder.open(own.run_dir)
    if changes.total_episodes is None:
        return config
    return dataclasses.replace(config, total_episodes=changes.total_episodes)


def _parse_config(words: list[str], preset: str) -> TrainConfig:
    """Overwrite a preset's fields by options `--field value` and `--group.field value`."""
    import tyro

    description = (
        "Train an agent, evaluate it, and draw what it did. Besides the options below: "
        f"--preset {{{','.join(PRESETS)}}} (default quick) chooses the defaults shown here, "
        "--run-dir DIR where to write (default runs/NAME), --resume goes on with --run-dir, "
        "and takes no other setting than --total-episodes, "
        "--device cpu|gpu|tpu where to compute (default an accelerator, if there is one), "
        "--num-devices N divides the robots between N cores of the CPU or N accelerators (default "
        "as many cores as help, or one accelerator), --tensorboard writes for TensorBoard into "
        "the run folder. "
        f"{CACHE}"
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
    name = re.sub(r"[^A-Za-z0-9-]+", "_", Path(config.map).stem)[:40]
    return Path("runs") / f"{stamp}_{config.algo}_{name}_{preset}"


def _run_training(config: TrainConfig, run_dir: Path, own: argparse.Namespace) -> int:
    from sqn_jax.runs.train import train_session
    from sqn_jax.training import devices

    devices.use_cores()
    devices.require(own.device)
    config = _with_absolute_paths(config)
    command = f"sqn train --run-dir {shlex.quote(str(run_dir))} --resume"
    for name in ("device", "num_devices"):  # On others it would not be the same to the bit.
        value = getattr(own, name)
        command += "" if value is None else f" --{name.replace('_', '-')} {value}"
    train_session(
        config,
        run_dir,
        resume=own.resume,
        num_devices=own.num_devices,
        tensorboard=own.tensorboard,
        go_on=f"`{command}`",
    )
    return 0


def _with_absolute_paths(config: TrainConfig) -> TrainConfig:
    """Files and folders stay findable when the run is resumed from another folder."""
    from sqn_jax.maps import weighted_names
    from sqn_jax.policies.pretrained import PREFIX

    start = config.start_from
    if start and not start.startswith(PREFIX):
        config = dataclasses.replace(config, start_from=str(Path(start).resolve()))
    names = weighted_names(config.map)
    files = {name: Path(name).resolve() for name, _ in names if _is_map_file(Path(name))}
    if not files:
        return config
    words = [f"{files.get(name, name)}" + f"*{weight}" * (weight > 1) for name, weight in names]
    return dataclasses.replace(config, map=",".join(words))


def _is_map_file(path: Path) -> bool:
    return bool(path.suffix) and path.exists()
