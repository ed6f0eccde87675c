"""The options that make a command one of several processes of a run."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from sqn_jax.cli.arguments import Parser, integer

if TYPE_CHECKING:
    from sqn_jax.training.processes import Cluster

OPTIONS = ("distributed", "coordinator", "num_processes", "process_id", "process_timeout")
"""Their names in the parsed arguments."""


def add_processes(parser: Parser) -> None:
    """Add the options."""
    add = parser.add_argument
    add(
        "--distributed",
        choices=["auto"],
        help="be one of several processes of a run, as SLURM, Open MPI, Kubernetes or a cloud TPU "
        "have started them; each is given the same arguments",
    )
    add(
        "--coordinator",
        metavar="HOST:PORT",
        help="be one of several processes of a run that find each other here: an address of the "
        "machine of process 0, and a free port there",
    )
    add("--num-processes", type=integer, metavar="N", help="how many there are")
    add("--process-id", type=integer, metavar="I", help="which one this is, 0 to N - 1")
    add(
        "--process-timeout",
        type=integer,
        metavar="S",
        help="seconds to wait for the others at the start (default: 300)",
    )


def cluster_of(options: argparse.Namespace) -> Cluster | None:
    """Where the processes of a run find each other; None for one alone.

    Raises:
        ValueError: options are missing, contradict each other, or make no sense.
    """
    given = {name: value for name in OPTIONS if (value := getattr(options, name)) is not None}
    if not given:
        return None
    places = ("coordinator", "num_processes", "process_id")
    missing = [f"--{name.replace('_', '-')}" for name in places if name not in given]
    if "distributed" in given and len(missing) < len(places):
        raise ValueError("--distributed auto: expected none of --coordinator and what goes with it")
    if "distributed" not in given and missing:
        raise ValueError(
            f"{', '.join(missing)}: missing, expected --coordinator, --num-processes and "
            "--process-id together, or --distributed auto"
        )
    if options.run_dir is None:
        raise ValueError("--run-dir: missing, expected a folder that all processes share")
    from sqn_jax.training.processes import Cluster

    given.pop("distributed", None)
    timeout = given.pop("process_timeout", Cluster.timeout)
    return Cluster(**given, timeout=timeout)
