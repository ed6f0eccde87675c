"""The command line: `sqn train`, `sqn evaluate`, `sqn render`, `sqn report`, `sqn map check`.

It wires words to functions, no more.

Exit codes: 0 done, 1 failure, 2 wrong arguments or unusable input (one line, no traceback),
130 and 143 stopped by SIGINT or SIGTERM after saving.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NoReturn

from sqn_jax.config import TrainConfig
from sqn_jax.presets import PAPER_MAPS, PRESETS
from sqn_jax.signals import Interrupted, interruptible

TASKS: dict[str, Literal["evaluation points", "random pairs"]] = {
    "points": "evaluation points",
    "pairs": "random pairs",
}

CACHE = (
    "Compiled programs are kept in the user's cache folder for the next start: SQN_JAX_CACHE=DIR "
    "in the environment names another folder, SQN_JAX_CACHE=off keeps none."
)

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
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with interruptible():
            code = _dispatch(words)
        sys.stdout.flush()
    except Interrupted as stop:
        print(f"\nsqn: stopped by {stop.signal.name}", file=sys.stderr)
        code = stop.exit_code
    except BrokenPipeError:  # Whoever read along, say `head`, has enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    return code


def _dispatch(words: list[str]) -> int:
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
    except SystemExit as stop:  # After a help text.
        return int(stop.code or 0)
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
    parser.add_argument("--run-dir", "--run_dir", type=_folder)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--num-devices", "--num_devices", type=int)
    parser.add_argument("--tensorboard", action="store_true")
    own, others = parser.parse_known_args(words)
    if own.resume:
        if own.run_dir is None:
            raise ValueError("--resume needs --run-dir, the folder of the run to go on with")
        if others or own.preset:
            raise ValueError(
                "--resume takes every setting from the run folder, expected no option but "
                f"--run-dir, --num-devices and --tensorboard, got {' '.join(others) or '--preset'}"
            )
        from sqn_jax.runlog import RunFolder

        _, config = RunFolder.open(own.run_dir)
        return _run_training(config, own.run_dir, own)
    preset = own.preset or "quick"
    config = _parse_config(others, preset)
    run_dir = own.run_dir or _default_run_dir(config, preset)
    return _run_training(config, run_dir, own)


def _folder(word: str) -> Path:
    if not word.strip():
        raise argparse.ArgumentTypeError("is empty, expected the name of a folder")
    return Path(word)


def _parse_config(words: list[str], preset: str) -> TrainConfig:
    """Overwrite a preset's fields by options `--field value` and `--group.field value`."""
    import tyro

    description = (
        "Train an agent, evaluate it, and draw what it did. Besides the options below: "
        f"--preset {{{','.join(PRESETS)}}} (default quick) chooses the defaults shown here, "
        "--run-dir DIR where to write (default runs/NAME), --resume goes on with --run-dir, "
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
    return Path("runs") / f"{stamp}_{config.algo}_{Path(config.map).stem}_{preset}"


def _run_training(config: TrainConfig, run_dir: Path, own: argparse.Namespace) -> int:
    from sqn_jax.checkpoint import FOLDER
    from sqn_jax.session import Stopped, train_session

    config = _with_absolute_map(config)
    try:
        train_session(
            config,
            run_dir,
            resume=own.resume,
            num_devices=own.num_devices,
            tensorboard=own.tensorboard,
        )
    except Stopped as stop:
        print(f"saved; go on with `sqn train --run-dir {run_dir} --resume`", file=sys.stderr)
        return stop.exit_code
    except KeyboardInterrupt:  # In the final evaluation, say: the training is saved.
        if any((run_dir / FOLDER).glob("[0-9]*")):
            print(f"\ngo on with `sqn train --run-dir {run_dir} --resume`", file=sys.stderr)
        raise
    return 0


def _with_absolute_map(config: TrainConfig) -> TrainConfig:
    """A map file stays findable when the run is resumed from another folder."""
    path = Path(config.map)
    if path.suffix and path.exists():
        return dataclasses.replace(config, map=str(path.resolve()))
    return config


def _evaluate(words: list[str]) -> int:
    parser = _Parser(
        prog="sqn evaluate",
        description="Drive greedy episodes of trained policies; every agent gets the same tasks.",
        epilog=CACHE,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("runs", nargs="*", metavar="RUN", help="run folders, or pretrained:NAME; none: references")
    add("--maps", nargs="+", default=list(PAPER_MAPS), help="names or files (default: the four)")
    add("--tasks", nargs="+", choices=list(TASKS), default=["points"], help="default: points")
    add("--episodes", type=int, default=100, help="under each evaluation seed (default 100)")
    add("--eval-seeds", type=int, default=5, help="how many evaluation seeds (default 5)")
    add("--seed", type=int, default=1_000, help="the first of them (default 1000)")
    add("--velocity-noise", nargs="+", type=float, default=[], metavar="S", help="e.g. 0.1 0.2")
    add("--range-noise", nargs="+", type=float, default=[], metavar="P", help="e.g. 0.2 0.4")
    add("--noise-unit", choices=["relative", "absolute"], help="default: as trained")
    add("--max-steps", type=int, default=0, help="steps an episode (default: as each map says)")
    add("--goal-radius", nargs="+", type=float, default=[0.3, 0.5], metavar="M", help="m")
    add("--no-references", action="store_true", help="leave out the oracle and the wall follower")
    add("--out", type=Path, help="JSON file; one record an episode goes beside it as .jsonl")
    options = parser.parse_args(words)
    if not options.runs and options.no_references:
        raise ValueError("nothing to evaluate: name a run folder or pretrained:NAME")
    from sqn_jax import compare
    from sqn_jax.pretrained import find_policy
    from sqn_jax.scores import results_table
    from sqn_jax.session import evaluate_session

    noise = [(level, 0.0) for level in options.velocity_noise if level != 0]
    noise += [(0.0, level) for level in options.range_noise if level != 0]
    settings = compare.Settings(
        maps=tuple(options.maps),
        tasks=tuple(TASKS[word] for word in options.tasks),
        episodes=options.episodes,
        eval_seeds=options.eval_seeds,
        seed=options.seed,
        noise=((0.0, 0.0), *noise),
        noise_unit=options.noise_unit,
        goal_radii=tuple(options.goal_radius),
        max_steps=options.max_steps,
    )
    if options.out is not None:
        _require_writable(options.out)
    learnt = compare.group_policies([find_policy(word) for word in options.runs])
    agents = compare.with_references(learnt, references=not options.no_references)
    evaluation = evaluate_session(agents, settings, options.out)
    print(results_table(evaluation["results"]))
    for told in evaluation["comparisons"]:
        low, high = told["ci95"]
        print(
            f"{told['first']} beats {told['second']} with probability "
            f"{told['probability']:.2f} [{low:.2f}, {high:.2f}] over training seeds"
        )
    if options.out is not None:
        print(f"wrote {options.out} and {options.out.with_suffix('.jsonl')}")
    return 0


def _report(words: list[str]) -> int:
    parser = _Parser(
        prog="sqn report",
        description="Drive greedy episodes of trained policies and write one page about them: "
        "what went worst, success and time steps, curves, paths, an animation, settings.",
        epilog=CACHE,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("runs", nargs="*", metavar="RUN", help="run folders, or pretrained:NAME")
    add("--maps", nargs="+", help="names or files (default: the map of the first run)")
    add("--tasks", nargs="+", choices=list(TASKS), default=["points"], help="default: points")
    add("--episodes", type=int, default=100, help="under each evaluation seed (default 100)")
    add("--eval-seeds", type=int, default=1, help="how many evaluation seeds (default 1)")
    add("--seed", type=int, default=1_000, help="the first of them (default 1000)")
    add("--no-references", action="store_true", help="leave out the oracle and the wall follower")
    add("--out", type=Path, default=Path("report.html"), help="default: report.html")
    options = parser.parse_args(words)
    if not options.runs:
        raise ValueError("nothing to report on: name a run folder or pretrained:NAME")
    try:
        from sqn_jax import report
    except ModuleNotFoundError as error:
        if error.name != "matplotlib":
            raise
        raise ValueError("Matplotlib is not installed (pip install 'sqn_jax[viz]')") from None
    from sqn_jax.compare import Settings

    report.require_writable(options.out)
    runs = report.read_runs(options.runs)
    config = runs[0].policy.config
    settings = Settings(
        maps=tuple(options.maps or [config.map]),
        tasks=tuple(TASKS[word] for word in options.tasks),
        episodes=options.episodes,
        eval_seeds=options.eval_seeds,
        seed=options.seed,
        goal_radii=(config.env.goal_radius,),
    )
    report.write_report(runs, settings, options.out, references=not options.no_references)
    print(f"wrote {options.out}")
    return 0


def _render(words: list[str]) -> int:
    parser = _Parser(
        prog="sqn render",
        description="Drive greedy episodes of trained policies on a map and write what they did: "
        "films (GIF), the paths of all side by side and timelines.",
        epilog=CACHE,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("runs", nargs="*", metavar="RUN", help="run folders, or pretrained:NAME")
    add("--map", default="maze", help="a name or a file (default maze)")
    add("--episodes", type=int, default=4, help="of each policy (default 4)")
    add("--tasks", choices=list(TASKS), default="points", help="default: points")
    add("--animations", type=int, default=1, help="films of each policy (default 1)")
    add("--seed", type=int, default=1_000, help="the evaluation seed (default 1000)")
    add("--velocity-noise", type=float, default=0.0, metavar="S", help="e.g. 0.1")
    add("--range-noise", type=float, default=0.0, metavar="P", help="e.g. 0.2")
    add("--max-steps", type=int, default=0, help="steps an episode (default: as the map says)")
    add("--mp4", action="store_true", help="write films as MP4, too; needs sqn_jax[video]")
    add("--out", type=_folder, metavar="DIR", help="default: renders/NAME_MAP, NAME the run's")
    options = parser.parse_args(words)
    if not options.runs:
        raise ValueError("nothing to render: name a run folder or pretrained:NAME")
    from sqn_jax.pretrained import find_policy

    try:
        from sqn_jax import render
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("matplotlib"):
            raise
        raise ValueError("Matplotlib is not installed (pip install 'sqn_jax[viz]')") from None
    for word in options.runs:
        if options.runs.count(word) > 1:
            raise ValueError(f"{word}: comes twice, expected each run once")
    policies = [find_policy(word) for word in options.runs]
    render.render_session(
        policies,
        options.out or render.default_folder(policies, options.map),
        map_name=options.map,
        tasks=TASKS[options.tasks],
        episodes=options.episodes,
        animations=options.animations,
        seed=options.seed,
        noise=(options.velocity_noise, options.range_noise),
        max_steps=options.max_steps,
        mp4=options.mp4,
    )
    return 0


def _require_writable(path: Path) -> None:
    from sqn_jax.runlog import CONFIG, OWN_NAMES, probe_writable

    if path.suffix != ".json":
        raise ValueError(f"--out is {path}, expected a file ending in .json")
    records = path.with_suffix(".jsonl")
    if not path.parent.is_dir() or path.is_dir() or records.is_dir():
        raise ValueError(f"--out {path}: expected a file in an existing folder")
    if (path.parent / CONFIG).is_file() and path.stem in OWN_NAMES:
        raise ValueError(f"--out {path}: is a file of that run itself, expected another name")
    try:
        probe_writable(path.parent)
    except OSError as error:
        raise ValueError(f"--out {path}: cannot be written ({error.strerror})") from None


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


_COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": _train,
    "evaluate": _evaluate,
    "report": _report,
    "render": _render,
    "map": _map,
}
