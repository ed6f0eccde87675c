"""Arrays as a file in the format safetensors, of which `sqn_policy.py` reads what is written here.

The format is 8 bytes with the length of a JSON header, the header, and the numbers. To write it
takes fewer lines than to say that a library is missing, and the bytes follow from the arrays alone.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray


def to_safetensors(arrays: Mapping[str, NDArray[np.float32]]) -> bytes:
    """The bytes of a file with these arrays, in the order of their names.

    Raises:
        ValueError: an array is of another type than float32.
    """
    for name, array in arrays.items():
        if array.dtype != np.float32:
            raise ValueError(f"array {name} is of type {array.dtype}, expected float32")
    header = _header({name: array.shape for name, array in arrays.items()})
    return header + b"".join(arrays[name].astype("<f4").tobytes() for name in sorted(arrays))


def from_safetensors(
    data: bytes, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[np.float32]]:
    """The arrays in the bytes of a file, which must be as `to_safetensors` writes these shapes.

    Raises:
        ValueError: it is another file.
    """
    header = _header(shapes)
    sizes = {name: 4 * math.prod(shape) for name, shape in shapes.items()}
    if data[: len(header)] != header or len(data) != len(header) + sum(sizes.values()):
        raise ValueError(f"does not hold the {len(shapes)} arrays of the network and nothing else")
    arrays, start = {}, len(header)
    for name in sorted(shapes):
        numbers = np.frombuffer(data, "<f4", math.prod(shapes[name]), start)
        arrays[name] = numbers.reshape(shapes[name])
        start += sizes[name]
    return arrays


def _header(shapes: Mapping[str, tuple[int, ...]]) -> bytes:
    """What stands before the numbers."""
    entries, start = {}, 0
    for name in sorted(shapes):
        size = 4 * math.prod(shapes[name])
        offsets = [start, start + size]
        entries[name] = {"dtype": "F32", "shape": list(shapes[name]), "data_offsets": offsets}
        start += size
    text = json.dumps(entries, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # So that the numbers begin at a multiple of 8.
    return len(text).to_bytes(8, "little") + text
