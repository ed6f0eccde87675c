"""Files of arrays (.npz): of one from outside nothing is unpacked before its size is known."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

MAX_HEADER_BYTES = 2**12
"""Size of what stands before the numbers of an array, at most."""

Header = tuple[tuple[int, ...], np.dtype[Any], int]
"""Shape, dtype, and how many bytes the array takes with its own header."""


def read_headers(packed: bytes) -> dict[str, Header]:
    """Shape, dtype and place of the numbers of each array in a .npz file; no number is unpacked.

    Raises:
        ValueError: it is no such file, holds something else, or an array twice.
    """
    headers: dict[str, Header] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as file:
            for entry in file.infolist():
                path = entry.filename.removesuffix(".npy")
                if path in headers or path == entry.filename:
                    raise ValueError(f"it holds {entry.filename!r}, expected arrays, each once")
                if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"{path!r} is compressed in another way than NumPy does")
                with file.open(entry) as member:
                    start = io.BytesIO(member.read(MAX_HEADER_BYTES))
                if np.lib.format.read_magic(start) != (1, 0):
                    raise ValueError(f"{path!r} is in another version of the format than 1.0")
                shape, _, dtype = np.lib.format.read_array_header_1_0(start)
                num_bytes = start.tell() + math.prod(shape) * dtype.itemsize
                if dtype.hasobject or entry.file_size != num_bytes:
                    raise ValueError(f"{path!r} is no array of numbers of the size that it states")
                headers[path] = (shape, dtype, num_bytes)
    except Exception as error:  # zipfile and NumPy raise a dozen kinds on damaged files.
        raise ValueError(f"no sound .npz file: {error}") from None
    return headers


def read_arrays(packed: bytes, headers: Mapping[str, Header]) -> dict[str, Any]:
    """The arrays, whose headers are those that were expected.

    Raises:
        ValueError: the file is damaged.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as file:
            for path, (_, _, num_bytes) in headers.items():
                with file.open(f"{path}.npy") as member:
                    data = member.read(num_bytes)
                    member.read(1)  # At the end the checksum is compared.
                arrays[path] = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as error:  # As above.
        raise ValueError(f"no sound .npz file: {error}") from None
    return arrays


def packed_arrays(arrays: Mapping[str, Any]) -> bytes:
    """The contents of a .npz file."""
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()
