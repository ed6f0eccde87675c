"""What commands need of each other: compiled programs, and the tables of maps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import flax
import jax
import jaxlib
import numpy as np
import optax
from numpy.typing import NDArray

import sqn_jax
from sqn_jax.env import free_space
from sqn_jax.env.prepare import tables_from
from sqn_jax.storage.array_cache import cached_arrays, code_of, code_of_package
from sqn_jax.storage.compile_cache import cached_programs
from sqn_jax.training.exported import Arrays, exports_in

_CODE = code_of(free_space)
_PACKAGE = code_of_package(sqn_jax, jax, jaxlib, flax, optax)


@contextmanager
def cached_work() -> Iterator[None]:
    """Reuse what earlier commands have compiled and computed, and keep it for later ones.

    See `storage.compile_cache.cached_programs`: the folder, and what happens if it is no use.
    """
    with cached_programs(), tables_from(_cached_table), exports_in(_cached_program):
        yield


def _cached_program(kind: str, depends_on: Iterable[bytes], make: Callable[[], Arrays]) -> Arrays:
    return cached_arrays(kind, [_PACKAGE, *depends_on], make)


def _cached_table(blocked: NDArray[np.bool_], sectors: int, reach: int) -> NDArray[np.int16]:
    depends_on = [_CODE, repr((blocked.shape, sectors, reach)).encode(), blocked.tobytes()]
    arrays = cached_arrays(
        "tables", depends_on, lambda: {"table": free_space.table(blocked, sectors, reach)}
    )
    found: NDArray[np.int16] = arrays["table"]
    return found
