"""Programs that run only a few times need not be compiled well."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def compiling_quickly() -> Iterator[None]:
    """Leave out XLA's costly optimizations, also where the tests compile as users do."""
    before = os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS") == "1"
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
