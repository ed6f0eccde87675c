"""What holds for every test: two CPU devices, no silent broadcasting, the same examples each time.

Nor do tests read or write compiled programs in the user's cache folder. A process gives back what
it has compiled between two files, and one that crashes ends the run.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

# Before anything imports jax, and in the environment, so that child processes obey too.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["JAX_ENABLE_X64"] = "0"
os.environ["SQN_JAX_CACHE"] = "off"
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
os.environ.pop("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", None)

import hypothesis
import jax
import pytest

# Most programs here run a few times on tiny arrays: compiling them is most of what the tests
# take, and without optimizations, and with the older of XLA's two ways to emit a fused loop, it
# takes a quarter. `make test-long` compiles as users do.
AS_USERS = os.environ.get("SQN_TESTS_COMPILE") == "as-users"
if not AS_USERS:
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # For child processes.
    jax.config.update("jax_disable_most_optimizations", True)
    # XLA reads them when it compiles first, and ends a process with a flag that it does not know.
    if metadata.version("jaxlib").startswith("0.10."):
        os.environ["XLA_FLAGS"] = " ".join(
            [
                os.environ.get("XLA_FLAGS", ""),
                "--xla_cpu_use_fusion_emitters=false",
                "--xla_cpu_parallel_codegen_split_count=1",
            ]
        ).strip()

# As many devices on every machine, for the tests that divide a run; the others use the first.
jax.config.update("jax_num_cpu_devices", 2)

# One computation at a time: several in flight would wait for each other's threads on two cores.
jax.config.update("jax_cpu_enable_async_dispatch", False)

# [T] + [N, T] broadcasts to something that looks right and is not: make every such case spell
# out what it means.
jax.config.update("jax_numpy_rank_promotion", "raise")

# No deadline: the first call of a jitted function compiles it.
hypothesis.settings.register_profile(
    "deterministic",
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("deterministic")

# Those that take longest come first, so that no process is left alone with one of them.
LONGEST_FILES = (
    "test_loop.py",
    "test_devices.py",
    "test_faults.py",
    "test_cli.py",
    "test_notebooks.py",
    "test_report.py",
    "test_oracle.py",
    "test_compile_cache.py",
    "test_compare.py",
    "test_checkpoint_damage.py",
    "test_rollout.py",
    "test_benchmark.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, and each file's tests as they stand in it."""
    ranks = {name: rank for rank, name in enumerate(LONGEST_FILES)}
    items.sort(key=lambda item: ranks.get(item.path.name, len(ranks)))


# Every compiled program holds memory mappings, of which Linux gives a process 65,530: LLVM
# crashes for want of more.
MAPPINGS = Path("/proc/self/maps")
MAX_MAPPINGS = 4_000
peak_mappings = 0


def count_mappings() -> int:
    """Memory mappings of this process; 0 where the system does not list them."""
    return MAPPINGS.read_bytes().count(b"\n") if MAPPINGS.exists() else 0


@pytest.fixture(autouse=True, scope="module")
def give_back_programs() -> Iterator[None]:
    """Forget what was compiled, after a file that leaves many programs behind."""
    global peak_mappings
    yield
    mappings = count_mappings()
    peak_mappings = max(peak_mappings, mappings)
    if mappings > MAX_MAPPINGS:
        jax.clear_caches()
        gc.collect()
        if sys.platform == "linux":  # What is freed stays with the process unless asked for.
            getattr(ctypes.CDLL(None), "malloc_trim", lambda _: None)(0)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tell the process that started this one how much memory was used."""
    if hasattr(session.config, "workeroutput"):
        kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        session.config.workeroutput["peak"] = f"{kilobytes / 1e6:.2f} GB, {peak_mappings} mappings"


peaks: list[str] = []


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Note what a worker used, if it came to its end."""
    if peak := getattr(node, "workeroutput", {}).get("peak"):
        peaks.append(f"{node.gateway.id}: {peak}")


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """One line with what each worker used."""
    if peaks:
        terminalreporter.write_line(f"at most {'; '.join(sorted(peaks))}")


@pytest.hookimpl(trylast=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """End the run when a worker crashed: what it had yet to do would crash the next, or hang."""
    if report.when not in ("setup", "call", "teardown"):
        pytest.exit(f"{report.longrepr}", returncode=1)
