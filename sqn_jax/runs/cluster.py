"""A command that is one of several processes of a run: it joins them, and leaves with them."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from sqn_jax.runs import aborts
from sqn_jax.runs.signals import Interrupted
from sqn_jax.training import devices, processes
from sqn_jax.training.processes import Cluster, ProcessLost


@contextmanager
def joined(cluster: Cluster | None, device: str | None) -> Iterator[None]:
    """Start JAX's devices, and be one of the processes of a run within this context.

    Only the first prints, but for errors. Those that end in order wait for each other.
    One that fails does not: the others notice, and end too.

    Args:
        cluster: where they find each other; None stands for a process alone.
        device: see `devices.require`.

    Raises:
        ValueError: see `processes.join` and `devices.require`.
        ProcessLost: another process has ended.
    """
    devices.use_cores()
    if cluster is None:
        devices.require(device)
        yield
        return
    with aborts.reported(cluster.silence):
        processes.join(cluster)
    with aborts.reported(str(ProcessLost())):
        try:
            devices.require(device)
            if not processes.is_first():
                _discard_output()
            processes.require_as_many_devices()
            yield
        except Interrupted:
            processes.leave()
            raise
        except Exception as error:
            if processes.has_lost(error):
                raise ProcessLost from None
            raise
        processes.leave()


def _discard_output() -> None:
    """Leave what is said, and warned of, to the first process."""
    warnings.simplefilter("ignore")
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)
    os.close(null_device)
