"""Arrays that take long to compute, kept beside the compiled programs for the next start.

They are sealed, tidied and switched off as the programs are (`compile_cache`). Nothing of them is
executed.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sqn_jax.outside.reading import read_at_most
from sqn_jax.storage.arrays import read_arrays, read_headers
from sqn_jax.storage.compile_cache import (
    ENTRY,
    LARGEST_BYTES,
    digest_of,
    folder_in_use,
    is_sound,
    seal_of,
)
from sqn_jax.storage.files import write_whole


def kept_arrays(
    kind: str,
    depends_on: Iterable[bytes],
    make: Callable[[], Mapping[str, NDArray[Any]]],
) -> dict[str, NDArray[Any]]:
    """What `make` returns, computed once for all commands.

    A file that has changed since it was written is not read, and is deleted when the next command
    starts, as a damaged program is.

    Args:
        kind: what the arrays are, for the name of the file.
        depends_on: all that decides about them, the code that makes them included (`code_of`).
        make: computes them.
    """
    folder = folder_in_use()
    if folder is None:
        return dict(make())
    lengths_and_parts = b"".join(len(part).to_bytes(8, "little") + part for part in depends_on)
    entry = folder / f"{kind}-{hashlib.sha256(lengths_and_parts).hexdigest()}{ENTRY}"
    if is_sound(entry, seal_of(entry)):
        packed = read_at_most(entry, LARGEST_BYTES, "kept arrays", follow=False)
        return read_arrays(packed, read_headers(packed))
    arrays = dict(make())
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    with suppress(OSError):  # Where no program can be written either, of which a line tells.
        write_whole(entry, file.getvalue())
        write_whole(seal_of(entry), digest_of(entry))
    return arrays


def code_of(*modules: ModuleType) -> bytes:
    """The source of modules, and the version of NumPy: with others numbers may be others."""
    files = [Path(module.__file__) for module in modules if module.__file__ is not None]
    return b"".join(path.read_bytes() for path in files) + np.__version__.encode()
