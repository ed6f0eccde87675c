"""Programs that run only a few times need not be compiled well."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def compiling_quickly() -> Iterator[None]:
    """Leave out XLA's costly optimisations."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
