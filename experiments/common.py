"""What the experiments share: options, and training what is missing."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from sqn_jax.config import Algorithm, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.evaluation.agents import with_baselines
from sqn_jax.evaluation.compare import load_maps
from sqn_jax.evaluation.settings import Settings
from sqn_jax.runs.signals import Interrupted, end_at_once
from sqn_jax.runs.train import train_session
from sqn_jax.storage.checkpoint import NotSaved
from sqn_jax.storage.run_folder import RunFolder

RESULTS = Path(__file__).resolve().parent / "results"
ALGORITHMS: tuple[Algorithm, ...] = ("sqn", "r2d2", "dqn")


def recorded(name: str) -> Any:
    """A file of `experiments/results`."""
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that every experiment has."""
    parser.add_argument("--preset", choices=list(PRESETS), default="quick")
    parser.add_argument("--algos", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS))
    parser.add_argument(
        "--num-seeds", type=int, default=1, help="training seeds in one run (default 1)"
    )
    parser.add_argument("--total-episodes", type=int, help="instead of the preset's")
    parser.add_argument(
        "--episodes", type=int, help="under each evaluation seed (default 100, smoke 20)"
    )
    parser.add_argument("--eval-seeds", type=int, help="evaluation seeds (default 5, smoke 2)")
    parser.add_argument("--runs", type=Path, help="where runs are kept (default runs/table_PRESET)")
    parser.add_argument("--out", type=Path, help="results folder (default the runs' folder)")


def episodes_and_seeds(options: argparse.Namespace) -> tuple[int, int]:
    """How many episodes under how many evaluation seeds."""
    episodes, seeds = (20, 2) if options.preset == "smoke" else (100, 5)
    if options.episodes is not None:
        episodes = options.episodes
    if options.eval_seeds is not None:
        seeds = options.eval_seeds
    return episodes, seeds


def runs_folder(options: argparse.Namespace) -> Path:
    """Where the runs of these options are kept."""
    return options.runs or Path("runs") / f"table_{options.preset}"


def prepare(options: argparse.Namespace, settings: Settings) -> tuple[list[Path], Path]:
    """Train what is missing; returns the run folders and the folder for the results.

    What would be refused afterwards, an unusable map or folder, is refused before.
    """
    load_maps(with_baselines([], baselines=True), settings)
    out: Path = options.out or runs_folder(options)
    out.mkdir(parents=True, exist_ok=True)
    return train_missing(options), out


def train_missing(options: argparse.Namespace) -> list[Path]:
    """Train every agent of which there is no finished run; returns all run folders.

    The seeds of an agent are trained side by side in one run. A run that was stopped is resumed;
    with another number of seeds it is another run.

    Raises:
        ValueError: a folder holds a run with other settings.
    """
    folders = []
    for config in configs_of(options):
        folder = runs_folder(options) / run_name(config.algo, config)
        train_unless_done(config, folder)
        folders.append(folder)
    return folders


def run_name(arm: str, config: TrainConfig) -> str:
    """The name of the folder of a run, by what is trained and its seeds."""
    if config.num_seeds == 1:
        return f"{arm}_seed{config.seed}"
    return f"{arm}_seeds{config.seed}to{config.seed + config.num_seeds - 1}"


def configs_of(options: argparse.Namespace) -> list[TrainConfig]:
    """The settings of the run of each agent, with all its seeds.

    Raises:
        ValueError: a setting is out of its range.
    """
    if options.num_seeds < 1:
        raise ValueError(f"--num-seeds is {options.num_seeds}, expected at least 1")
    changes: dict[str, Any] = {"num_seeds": options.num_seeds}
    if options.total_episodes is not None:
        changes["total_episodes"] = options.total_episodes
    preset = PRESETS[options.preset]
    return [dataclasses.replace(preset, algo=algo, **changes) for algo in options.algos]


def train_unless_done(config: TrainConfig, folder: Path) -> None:
    """Train a run, or resume it, unless it is finished.

    Raises:
        ValueError: the folder holds a run with other settings.
    """
    begun = (folder / "config.json").is_file()
    if begun and RunFolder.open(folder)[1] != config:
        raise ValueError(
            f"run folder {folder}: holds a run with other settings, expected a folder for these "
            "(--runs or --out)"
        )
    if (folder / "summary.json").is_file():
        print(f"{folder} is trained")
        return
    train_session(config, folder, resume=begun, resume_command="the same command")


def run(main: Any) -> None:
    """Call an experiment's main; unusable input is one line and exit code 2."""
    name = Path(sys.argv[0]).name
    end_at_once()
    try:
        main()
    except (ValueError, OSError) as error:
        reason = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            reason = f"{error.filename}: {error.strerror}"
        print(f"{name}: {reason}", file=sys.stderr)
        raise SystemExit(1 if isinstance(error, NotSaved) else 2) from None
    except FloatingPointError as error:  # Learning has diverged.
        print(f"{name}: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except Interrupted as stop:
        print(f"\n{name}: {stop}", file=sys.stderr)
        raise SystemExit(stop.exit_code) from None
