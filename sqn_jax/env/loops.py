"""Short loops, written out where starting a kernel is what takes time, and traced but once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
from jax import Array

Carry = TypeVar("Carry")

traced_once = partial(jax.jit, inline=True)
"""For what is written out at length: a process traces it once, not for each program anew. The
programs are the same."""


def repeat(
    count: int, body: Callable[[Array | int, Carry], Carry], start: Carry, *, unroll: int
) -> Carry:
    """`jax.lax.fori_loop` from 0 to `count`, a few passes at a time; on a GPU, all of them.

    On a CPU the compiler repeats what passes written out one after the other have in common, and on
    a GPU each pass of a loop is a few kernels that take longer to start than to run.
    """
    on_gpu = jax.default_backend() == "gpu"
    result: Carry = jax.lax.fori_loop(0, count, body, start, unroll=on_gpu or unroll)
    return result
