"""`sqn tasks`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sqn_jax.cli.arguments import Parser
from sqn_jax.config.map_names import KINDS
from sqn_jax.outside.messages import say

if TYPE_CHECKING:
    from sqn_jax.tasks import TaskSuite
    from sqn_jax.tasks.convert import ConvertedMap


def tasks(arguments: list[str]) -> int:
    """Make or check a suite of tasks."""
    options = _parser().parse_args(arguments)
    if options.action == "check":
        return _check(options.source, options.allow_outside)
    from sqn_jax.tasks.convert import require_output

    require_output(options.out)
    if options.action == "generate":
        return _generate(options)
    if options.action == "pairs":
        return _pairs(options)
    return _convert(options)


def _parser() -> Parser:
    parser = Parser(
        prog="sqn tasks",
        description="Suites of tasks: a JSON file that names maps, starts, goals and the robot.",
        epilog="What is measured on them here is kinematic, and no entry of any leaderboard.",
        allow_abbrev=False,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    def action(name: str, what: str, source: str = "") -> Parser:
        added: Parser = actions.add_parser(name, help=what, description=what, allow_abbrev=False)
        if source:
            added.add_argument("source", type=Path, metavar="SOURCE", help=source)
        if name != "check":
            added.add_argument(
                "--out",
                type=Path,
                required=True,
                metavar="FILE.json",
                help="the suite; maps, if any, are written to FILE_maps beside it",
            )
        return added

    mrpb = action(
        "mrpb",
        "tasks of MRPB, each both ways",
        "a folder with map.yaml and config.txt, or of such folders",
    )
    mrpb.add_argument(
        "--headings",
        choices=["random", "given"],
        default="random",
        help="at the start: drawn for each episode (default), or as given where it is",
    )
    barn = action("barn", "worlds of BARN", "a folder of world_*.world, path_*.npy beside them")
    barn.add_argument("--robot-radius", type=float, default=0.33, help="m (default 0.33)")
    movingai = action(
        "movingai", "scenarios of MovingAI", "a .scen file or a folder of them, maps beside them"
    )
    movingai.add_argument("--resolution", type=float, default=0.5, help="m a cell (default 0.5)")
    movingai.add_argument("--first", type=int, metavar="K", help="the first K tasks of each file")
    generate = action("generate", "fresh procedural maps with a hard task each")
    generate.add_argument("--kinds", nargs="+", choices=KINDS, default=["maze"], metavar="KIND")
    generate.add_argument("--count", type=int, default=1000, help="maps of each kind (1000)")
    generate.add_argument("--seed", type=int, default=1_000_000, help="of the first map (1000000)")
    generate.add_argument("--num-processes", type=int, help="default: one for each core")
    pairs = action("pairs", "random pairs of places on maps of your own")
    pairs.add_argument("maps", nargs="+", metavar="MAP", help="files, or names of single maps")
    pairs.add_argument("--count", type=int, default=50, help="tasks of each map (50)")
    pairs.add_argument("--seed", type=int, default=0, help="of the tasks (0)")
    pairs.add_argument("--robot-radius", type=float, default=0.1, help="m (0.1)")
    pairs.add_argument(
        "--limit", type=float, default=4.0, help="steps, in those of the shortest path (4)"
    )
    pairs.add_argument(
        "--allow-outside",
        action="store_true",
        help="let a map name an image that lies outside its folder",
    )
    check = action("check", "whether a suite can be read and its tasks solved", "FILE.json")
    check.add_argument(
        "--allow-outside",
        action="store_true",
        help="let the suite name maps, and these images, that lie outside their folder",
    )
    return parser


def _convert(options: argparse.Namespace) -> int:
    """Write the tasks of a benchmark."""
    from sqn_jax.tasks.barn import read_barn
    from sqn_jax.tasks.convert import write_converted
    from sqn_jax.tasks.movingai import read_movingai
    from sqn_jax.tasks.mrpb import read_mrpb

    if options.action == "barn":
        worlds, robot = read_barn(options.source, robot_radius=options.robot_radius)
        suite = write_converted(options.out, worlds, robot=robot, collision_ends=True)
    elif options.action == "mrpb":
        suite = write_converted(options.out, read_mrpb(options.source, headings=options.headings))
    else:
        read = read_movingai(options.source, resolution=options.resolution, first=options.first)
        suite = write_converted(options.out, read)
    _report(options.out, suite)
    return 0


def _generate(options: argparse.Namespace) -> int:
    """Write a suite on fresh maps."""
    import os

    from tqdm import tqdm

    from sqn_jax.tasks.generate import generate_tasks
    from sqn_jax.tasks.suite import TaskSuite, write_suite

    num_processes = options.num_processes or os.cpu_count() or 1
    made = generate_tasks(options.kinds, options.count, options.seed, num_processes=num_processes)
    total = options.count * len(options.kinds)
    suite = TaskSuite(options.out.stem, tuple(tqdm(made, total=total, unit="map", disable=None)))
    write_suite(options.out, suite)
    _report(options.out, suite)
    return 0


def _pairs(options: argparse.Namespace) -> int:
    """Write a suite of random pairs of places."""
    import dataclasses

    from sqn_jax.config.groups import EnvConfig
    from sqn_jax.maps import load_map
    from sqn_jax.tasks.convert import write_converted
    from sqn_jax.tasks.pairs import random_tasks

    robot_radius = EnvConfig(robot_radius=options.robot_radius).robot_radius

    def converted(name: str) -> ConvertedMap:
        occupancy_map = load_map(
            name, robot_radius=robot_radius, allow_outside=options.allow_outside
        )
        if occupancy_map.parts:
            raise ValueError(f"map {name}: several maps, expected one; name them one by one")
        drawn = random_tasks(
            occupancy_map,
            options.count,
            options.seed,
            robot_radius=robot_radius,
            limit=options.limit,
        )
        file_name = occupancy_map.name.replace(":", "_")
        named_so = dataclasses.replace(occupancy_map, name=file_name)
        return dataclasses.replace(drawn, occupancy_map=named_so)

    robot = (("robot_radius", robot_radius),)
    suite = write_converted(options.out, map(converted, options.maps), robot=robot)
    _report(options.out, suite)
    return 0


def _check(source: Path, allow_outside: bool) -> int:
    """Read a suite and its maps, and see whether each goal can be reached."""
    import functools

    from sqn_jax.config.groups import EnvConfig
    from sqn_jax.maps import load_map
    from sqn_jax.outside.messages import named
    from sqn_jax.tasks import check_tasks, read_suite

    suite = read_suite(source, allow_outside=allow_outside)
    robot = suite.robot_of(EnvConfig())
    load = functools.partial(load_map, robot_radius=robot.robot_radius, allow_outside=allow_outside)
    check_tasks(suite, load, source=named(source))
    say(f"{suite.name}: {_extent(suite)}, each can be solved")
    say("robot: " + (", ".join(f"{name} {value:g}" for name, value in suite.robot) or "any"))
    return 0


def _report(out: Path, suite: TaskSuite) -> None:
    say(f"wrote {out}: {_extent(suite)}")


def _extent(suite: TaskSuite) -> str:
    """The numbers of tasks and maps, in words."""
    counts = {"task": len(suite.tasks), "map": len({task.map_file for task in suite.tasks})}
    return " on ".join(f"{count} {what}{'s' * (count != 1)}" for what, count in counts.items())
