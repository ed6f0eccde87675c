"""Keep the stages of a computation apart where fusing them costs more than it saves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


def stage(always: Array, function: Callable[..., Any], *operands: Any) -> Any:
    """Call a function so that it is compiled as a loop of its own on the CPU.

    XLA's CPU backend fuses a chain of element-wise operations with the gather at its end into one
    loop of scalar code, and drops `optimization_barrier` before it does. A conditional stays: each
    stage then compiles to vector instructions. On other devices the function is simply called.

    Args:
        always: True, in a form the compiler cannot know: computed from an array that the compiled
            program takes as an argument, and the same for all robots under `vmap`. Otherwise the
            result is the same, only slower.
        function: from arrays to arrays.
        operands: its arguments.

    Returns:
        What the function returns.
    """

    def apart(always: Array, *operands: Any) -> Any:
        shapes = jax.eval_shape(function, *operands)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return jax.lax.cond(always, function, lambda *_: zeros, *operands)

    def plainly(_: Array, *operands: Any) -> Any:
        return function(*operands)

    return jax.lax.platform_dependent(always, *operands, cpu=apart, default=plainly)
