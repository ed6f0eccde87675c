"""Checks of what `reset`, `reset_to` and `step` are given, as far as it is known.

Types and shapes are known under `jit` and `vmap` too; numbers are known outside of them only.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.env.params import EnvParams, EnvState


def _is_traced(value: object) -> bool:
    return isinstance(value, jax.core.Tracer)


def require_key(key: object) -> None:
    """Refuse what is no single random key."""
    if isinstance(key, jax.Array | np.ndarray):
        is_typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
        if is_typed and key.shape == ():
            return
        if not is_typed and key.dtype == np.uint32 and key.ndim == 1:  # Of the older kind.
            return
    raise ValueError(
        f"key is {_described(key)}, expected one random key, as from jax.random.key(0)"
    )


def require_params(params: object) -> None:
    """Refuse what `make_env` has not made."""
    if not isinstance(params, EnvParams):
        raise ValueError(f"params is {_described(params)}, expected EnvParams, as from make_env")


def require_state(state: object) -> None:
    """Refuse what is not the state of one robot."""
    if not isinstance(state, EnvState):
        raise ValueError(f"state is {_described(state)}, expected EnvState, as from reset")
    if jnp.shape(state.pose) != (3,):
        raise ValueError(
            f"state.pose has the shape {jnp.shape(state.pose)}, expected (3,): jax.vmap makes many"
        )


def require_action(action: Any, count: int) -> None:
    """Refuse an action that is no whole number, or none from 0 to `count` - 1."""
    try:
        is_number = np.shape(action) == () and jnp.issubdtype(jnp.result_type(action), jnp.integer)
    except (TypeError, ValueError, OverflowError):
        is_number = False
    if not is_number:
        raise ValueError(
            f"action is {_described(action)}, expected one whole number from 0 to {count - 1}"
        )
    if not _is_traced(action) and not 0 <= int(action) < count:
        raise ValueError(f"action is {int(action)}, expected 0 to {count - 1}")


def require_place(name: str, place: object, size: int, params: EnvParams) -> Array:
    """A pose or a goal as an array; refuse one that is not finite or lies outside the map."""
    try:
        array = jnp.asarray(place, jnp.float32)
    except (TypeError, ValueError):
        array = jnp.zeros(())
    if array.shape != (size,):
        raise ValueError(f"{name} is {_described(place)}, expected {size} numbers")
    if _is_traced(array) or _is_traced(params.sight.resolution) or params.sight.width.ndim > 0:
        return array
    numbers = np.asarray(array)
    extent = np.array(params.sight.shape[::-1]) * float(params.sight.resolution)
    if not (
        np.isfinite(numbers).all() and (numbers[:2] >= 0).all() and (numbers[:2] < extent).all()
    ):
        raise ValueError(
            f"{name} is {numbers.tolist()}, expected finite numbers within the map, "
            f"{extent[0]:g} x {extent[1]:g} m"
        )
    return array


def _described(value: object) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return repr(value)[:80] if isinstance(value, int | float | str | None) else type(value).__name__
