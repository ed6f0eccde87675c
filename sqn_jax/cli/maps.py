"""`sqn map`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from sqn_jax.cli.arguments import Parser, number
from sqn_jax.config.map_names import parse
from sqn_jax.config.validation import LIMITS, require_limits
from sqn_jax.outside.messages import say, say_lines


def check_map(arguments: list[str]) -> int:
    """Describe a map."""
    parser = Parser(prog="sqn map", description="Check maps.", allow_abbrev=False)
    parser.add_argument("action", choices=["check"], help="check: report on a map")
    parser.add_argument(
        "file",
        help="a file (room.map@0.5: at 0.5 m a cell), a map of the project by name, or maze:0-3",
    )
    parser.add_argument("--robot-radius", type=number, default=0.1, help="m (default 0.1)")
    parser.add_argument(
        "--allow-outside",
        action="store_true",
        help="let the YAML file name an image that lies outside its folder",
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="OUT.png",
        help="draw the map as a robot meets it: free, occupied, unknown, within reach, its points",
    )
    options = parser.parse_args(arguments)
    require_limits(options.robot_radius, "--robot-radius", *LIMITS["env.robot_radius"])
    names = parse(options.file).names
    if options.picture is not None:
        _require_picture(options.picture, len(names))
    from sqn_jax.maps import load_map
    from sqn_jax.maps.check import describe

    for index, name in enumerate(names):
        occupancy_map = load_map(
            name, robot_radius=options.robot_radius, allow_outside=options.allow_outside
        )
        if options.picture is not None:
            from sqn_jax import figures

            figures.save(figures.map_picture(occupancy_map, options.robot_radius), options.picture)
        if index > 0:
            say("")
        say_lines(describe(occupancy_map, options.robot_radius).split("\n"))
    if options.picture is not None:
        say(f"wrote {options.picture}")
    return 0


def _require_picture(path: Path, num_maps: int) -> None:
    """Refuse what cannot become a picture, before a map is read."""
    if num_maps > 1:
        raise ValueError(f"--picture {path}: {num_maps} maps, expected one")
    if path.suffix.lower() != ".png" or path.is_dir():
        raise ValueError(f"--picture {path}: expected a file ending in .png")
    if find_spec("matplotlib") is None:
        raise ValueError("Matplotlib is not installed (pip install 'sqn_jax[viz]')")
