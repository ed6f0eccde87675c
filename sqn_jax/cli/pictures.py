"""`sqn report` and `sqn render`."""

from __future__ import annotations

from pathlib import Path

from sqn_jax.cli.arguments import (
    CACHE,
    TASKS,
    Parser,
    add_checkpoint,
    add_device,
    folder,
    integer,
    number,
    single_maps,
)


def report(arguments: list[str]) -> int:
    """Write a report."""
    parser = Parser(
        prog="sqn report",
        description="Run greedy episodes of trained policies and write one page about them: "
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
    add("--no-references", action="store_true", help="leave out the oracle and the wall follower")
    add_checkpoint(parser)
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
    runs = reports.read_runs(options.runs, options.checkpoint)
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
    reports.write_report(runs, settings, options.out, baselines=not options.no_references)
    print(f"wrote {options.out}")
    return 0


def render(arguments: list[str]) -> int:
    """Write pictures and animations."""
    parser = Parser(
        prog="sqn render",
        description="Run greedy episodes of trained policies on a map and draw them: animations "
        "(GIF), the paths of all policies side by side, and timelines.",
        epilog=CACHE,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("runs", nargs="*", metavar="RUN", help="run folders, pretrained:NAME or files NAME.npz")
    add("--map", default="maze", help="a name or a file (default maze)")
    add("--episodes", type=integer, default=4, help="per policy (default 4)")
    add("--tasks", choices=list(TASKS), default="points", help="default: points")
    add("--animations", type=integer, default=1, help="animations per policy (default 1)")
    add("--seed", type=integer, default=1_000, help="the evaluation seed (default 1000)")
    add("--velocity-noise", type=number, default=0.0, metavar="S", help="e.g. 0.1")
    add("--range-noise", type=number, default=0.0, metavar="P", help="e.g. 0.2")
    add("--max-steps", type=integer, default=0, help="steps per episode (default: the map's limit)")
    add("--mp4", action="store_true", help="also write MP4 files; needs sqn_jax[video]")
    add_checkpoint(parser)
    add_device(parser)
    add("--out", type=folder, metavar="DIR", help="default: renders/RUN_MAP")
    options = parser.parse_args(arguments)
    if not options.runs:
        raise ValueError("nothing to render: name a run folder or pretrained:NAME")
    from sqn_jax.policies.pretrained import find_policy
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
    policies = [find_policy(name, options.checkpoint) for name in options.runs]
    renders.render_session(
        policies,
        options.out or renders.default_folder(policies, options.map),
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
