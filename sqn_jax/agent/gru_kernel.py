"""The recurrence of the GRU as one kernel on an NVIDIA GPU, forwards and backwards.

As a scan, each of 400 steps starts a few small kernels, and starting them is all that takes time:
as long for 64 robots as for 1,000. Here one program goes through all steps of 16 robots, with the
three recurrent matrices at hand, and nothing is started in between.

The products with these matrices are rounded as XLA rounds float32 products on such a GPU by
default, to 10 bits after the leading one. Float16 has as many, and everything here lies in its
range: a hidden state in -1..1, weights around 1, and gradients over the largest of their row. Sums
and all else are float32.

The equations are those of `gru`, whose scans are the reference, and what runs on any other device.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.experimental import pallas as pl

try:
    from jax.experimental.pallas import triton as pl_triton
except ImportError:  # Deprecated since jax 0.11: one day there will be none.
    pl_triton = None  # type: ignore[assignment]

LARGEST_SIZE = 128
"""Hidden units whose matrices fit the shared memory of a multiprocessor, three of 32 KB."""

WITH_ROOM = ("8.0", "8.7", "9.0", "10.0", "10.3", "11.0")
"""Compute capabilities with more than 100 KB of shared memory a program: not those of a GeForce."""

SHORTEST = 8
"""Steps from which on a kernel pays: it first reads all three matrices."""

ROWS = 16
"""Robots of a program: the height of the tile that a tensor core multiplies."""

WARPS = 8
"""Of 32 threads in a program."""

Gates = tuple[Array, Array, Array]


def fits(num_steps: int, hidden_size: int) -> bool:
    """Whether there is a kernel for these sizes on JAX's default device."""
    is_power_of_two = hidden_size & (hidden_size - 1) == 0
    has_size = is_power_of_two and 16 <= hidden_size <= LARGEST_SIZE and num_steps >= SHORTEST
    return has_size and pl_triton is not None and _compute_capability() in WITH_ROOM


def _compute_capability() -> str | None:
    """That of the default device; None for what is no NVIDIA GPU."""
    return getattr(jax.devices()[0], "compute_capability", None)


