"""`sqn evaluate`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sqn_jax.cli.arguments import (
    CACHE,
    TASKS,
    Parser,
    add_bumper,
    add_checkpoint,
    add_device,
    add_no_baselines,
    add_params,
    find_policies,
    integer,
    number,
    refuse_fixed_bumper,
    single_maps,
    suite_file,
    tasks,
)
from sqn_jax.config.presets import PAPER_MAPS
from sqn_jax.outside.messages import say, say_lines
from sqn_jax.runs import streams

if TYPE_CHECKING:
    from sqn_jax.evaluation.agents import Agent


def evaluate(arguments: list[str]) -> int:
    """Evaluate policies and baselines, and print a table."""
    options = _parser().parse_args(arguments)
    if not options.runs and options.no_baselines:
        raise ValueError("nothing to evaluate: name a run folder or pretrained:NAME")
    if options.bumper is not None and not options.runs:
        raise ValueError("--bumper: expected a run folder or pretrained:NAME, baselines have none")
    from sqn_jax.training import devices

    tasks_file = _suite_file(options)
    devices.require(options.device)
    if options.out is None:
        streams.require_output("--out FILE for the results")
    else:
        if tasks_file is not None and options.out.resolve() == tasks_file.resolve():
            raise ValueError(f"--out {options.out}: is the file of --tasks, expected another one")
        _require_writable(options.out)
    if tasks_file is None:
        _evaluate_drawn_tasks(options)
    else:
        _evaluate_suite(options, tasks_file)
    if options.out is not None:
        say(f"wrote {options.out} and {options.out.with_suffix('.jsonl')}")
    return 0


def _suite_file(options: argparse.Namespace) -> Path | None:
    """The file of tasks, if one is asked for."""
    of_the_file = {
        "--maps": options.maps,
        "--max-steps": options.max_steps,
        "--goal-radius": options.goal_radius,
        "--noise-unit": options.noise_unit,
        "--robot-radius": options.robot_radius is not None,
    }
    return suite_file(options.tasks, of_the_file)


def _agents(options: argparse.Namespace) -> list[Agent]:
    """The policies, once for each epsilon, and the baselines."""
    from sqn_jax.evaluation.agents import group_policies, with_baselines, with_epsilons

    trained = with_epsilons(group_policies(find_policies(options)), options.epsilon)
    return with_baselines(trained, baselines=not options.no_baselines)


def _evaluate_drawn_tasks(options: argparse.Namespace) -> None:
    from sqn_jax.evaluation.scores import results_table, table_note
    from sqn_jax.evaluation.settings import Settings
    from sqn_jax.runs.evaluate import evaluate_session

    noise = [(level, 0.0) for level in options.velocity_noise if level != 0]
    noise += [(0.0, level) for level in options.range_noise if level != 0]
    settings = Settings(
        maps=single_maps(options.maps or PAPER_MAPS),
        tasks=tuple(TASKS[name] for name in options.tasks),
        episodes=100 if options.episodes is None else options.episodes,
        eval_seeds=options.eval_seeds,
        seed=options.seed,
        noise=((0.0, 0.0), *noise),
        noise_unit=options.noise_unit,
        goal_radii=tuple(options.goal_radius or (0.3, 0.5)),
        max_steps=options.max_steps,
        robot_radius=options.robot_radius,
    )
    evaluation = evaluate_session(_agents(options), settings, options.out)
    say_lines(
        [*results_table(evaluation["results"]).split("\n"), table_note(evaluation["results"])]
    )
    for comparison in evaluation["comparisons"]:
        low, high = comparison["ci95"]
        say(
            f"{comparison['first']} beats {comparison['second']} with probability "
            f"{comparison['probability']:.2f}, 95 % interval [{low:.2f}, {high:.2f}] "
            "over training seeds"
        )


def _evaluate_suite(options: argparse.Namespace, file: Path) -> None:
    from sqn_jax.evaluation.settings import SuiteSettings
    from sqn_jax.evaluation.suite_scores import comparison_lines, suite_table, table_notes
    from sqn_jax.runs.evaluate import evaluate_suite_session
    from sqn_jax.tasks import read_suite

    for option, levels in (
        ("--velocity-noise", options.velocity_noise),
        ("--range-noise", options.range_noise),
    ):
        if len(levels) > 1:
            raise ValueError(f"{option}: {len(levels)} levels, expected one with a file of tasks")
    suite = read_suite(file)
    refuse_fixed_bumper(options.bumper, suite.robot)
    settings = SuiteSettings(
        episodes=1 if options.episodes is None else options.episodes,
        eval_seeds=options.eval_seeds,
        seed=options.seed,
        noise=(sum(options.velocity_noise), sum(options.range_noise)),
    )
    evaluation, _ = evaluate_suite_session(_agents(options), suite, settings, options.out, file)
    table, notes = suite_table(evaluation).split("\n"), table_notes(evaluation)
    say_lines([*table, *notes, *comparison_lines(evaluation)])


def _parser() -> Parser:
    parser = Parser(
        prog="sqn evaluate",
        description="Run episodes of trained policies and baselines; all get the same tasks.",
        epilog=CACHE,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add(
        "runs",
        nargs="*",
        metavar="RUN",
        help="run folders, pretrained:NAME or files NAME.npz; default: only the baselines",
    )
    add("--maps", nargs="+", default=[], help="names or files (default: the four)")
    add(
        "--tasks",
        nargs="+",
        type=tasks,
        default=["points"],
        metavar="TASKS",
        help="points, pairs or both (default: points), or a file of tasks, see sqn tasks",
    )
    add(
        "--episodes",
        type=integer,
        help="per evaluation seed (default 100), for a file of tasks per task too (default 1)",
    )
    add("--eval-seeds", type=integer, default=5, help="number of evaluation seeds (default 5)")
    add("--seed", type=integer, default=1_000, help="the first evaluation seed (default 1000)")
    add("--velocity-noise", nargs="+", type=number, default=[], metavar="S", help="e.g. 0.1 0.2")
    add("--range-noise", nargs="+", type=number, default=[], metavar="P", help="e.g. 0.2 0.4")
    add("--noise-unit", choices=["relative", "absolute"], help="default: as trained")
    add(
        "--max-steps",
        type=integer,
        default=0,
        help="steps per episode (default: each map's limit)",
    )
    add(
        "--robot-radius",
        type=number,
        metavar="M",
        help="m; the radius of all robots (default: as trained)",
    )
    add(
        "--goal-radius", nargs="+", type=number, default=[], metavar="M", help="m (default 0.3 0.5)"
    )
    add(
        "--epsilon",
        nargs="+",
        type=number,
        default=[0.0],
        metavar="E",
        help="probability of a random action, several give a row each (default 0: greedy)",
    )
    add_bumper(parser)
    add_no_baselines(parser)
    add_checkpoint(parser)
    add_params(parser)
    add_device(parser)
    add("--out", type=Path, help="JSON file; the records of the episodes go beside it as .jsonl")
    return parser


def _require_writable(path: Path) -> None:
    from sqn_jax.storage.files import NotWritten, probe_file
    from sqn_jax.storage.run_folder import CONFIG, OWN_NAMES

    if path.suffix != ".json":
        raise ValueError(f"--out is {path}, expected a file ending in .json")
    records = path.with_suffix(".jsonl")
    if not path.parent.is_dir() or path.is_dir() or records.is_dir():
        raise ValueError(f"--out {path}: expected a file in an existing folder")
    if (path.parent / CONFIG).is_file() and path.stem in OWN_NAMES:
        raise ValueError(f"--out {path}: is a file of that run itself, expected another name")
    for file in (path, records):
        try:
            probe_file(file)
        except NotWritten as error:
            raise ValueError(f"--out {error}") from None
