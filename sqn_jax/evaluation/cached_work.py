"""What a command leaves for the next: programs, lowered and compiled, and tables of maps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext

import flax
import jax
import jaxlib
import numpy as np
import optax
from numpy.typing import NDArray

import sqn_jax
from sqn_jax.env import free_space
from sqn_jax.env.prepare import tables_from
from sqn_jax.storage.array_cache import cached_arrays, code_of, code_of_package, is_edited
from sqn_jax.storage.compile_cache import cached_programs, folder_in_use
from sqn_jax.training.exported import Arrays, exports_in

_FREE_SPACE = code_of(free_space)
_PACKAGE = code_of_package(sqn_jax, jax, jaxlib, flax, optax)


@contextmanager
def cached_work() -> Iterator[None]:
    """Reuse what earlier commands have compiled and computed, and store it for later ones.

    See `storage.compile_cache.cached_programs`: the folder, and what happens if it is no use. In a
    session in which files of this package were edited (a notebook), programs are traced.
    """
    with cached_programs(), tables_from(_cached_table):
        can_export = folder_in_use() is not None and not is_edited(sqn_jax, sqn_jax._IMPORTED)
        with exports_in(_cached_program) if can_export else nullcontext():
            yield


def _cached_program(kind: str, depends_on: Iterable[bytes], make: Callable[[], Arrays]) -> Arrays:
    return cached_arrays(kind, [_PACKAGE, *depends_on], make)


def _cached_table(blocked: NDArray[np.bool_], sectors: int, reach: int) -> NDArray[np.int16]:
    shape = (sectors, *blocked.shape)
    depends_on = [_FREE_SPACE, repr((shape, reach)).encode(), blocked.tobytes()]
    arrays = cached_arrays(
        "tables", depends_on, lambda: {"table": free_space.table(blocked, sectors, reach)}
    )
    table: NDArray[np.int16] = arrays["table"]
    return table
