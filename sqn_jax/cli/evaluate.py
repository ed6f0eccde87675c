"""`sqn evaluate`."""

from __future__ import annotations

from pathlib import Path

from sqn_jax.cli.arguments import (
    CACHE,
    TASKS,
    Parser,
    add_checkpoint,
    add_device,
    single_maps,
)
from sqn_jax.config.presets import PAPER_MAPS


def evaluate(arguments: list[str]) -> int:
    """Evaluate policies and baselines, and print a table."""
    parser = Parser(
        prog="sqn evaluate",
        description="Run greedy episodes of trained policies; all agents get the same tasks.",
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
    add("--maps", nargs="+", default=list(PAPER_MAPS), help="names or files (default: the four)")
    add("--tasks", nargs="+", choices=list(TASKS), default=["points"], help="default: points")
    add("--episodes", type=int, default=100, help="per evaluation seed (default 100)")
    add("--eval-seeds", type=int, default=5, help="number of evaluation seeds (default 5)")
    add("--seed", type=int, default=1_000, help="the first evaluation seed (default 1000)")
    add("--velocity-noise", nargs="+", type=float, default=[], metavar="S", help="e.g. 0.1 0.2")
    add("--range-noise", nargs="+", type=float, default=[], metavar="P", help="e.g. 0.2 0.4")
    add("--noise-unit", choices=["relative", "absolute"], help="default: as trained")
    add(
        "--max-steps",
        type=int,
        default=0,
        help="steps per episode (default: each map's limit)",
    )
    add(
        "--robot-radius",
        type=float,
        metavar="M",
        help="m; the radius of all robots (default: as trained)",
    )
    add("--goal-radius", nargs="+", type=float, default=[0.3, 0.5], metavar="M", help="m")
    add("--no-references", action="store_true", help="leave out the oracle and the wall follower")
    add_checkpoint(parser)
    add_device(parser)
    add("--out", type=Path, help="JSON file; the records of the episodes go beside it as .jsonl")
    options = parser.parse_args(arguments)
    if not options.runs and options.no_references:
        raise ValueError("nothing to evaluate: name a run folder or pretrained:NAME")
    from sqn_jax.evaluation.agents import group_policies, with_baselines
    from sqn_jax.evaluation.scores import results_table
    from sqn_jax.evaluation.settings import Settings
    from sqn_jax.policies.pretrained import find_policy
    from sqn_jax.runs.evaluate import evaluate_session
    from sqn_jax.training import devices

    devices.require(options.device)
    noise = [(level, 0.0) for level in options.velocity_noise if level != 0]
    noise += [(0.0, level) for level in options.range_noise if level != 0]
    settings = Settings(
        maps=single_maps(options.maps),
        tasks=tuple(TASKS[name] for name in options.tasks),
        episodes=options.episodes,
        eval_seeds=options.eval_seeds,
        seed=options.seed,
        noise=((0.0, 0.0), *noise),
        noise_unit=options.noise_unit,
        goal_radii=tuple(options.goal_radius),
        max_steps=options.max_steps,
        robot_radius=options.robot_radius,
    )
    if options.out is not None:
        _require_writable(options.out)
    trained = group_policies([find_policy(name, options.checkpoint) for name in options.runs])
    agents = with_baselines(trained, baselines=not options.no_references)
    evaluation = evaluate_session(agents, settings, options.out)
    print(results_table(evaluation["results"]))
    for comparison in evaluation["comparisons"]:
        low, high = comparison["ci95"]
        print(
            f"{comparison['first']} beats {comparison['second']} with probability "
            f"{comparison['probability']:.2f} [{low:.2f}, {high:.2f}] over training seeds"
        )
    if options.out is not None:
        print(f"wrote {options.out} and {options.out.with_suffix('.jsonl')}")
    return 0


def _require_writable(path: Path) -> None:
    from sqn_jax.storage.files import probe_writable
    from sqn_jax.storage.run_folder import CONFIG, OWN_NAMES

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
