"""`sqn export`."""

from __future__ import annotations

import argparse

from sqn_jax.cli.arguments import (
    CACHE,
    Parser,
    add_checkpoint,
    add_params,
    folder,
    integer,
    single_maps,
)
from sqn_jax.outside.messages import say


def export(arguments: list[str]) -> int:
    """Write a policy for a robot's computer, or check what was written."""
    options = _parser().parse_args(arguments)
    if options.check is not None:
        return _check(options)
    if options.policy is None or options.out is None:
        missing = "a policy" if options.policy is None else "--out DIR"
        raise ValueError(f"{missing} is missing, expected sqn export POLICY --out DIR")
    if len(single_maps([options.map])) != 1:
        raise ValueError(f"--map {options.map}: expected one map")
    from sqn_jax.export.folder import export_policy, require_free, require_libraries

    require_libraries("onnx")
    require_free(options.out)
    from sqn_jax.export.model_card import results_of
    from sqn_jax.policies.pretrained import PREFIX, find_policy
    from sqn_jax.policies.run_policies import of_seed

    policies = find_policy(options.policy, options.checkpoint, options.params)
    policy = of_seed(policies, options.seed)
    results = results_of(options.policy, policy)
    terms = "apache-2.0" if options.policy.startswith(PREFIX) else ""
    export_policy(policy, options.out, results=results, terms=terms, map_name=options.map)
    say(f"wrote {options.out}; compare it with itself: sqn export --check {options.out}")
    return 0


def _check(options: argparse.Namespace) -> int:
    for option in ("policy", "out", "seed"):
        if getattr(options, option) is not None:
            name = "POLICY" if option == "policy" else f"--{option}"
            raise ValueError(f"{name}: not with --check {options.check}")
    from sqn_jax.export.check import check_export

    for found in check_export(options.check):
        say(
            f"{found.runtime:14}largest difference of a Q-value {found.q_difference:.1e}, "
            f"other actions {found.other_actions} of {found.steps} (ties), "
            f"{found.microseconds:.0f} us a step"
        )
    return 0


def _parser() -> Parser:
    parser = Parser(
        prog="sqn export",
        description="Write a trained policy as files that a robot's computer runs: ONNX, or NumPy.",
        epilog=CACHE,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add(
        "policy",
        nargs="?",
        metavar="POLICY",
        help="a run folder, pretrained:NAME or a file NAME.npz",
    )
    add("--out", type=folder, metavar="DIR", help="a new folder, or an export to replace")
    add("--seed", type=integer, metavar="S", help="the training seed, of a run with several")
    add("--map", default="maze", help="map of the rollout that goes along (default: maze)")
    add(
        "--check",
        type=folder,
        metavar="DIR",
        help="compare what is in an export with itself: digests, robot, ONNX Runtime, NumPy",
    )
    add_checkpoint(parser)
    add_params(parser)
    return parser
