"""What holds for every test: two CPU devices, no silent broadcasting, the same examples each time.

Nor do tests read or write compiled programs in the user's cache folder.
"""

from __future__ import annotations

import os

# Before anything imports jax, and in the environment, so that child processes obey too.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["JAX_ENABLE_X64"] = "0"
os.environ["SQN_JAX_CACHE"] = "off"
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
os.environ.pop("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", None)

import hypothesis
import jax

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
