"""`sqn map`."""

from __future__ import annotations

from sqn_jax.cli.arguments import Parser
from sqn_jax.config.map_names import parse


def check_map(arguments: list[str]) -> int:
    """Describe a map."""
    parser = Parser(prog="sqn map", description="Check maps.", allow_abbrev=False)
    parser.add_argument("action", choices=["check"], help="check: report on a map")
    parser.add_argument(
        "file",
        help="a file (room.map@0.5: at 0.5 m a cell), a map of the project by name, or maze:0-3",
    )
    parser.add_argument("--robot-radius", type=float, default=0.1, help="m (default 0.1)")
    parser.add_argument(
        "--allow-outside",
        action="store_true",
        help="let the YAML file name an image that lies outside its folder",
    )
    options = parser.parse_args(arguments)
    from sqn_jax.maps import load_map
    from sqn_jax.maps.check import describe

    for index, name in enumerate(parse(options.file).names):
        occupancy_map = load_map(
            name, robot_radius=options.robot_radius, allow_outside=options.allow_outside
        )
        print("\n" * (index > 0) + describe(occupancy_map, options.robot_radius))
    return 0
