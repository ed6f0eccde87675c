"""`sqn play`."""

from __future__ import annotations

from pathlib import Path

from sqn_jax.cli.arguments import Parser, add_checkpoint, add_params, integer, single_maps
from sqn_jax.outside.messages import say


def play(arguments: list[str]) -> int:
    """Write a page on which one draws maps and a policy moves through them."""
    parser = Parser(
        prog="sqn play",
        description="Write one HTML file that runs a trained policy in the browser, on maps that "
        "one draws. It needs no network.",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("policy", metavar="POLICY", help="a run folder, pretrained:NAME or a file NAME.npz")
    add("--map", default="maze", help="the map it begins with, a name or a file (default: maze)")
    add("--seed", type=integer, metavar="S", help="the training seed, of a run with several")
    add_checkpoint(parser)
    add_params(parser)
    add("--out", type=Path, default=Path("play.html"), help="default: play.html")
    options = parser.parse_args(arguments)
    if len(single_maps([options.map])) != 1:
        raise ValueError(f"--map {options.map}: expected one map")
    from sqn_jax.storage.html import require_writable, write_page

    require_writable(options.out)
    from sqn_jax.maps import load_map
    from sqn_jax.play.page import maps_of_page, play_page
    from sqn_jax.policies.pretrained import find_policy
    from sqn_jax.policies.run_policies import of_seed

    policy = of_seed(find_policy(options.policy, options.checkpoint, options.params), options.seed)
    radius = policy.config.env.robot_radius
    maps = maps_of_page(load_map(options.map, robot_radius=radius), radius)
    write_page(options.out, play_page(policy, maps, source=options.policy))
    say(f"wrote {options.out}; open it in a browser")
    return 0
