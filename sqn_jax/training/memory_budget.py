"""Whether a run fits, asked before it allocates anything."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

SETTINGS = {
    "r2d2": ("replay.capacity", "num_envs", "learner.batch_size", "num_seeds", "env.max_steps"),
    "pqn": ("num_envs", "learner.batch_size", "num_seeds", "env.max_steps"),
    "evaluate": ("episodes", "eval_seeds", "max_steps"),
    "final evaluation": ("eval.episodes", "env.max_steps"),
}
"""Settings that decide how much a run or an evaluation takes, the strongest first."""


def require(num_bytes: float, what: str, method: str) -> None:
    """Refuse what is more than there is.

    Args:
        num_bytes: that will be allocated.
        what: what will be allocated for, "training" say.
        method: of the run, or the kind of evaluation, whose settings are named.

    Raises:
        ValueError: it does not fit.
    """
    free = available_bytes()
    if free is not None and num_bytes > free:
        settings = ", ".join(f"--{name.replace('_', '-')}" for name in SETTINGS[method])
        raise ValueError(
            f"{what} would take {num_bytes / 1e9:,.1f} GB, but {free / 1e9:,.1f} GB are free on "
            f"{jax.devices()[0].device_kind}: lower one of {settings}"
        )


def compiled_bytes(compiled: Any) -> float:
    """What a compiled program takes while it runs: arguments, results and all in between."""
    analysis = compiled.memory_analysis()
    if analysis is None:  # Some backends do not say.
        return 0.0
    return float(
        analysis.argument_size_in_bytes
        + analysis.output_size_in_bytes
        + analysis.temp_size_in_bytes
        - analysis.alias_size_in_bytes
    )


def available_bytes() -> float | None:
    """Bytes that can still be allocated where a run would be; None if unknown."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        if "bytes_limit" not in stats:
            return None
        return float(stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    limits = [free for free in (_free_of_machine(), _free_of_group()) if free is not None]
    return min(limits) if limits else None


def _free_of_machine() -> float | None:
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * float(line.split()[1])
    with suppress(OSError, ValueError):
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return None


def _free_of_group() -> float | None:
    """What a container may still use (control groups, version 2)."""
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError):
        most = float((group / "memory.max").read_text(encoding="ascii"))  # "max": no limit.
        used = float((group / "memory.current").read_text(encoding="ascii"))
        return most - used
    return None


MAX_MAPPINGS = 20_000
"""Memory mappings of a process above which compiled programs are given back. A program holds about
six; Linux gives a process 65,530, and LLVM crashes for want of more."""
MAPPINGS = Path("/proc/self/maps")


def bound_programs() -> None:
    """Forget the compiled programs of this process where there are very many.

    A process that trains or evaluates on hundreds of maps, one after the other, would otherwise
    come to the system's limit. What is needed again is compiled again.
    """
    if MAPPINGS.exists() and MAPPINGS.read_bytes().count(b"\n") > MAX_MAPPINGS:
        jax.clear_caches()
