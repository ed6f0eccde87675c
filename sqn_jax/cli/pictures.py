"""`sqn report` and `sqn render`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sqn_jax.cli.arguments import (
    CACHE,
    TASKS,
    Parser,
    add_bumper,
    add_checkpoint,
    add_device,
    add_epsilon,
    add_no_baselines,
    add_params,
    find_policies,
    folder,
    integer,
    number,
    pick,
    refuse_fixed_bumper,
    single_maps,
    suite_file,
    tasks,
)
from sqn_jax.outside.messages import say


def report(arguments: list[str]) -> int:
    """Write a report."""
    parser = Parser(
        prog="sqn report",
        description="Run episodes of trained policies and write one page about them: "
        "the worst episodes, success and time steps, curves, paths, an animation, settings.",
        epilog=CACHE,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("runs", nargs="*", metavar="RUN", help="run folders, pretrained:NAME or files NAME.npz")
    add("--maps", nargs="+", help="names or files (default: the map of the first run)")
    add(
        "--tasks",
        nargs="+",
        choices=list(TASKS),
        default=["points"],
        metavar="TASKS",
        help="points, pairs or both (default: points)",
    )
    add("--episodes", type=integer, default=100, help="per evaluation seed (default 100)")
    add("--eval-seeds", type=integer, default=1, help="number of evaluation seeds (default 1)")
    add("--seed", type=integer, default=1_000, help="the first evaluation seed (default 1000)")
    add_epsilon(parser)
    add_bumper(parser)
    add_no_baselines(parser)
    add_checkpoint(parser)
    add_params(parser)
    add_device(parser)
    add("--out", type=Path, default=Path("report.html"), help="default: report.html")
    options = parser.parse_args(arguments)
    if not options.runs:
        raise ValueError("nothing to report on: name a run folder or pretrained:NAME")
    try:
        from sqn_jax import report as reports
    except ModuleNotFoundError as error:
        if error.name != "matplotlib":
            raise
        raise ValueError("Matplotlib is not installed (pip install 'sqn_jax[viz]')") from None
    from sqn_jax.evaluation.settings import Settings
    from sqn_jax.training import devices

    devices.require(options.device)
    reports.require_writable(options.out)
    runs = reports.read_runs(options.runs, options.checkpoint, options.params, options.bumper)
    config = runs[0].policy.config
    maps = options.maps or [str(config.maps.names[0])]
    settings = Settings(
        maps=single_maps(maps),
        tasks=tuple(TASKS[name] for name in options.tasks),
        episodes=options.episodes,
        eval_seeds=options.eval_seeds,
        seed=options.seed,
        goal_radii=(config.env.goal_radius,),
    )
    written = reports.write_report(
        runs, settings, options.out, baselines=not options.no_baselines, epsilon=options.epsilon
    )
    say("wrote " + " and ".join(str(path) for path in written))
    return 0


def render(arguments: list[str]) -> int:
    """Write pictures and animations."""
    options = _render_parser().parse_args(arguments)
    if not options.runs:
        raise ValueError("nothing to render: name a run folder or pretrained:NAME")
    from sqn_jax.training import devices

    try:
        from sqn_jax.report import render as renders
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("matplotlib"):
            raise
        raise ValueError("Matplotlib is not installed (pip install 'sqn_jax[viz]')") from None
    devices.require(options.device)
    for name in options.runs:
        if options.runs.count(name) > 1:
            raise ValueError(f"{name}: comes twice, expected each run once")
    suite_name = _suite_to_draw(options)
    policies = find_policies(options)
    map_name = options.map or "maze"
    folder_of_pictures = options.out or renders.default_folder(policies, map_name, suite_name)
    how: dict[str, Any] = {
        "animations": options.animations,
        "seed": options.seed,
        "noise": (options.velocity_noise, options.range_noise),
        "epsilon": options.epsilon,
        "mp4": options.mp4,
    }
    if options.episodes is not None:
        how["episodes"] = options.episodes
    if suite_name is None:
        how |= {"map_name": map_name, "tasks": TASKS[options.tasks]}
        renders.render_session(policies, folder_of_pictures, max_steps=options.max_steps, **how)
        return 0
    from sqn_jax.report.render_suite import render_suite_session
    from sqn_jax.tasks import read_suite

    chosen: Any = "worst" if options.pick == ["worst"] else options.pick
    suite = read_suite(suite_name)
    refuse_fixed_bumper(options.bumper, suite.robot)
    render_suite_session(policies, suite, folder_of_pictures, source=suite_name, pick=chosen, **how)
    return 0


def _render_parser() -> Parser:
    parser = Parser(
        prog="sqn render",
        description="Run episodes of trained policies on a map and draw them: animations "
        "(GIF), the paths of all policies side by side, and timelines.",
        epilog=CACHE,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("runs", nargs="*", metavar="RUN", help="run folders, pretrained:NAME or files NAME.npz")
    add("--map", help="a name or a file (default maze)")
    add("--episodes", type=integer, help="per policy (default 4)")
    add(
        "--tasks",
        type=tasks,
        default="points",
        help="points or pairs (default: points), or a file of tasks, see sqn tasks",
    )
    add(
        "--pick",
        nargs="+",
        type=pick,
        default=[],
        metavar="TASK",
        help="of a file of tasks those of these numbers, from 0 as in the records of sqn evaluate, "
        "or worst: those with the least success in one try each (default: the first)",
    )
    add("--animations", type=integer, default=1, help="animations per policy (default 1)")
    add("--seed", type=integer, default=1_000, help="the evaluation seed (default 1000)")
    add("--velocity-noise", type=number, default=0.0, metavar="S", help="e.g. 0.1")
    add("--range-noise", type=number, default=0.0, metavar="P", help="e.g. 0.2")
    add("--max-steps", type=integer, default=0, help="steps per episode (default: the map's limit)")
    add("--mp4", action="store_true", help="also write MP4 files; needs sqn_jax[video]")
    add_epsilon(parser)
    add_bumper(parser)
    add_checkpoint(parser)
    add_params(parser)
    add_device(parser)
    add("--out", type=folder, metavar="DIR", help="default: renders/RUN_MAP")
    return parser


def _suite_to_draw(options: argparse.Namespace) -> Path | None:
    """The file of tasks, if one is asked for; its options are checked."""
    given = {"--map": options.map is not None, "--max-steps": options.max_steps}
    file = suite_file([options.tasks], given)
    text = " ".join(map(str, options.pick))
    if file is None and options.pick:
        raise ValueError(f"--pick {text}: only with --tasks FILE.json")
    if "worst" in options.pick and len(options.pick) > 1:
        raise ValueError(f"--pick {text}: expected worst alone, or numbers of tasks")
    if options.episodes is not None and options.pick and options.pick != ["worst"]:
        raise ValueError(f"--episodes: not with --pick {text}, which says how many")
    return file
