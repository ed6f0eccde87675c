"""One run in several processes, usually on as many machines: who they are and what they agree on.

JAX connects them (`jax.distributed`): afterwards `jax.devices()` are those of all processes, and a
mesh of them is divided as one of a single process is. All processes run the same program and must
call what is collective in the same order. The first alone writes and prints.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

HEARTBEAT_SECONDS = 60
"""How long a process may be silent; one that has ended is noticed at once."""

TCP_TABLES = ("/proc/net/tcp", "/proc/net/tcp6")
"""Where Linux lists connections."""

LISTENS = "0A"
"""State of a port there."""

LONGEST_WAIT_SECONDS = 24 * 3600
"""How long the others wait while the first evaluates and draws."""

SMALLEST_MESSAGE = 256
"""Bytes; longer messages double it, so that few programs are compiled to send them."""

_LOST = re.compile(
    r"gloo|nccl|coordination|heartbeat|barrier|connection|peer|socket", re.IGNORECASE
)
"""What JAX says when it cannot reach a process."""


class ProcessLost(OSError):
    """Another process of the run has ended, or cannot be reached."""

    def __init__(self) -> None:
        super().__init__(
            "another process of this run has ended or cannot be reached, so this one ends, too; "
            "what was saved, if anything, is on the disk: start all of them again with --resume"
        )


class OtherFailed(OSError):
    """Another process of the run has failed, and said why."""


@dataclass(frozen=True)
class Cluster:
    """Where the processes of a run find each other; None for what JAX is to detect.

    Raises:
        ValueError: they are not given together, or make no sense.
    """

    coordinator: str | None = None
    """HOST:PORT of process 0."""
    num_processes: int | None = None
    process_id: int | None = None
    """0 .. `num_processes` - 1."""
    timeout: int = 300
    """Seconds to wait for all to come."""

    def __post_init__(self) -> None:
        if not 1 <= self.timeout <= LONGEST_WAIT_SECONDS:
            raise ValueError(
                f"--process-timeout is {self.timeout}, expected 1 to {LONGEST_WAIT_SECONDS} seconds"
            )
        if self.coordinator is None:
            return
        host, _, port = self.coordinator.rpartition(":")
        if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
            raise ValueError(
                f"--coordinator is {self.coordinator!r}, expected HOST:PORT of process 0"
            )
        if self.num_processes is None or self.num_processes < 1:
            raise ValueError(f"--num-processes is {self.num_processes}, expected 1 or more")
        if self.process_id is None or not 0 <= self.process_id < self.num_processes:
            raise ValueError(
                f"--process-id is {self.process_id}, expected 0 to {self.num_processes - 1}"
            )

    @property
    def silence(self) -> str:
        """What to say if the others have not come in time."""
        where = self.coordinator or "the address that JAX has detected"
        if self.process_id == 0:
            who = f"not all {self.num_processes} processes have come to {where}"
        else:
            who = f"process 0 does not answer at {where}, or not all processes have come"
        return f"{who} within {self.timeout} s (--process-timeout)"


def join(cluster: Cluster) -> None:
    """Connect this process with the others of the run, before JAX starts its devices.

    Where they do not come in time JAX aborts the process.

    Raises:
        ValueError: nothing is detected, the port is in use, or the processes have different numbers
            of devices.
    """
    if cluster.process_id == 0:
        _require_free_port(str(cluster.coordinator))
    # On the CPU, what devices of several processes do together; and signals are ours to handle.
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            cluster.coordinator,
            cluster.num_processes,
            cluster.process_id,
            # Else each process of a SLURM task would be looked for, and given a single device.
            cluster_detection_method="deactivate" if cluster.coordinator else None,
            initialization_timeout=cluster.timeout,
            heartbeat_timeout_seconds=HEARTBEAT_SECONDS,
            shutdown_timeout_seconds=LONGEST_WAIT_SECONDS,
        )
    except Exception as error:
        if cluster.coordinator is None:
            raise ValueError(
                "--distributed auto: JAX finds no SLURM, Open MPI, Kubernetes or cloud TPU here "
                f"({_line(error)}), expected --coordinator, --num-processes and --process-id"
            ) from None
        raise ValueError(f"--coordinator {cluster.coordinator}: {_line(error)}") from None


def require_as_many_devices() -> None:
    """Refuse processes that do not have the same number of devices.

    Raises:
        ValueError: in all processes.
    """
    counts = [len(jax.local_devices(process)) for process in range(jax.process_count())]
    for process, count in enumerate(counts):
        if count != counts[0]:
            raise ValueError(
                f"process {process} has {count} devices, expected {counts[0]} as in process 0"
            )


def _require_free_port(address: str) -> None:
    """JAX crashes where it is in use."""
    port = int(address.rpartition(":")[2])
    if port in _listening_ports():
        raise ValueError(
            f"--coordinator {address}: port {port} is in use here, expected a free one of the "
            "machine of process 0"
        )


def _listening_ports() -> set[int]:
    """TCP ports of this machine that somebody listens on; none where the system does not say."""
    ports = set()
    for table in TCP_TABLES:
        with suppress(OSError):
            for line in Path(table).read_text(encoding="ascii").splitlines()[1:]:
                _, local, _, state = line.split()[:4]
                if state == LISTENS:
                    ports.add(int(local.rpartition(":")[2], 16))
    return ports


def leave() -> None:
    """Wait for the others to leave too, and disconnect."""
    jax.distributed.shutdown()


def is_first() -> bool:
    """Whether this process writes and prints: process 0, or the only one."""
    return jax.process_index() == 0


def gather(value: Any) -> list[Any]:
    """What each process has to say, in their order; what JSON can hold."""
    if jax.process_count() == 1:
        return [value]
    message = json.dumps(value).encode()
    lengths = multihost_utils.process_allgather(np.int32(len(message)))
    width = SMALLEST_MESSAGE
    while width < lengths.max():
        width *= 2
    padded = np.frombuffer(message.ljust(width), np.uint8)
    return [json.loads(row.tobytes()) for row in multihost_utils.process_allgather(padded)]


def require_same(description: Mapping[str, Any]) -> None:
    """Refuse processes that were not started alike.

    Args:
        description: settings and facts that must be the same in all.

    Raises:
        ValueError: in all processes; the message names the first difference.
    """
    first, *others = gather(dict(description))
    for number, other in enumerate(others, start=1):
        for name in sorted(first.keys() | other.keys()):
            mine, theirs = other.get(name), first.get(name)
            if mine != theirs:
                raise ValueError(
                    f"process {number}: {name} is {mine}, expected {theirs} as in process 0"
                )


@contextmanager
def together() -> Iterator[None]:
    """Let all processes come to the end of this block, or none continue.

    Collective; within the block only what was agreed on may be.

    Raises:
        ValueError, OSError: what was raised in the block; where it was raised in another process
            alone, with that process's message.
    """
    failure: ValueError | OSError | None = None
    try:
        yield
    except (ValueError, OSError) as error:
        if jax.process_count() == 1 or has_lost(error):
            raise
        failure = error
    if jax.process_count() == 1:
        return
    is_input = isinstance(failure, ValueError)
    reports = gather(None if failure is None else {"message": str(failure), "is_input": is_input})
    if failure is not None:
        raise failure
    for number, report in enumerate(reports):
        if report is not None:
            kind = ValueError if report["is_input"] else OtherFailed
            raise kind(f"process {number}: {report['message']}")


def has_lost(error: BaseException) -> bool:
    """Whether an error says that another process has ended or cannot be reached."""
    if isinstance(error, ProcessLost):
        return True
    is_of_jax = isinstance(error, jax.errors.JaxRuntimeError) or _is_status(error)
    return jax.process_count() > 1 and is_of_jax and bool(_LOST.search(str(error)))


def _is_status(error: BaseException) -> bool:
    """Whether a ValueError is one of XLA's, `UNKNOWN: Gloo all-reduce failed` say."""
    return isinstance(error, ValueError) and bool(re.match(r"[A-Z_]+: ", str(error)))


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
