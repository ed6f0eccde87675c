"""Arrays that take long to compute, kept beside the compiled programs for the next start.

They are sealed, tidied and switched off as the programs are (`compile_cache`), and as private: some
of them hold programs (`training.exported`).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from sqn_jax.outside.reading import read_at_most
from sqn_jax.storage.arrays import packed_arrays, read_arrays, read_headers
from sqn_jax.storage.compile_cache import ARRAYS, ENTRY, folder_in_use, seal_of
from sqn_jax.storage.files import write_whole

LARGEST_FILE = 2**24
"""Bytes of a file; what is larger is not kept."""


def cached_arrays(
    kind: str,
    depends_on: Iterable[bytes],
    make: Callable[[], Mapping[str, NDArray[Any]]],
) -> dict[str, NDArray[Any]]:
    """What `make` returns, computed once for all commands.

    A file that is missing, damaged or cannot be written is no error: the arrays are computed.

    Args:
        kind: what the arrays are, for the name of the file.
        depends_on: all that decides about them, the code that makes them included (`code_of`).
        make: computes them.
    """
    folder = folder_in_use()
    if folder is None:
        return dict(make())
    lengths_and_parts = b"".join(len(part).to_bytes(8, "little") + part for part in depends_on)
    name = f"{ARRAYS}{kind}-{hashlib.sha256(lengths_and_parts).hexdigest()}{ENTRY}"
    entry, seal = folder / name, seal_of(folder / name)
    with suppress(OSError, ValueError):
        packed = read_at_most(entry, LARGEST_FILE, "kept arrays", follow=False)
        if read_at_most(seal, 64, "a checksum", follow=False) == _checksum(packed):
            os.utime(entry, follow_symlinks=False)  # What is oldest is deleted first.
            return read_arrays(packed, read_headers(packed))
    arrays = dict(make())
    packed = packed_arrays(arrays)
    if len(packed) <= LARGEST_FILE:
        with suppress(OSError, ValueError):
            # The checksum first: what has none is deleted by the next command that starts.
            write_whole(seal, _checksum(packed))
            write_whole(entry, packed)
    return arrays


def _checksum(packed: bytes) -> bytes:
    return hashlib.sha256(packed).hexdigest().encode()


def code_of_package(package: ModuleType, *libraries: ModuleType) -> bytes:
    """A digest of all source of a package, and of its version and those of libraries."""
    root = Path(str(package.__file__)).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes() + b"\0")
    for module in (package, *libraries):
        digest.update(f"{module.__name__} {module.__version__}\0".encode())
    return digest.digest()


def is_edited(package: ModuleType, since: float) -> bool:
    """Whether a source file of a package is newer than a time, s since the epoch.

    What was imported before may then be other code than what the file holds.
    """
    root = Path(str(package.__file__)).parent
    return any(path.stat().st_mtime > since for path in root.rglob("*.py"))


def code_of(*modules: ModuleType) -> bytes:
    """A digest of the source of modules and of the libraries: with others numbers may be others.

    To be called when the modules are imported: a file may be edited later.
    """
    files = [Path(module.__file__) for module in modules if module.__file__ is not None]
    texts = [path.read_bytes() for path in files]
    versions = f"NumPy {np.__version__}, SciPy {scipy.__version__}".encode()
    return hashlib.sha256(b"".join([*texts, versions])).digest()