def forward(
    projected: Array, carry: Array, kernels: Gates, bias: Array, *, interpret: bool = False
) -> tuple[Array, ...]:
    """Hidden states and what the backward pass needs.

    Args:
        projected: the input half of gates r, z, n side by side, [T, B, 3 H].
        carry: [B, H].
        kernels: the recurrent matrices of the gates, [H, H] each.
        bias: [H] of the candidate's recurrent half.
        interpret: run as plain array operations, on any device.

    Returns:
        Hidden state, r, z, n, and the candidate's recurrent half U_n h + c, [T, B, H] each.
    """
    num_steps, (batch, size) = len(projected), carry.shape
    sequence, state, matrix, vector = _blocks(num_steps, size)
    filled = [_fill(x, axis=1) for x in jnp.split(projected, 3, axis=-1)]
    call = pl.pallas_call(
        partial(_forward_body, num_steps=num_steps),
        out_shape=[jax.ShapeDtypeStruct(filled[0].shape, carry.dtype)] * 5,
        grid=(filled[0].shape[1] // ROWS,),
        in_specs=[sequence] * 3 + [state] + [matrix] * 3 + [vector],
        out_specs=[sequence] * 5,
        compiler_params=None if interpret else pl_triton.CompilerParams(num_warps=WARPS),
        interpret=interpret,
        name="gru_forward",
    )
    outputs = call(*filled, _fill(carry, axis=0), *kernels, bias)
    return tuple(x[:, :batch] for x in outputs)


def backward(
    hidden_gradient: Array, previous: Array, gates: Any, kernels: Gates, *, interpret: bool = False
) -> tuple[Array, Array, Array]:
    """Gradients of what goes into each step.

    Args:
        hidden_gradient: of the hidden states, [T, B, H].
        previous: the hidden state before each step, [T, B, H].
        gates: r, z, n and the recurrent half from `forward`.
        kernels: as in `forward`.
        interpret: as in `forward`.

    Returns:
        Gradients of the carry [B, H], and of both halves of the gates, the projected inputs and the
        recurrent half, [T, B, 3 H] each.
    """
    num_steps, batch, size = previous.shape
    sequence, state, matrix, _ = _blocks(num_steps, size)
    filled = [_fill(x, axis=1) for x in (hidden_gradient, previous, *gates)]
    robots, dtype = filled[0].shape[1], previous.dtype
    call = pl.pallas_call(
        partial(_backward_body, num_steps=num_steps),
        out_shape=[jax.ShapeDtypeStruct((robots, size), dtype)]
        + [jax.ShapeDtypeStruct(filled[0].shape, dtype)] * 4,
        grid=(robots // ROWS,),
        in_specs=[sequence] * 6 + [matrix] * 3,
        out_specs=[state] + [sequence] * 4,
        compiler_params=None if interpret else pl_triton.CompilerParams(num_warps=WARPS),
        interpret=interpret,
        name="gru_backward",
    )
    to_carry, *outputs = call(*filled, *(x.T for x in kernels))
    to_reset, to_update, to_candidate, to_recurrent = (x[:, :batch] for x in outputs)
    halves = ((to_reset, to_update, to_candidate), (to_reset, to_update, to_recurrent))
    to_projected, to_hidden = (jnp.concatenate(half, axis=-1) for half in halves)
    return to_carry[:batch], to_projected, to_hidden


def _fill(array: Array, axis: int) -> Array:
    """With rows of zeros up to a multiple of `ROWS`."""
    missing = -array.shape[axis] % ROWS
    if not missing:
        return array
    widths = [(0, 0)] * array.ndim
    widths[axis] = (0, missing)
    return jnp.pad(array, widths)


def _blocks(num_steps: int, size: int) -> tuple[pl.BlockSpec, ...]:
    """What program b sees: of sequences and states its robots', of a matrix or a vector all."""
    return (
        pl.BlockSpec((num_steps, ROWS, size), lambda b: (0, b, 0)),
        pl.BlockSpec((ROWS, size), lambda b: (b, 0)),
        pl.BlockSpec((size, size), lambda b: (0, 0)),
        pl.BlockSpec((size,), lambda b: (0,)),
    )


def _forward_body(
    to_reset: Any,
    to_update: Any,
    to_candidate: Any,
    carry: Any,
    reset_kernel: Any,
    update_kernel: Any,
    candidate_kernel: Any,
    bias: Any,
    *results: Any,
    num_steps: int,
) -> None:
    kernels = [x[...].astype(jnp.float16) for x in (reset_kernel, update_kernel, candidate_kernel)]
    offset = bias[...][None]
    inputs = (to_reset, to_update, to_candidate)

    def advance(step: Array, loop_state: tuple[Array, Any]) -> tuple[Array, Any]:
        hidden, projected = loop_state
        # Asked for a step ahead: memory answers after as long as a step takes.
        upcoming = _read(inputs, jnp.minimum(step + 1, num_steps - 1))
        rounded = hidden.astype(jnp.float16)
        from_reset, from_update, from_candidate = (_product(rounded, x) for x in kernels)
        recurrent = from_candidate + offset
        reset = jax.nn.sigmoid(projected[0] + from_reset)
        update = jax.nn.sigmoid(projected[1] + from_update)
        candidate = _tanh(projected[2] + reset * recurrent)
        new_hidden = (1 - update) * candidate + update * hidden
        _write(results, step, (new_hidden, reset, update, candidate, recurrent))
        return new_hidden, upcoming

    jax.lax.fori_loop(0, num_steps, advance, (carry[...], _read(inputs, 0)))


def _backward_body(
    hidden_gradient: Any,
    previous: Any,
    reset_gate: Any,
    update_gate: Any,
    candidate_gate: Any,
    recurrent_half: Any,
    reset_kernel: Any,
    update_kernel: Any,
    candidate_kernel: Any,
    carry_out: Any,
    *results: Any,
    num_steps: int,
) -> None:
    kernels = [x[...].astype(jnp.float16) for x in (reset_kernel, update_kernel, candidate_kernel)]
    inputs = (
        hidden_gradient,
        previous,
        reset_gate,
        update_gate,
        candidate_gate,
        recurrent_half,
    )

    def retreat(index: Array, loop_state: tuple[Array, Any]) -> tuple[Array, Any]:
        later, (gradient, before, reset, update, candidate, recurrent) = loop_state
        step = num_steps - 1 - index
        upcoming = _read(inputs, jnp.maximum(step - 1, 0))
        total = gradient + later
        to_candidate = total * (1 - update) * (1 - candidate * candidate)
        to_update = total * (before - candidate) * update * (1 - update)
        to_reset = to_candidate * recurrent * reset * (1 - reset)
        to_recurrent = to_candidate * reset
        _write(results, step, (to_reset, to_update, to_candidate, to_recurrent))
        rows = (to_reset, to_update, to_recurrent)
        largest = jnp.maximum(jnp.maximum(jnp.abs(rows[0]), jnp.abs(rows[1])), jnp.abs(rows[2]))
        scale = jnp.maximum(largest.max(axis=1, keepdims=True), 1e-30)
        scaled = [(x / scale).astype(jnp.float16) for x in rows]
        products = [_product(x, kernel) for x, kernel in zip(scaled, kernels, strict=True)]
        return total * update + scale * (products[0] + products[1] + products[2]), upcoming

    start = (jnp.zeros(carry_out.shape, jnp.float32), _read(inputs, num_steps - 1))
    carry_out[...] = jax.lax.fori_loop(0, num_steps, retreat, start)[0]


def _product(left: Array, right: Array) -> Array:
    return jax.lax.dot(left, right, preferred_element_type=jnp.float32)


def _read(sequences: tuple[Any, ...], step: Array | int) -> tuple[Array, ...]:
    return tuple(x[step] for x in sequences)


def _write(sequences: tuple[Any, ...], step: Array, values: tuple[Array, ...]) -> None:
    for sequence, value in zip(sequences, values, strict=True):
        sequence[step] = value


def _tanh(x: Array) -> Array:
    """By way of the sigmoid: Triton has none of its own outside its device library."""
    return 2 * jax.nn.sigmoid(2 * x) - 1
