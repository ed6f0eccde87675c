"""A gated recurrent unit over a whole sequence, arranged for speed.

Same equations as `flax.linen.GRUCell` (Cho et al. 2014, reset gate after the product):

    r = sigmoid(W_r x + b_r + U_r h),   z = sigmoid(W_z x + b_z + U_z h)
    n = tanh(W_n x + b_n + r * (U_n h + c)),   h' = (1 - z) n + z h

Only U h depends on the step before. The input half is one matrix product over all steps, and the
backward pass leaves just one small product a step in its loop: the gradient of U is gathered
afterwards in a single large product. Automatic differentiation would add up a [128, 384] matrix
400 times instead.

On an NVIDIA GPU the loops are two kernels (`gru_kernel`).
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from sqn_jax.agent import gru_kernel
from sqn_jax.agent.linear import Branches, Linear, sum_rows, then


class GRU(nn.Module):
    """Gated recurrent unit over time-major sequences."""

    hidden_size: int

    @nn.compact
    def __call__(self, inputs: Branches, carry: Array) -> tuple[Array, Array]:
        """Run over a sequence.

        Args:
            inputs: [T, B, D], as outputs of linear layers.
            carry: [B, H] hidden state before the first step.

        Returns:
            The hidden state after the last step [B, H], and after every step [T, B, H].
        """
        size = self.hidden_size
        input_kernel = self.param(
            "input_kernel", nn.initializers.lecun_normal(), (inputs.size, 3 * size)
        )
        input_bias = self.param("input_bias", nn.initializers.zeros, (3 * size,))
        hidden_kernel = self.param("hidden_kernel", _orthogonal_gates, (size, 3 * size))
        candidate_bias = self.param("candidate_bias", nn.initializers.zeros, (size,))
        gates = zip(split_gates(input_kernel), split_gates(input_bias), strict=True)
        reset, update, candidate = then(inputs, [Linear(*gate) for gate in gates])
        hidden = scan_gates((reset, update, candidate), carry, hidden_kernel, candidate_bias)
        return hidden[-1], hidden


def _orthogonal_gates(key: Array, shape: tuple[int, int]) -> Array:
    """One orthogonal matrix for each of the three gates."""
    keys = jax.random.split(key, 3)
    return jnp.concatenate([_orthogonal(gate, shape[0]) for gate in keys], axis=1)


def _orthogonal(key: Array, size: int) -> Array:
    """A random orthogonal matrix [size, size]: the columns of a normal one, made orthonormal.

    Gram and Schmidt, each column twice, not the library's QR: jaxlib's batched factorisation waits
    in a thread of the CPU's pool for other threads of that pool, and several seeds at once on two
    cores then wait for each other for ever.
    """
    normal = jax.random.normal(key, (size, size))

    def add_column(index: Array, columns: Array) -> Array:
        column = normal[:, index]
        for _ in range(2):
            column = column - columns @ (columns.T @ column)
        return columns.at[:, index].set(column * jax.lax.rsqrt(column @ column))

    return jax.lax.fori_loop(0, size, add_column, jnp.zeros((size, size)))


def scan_gru(projected: Array, carry: Array, hidden_kernel: Array, candidate_bias: Array) -> Array:
    """Hidden states [T, B, H] from projected inputs [T, B, 3 H] in the gate order r, z, n.

    `carry` is [B, H], `hidden_kernel` [H, 3 H], `candidate_bias` [H].
    """
    return scan_gates(split_gates(projected), carry, hidden_kernel, candidate_bias)


Gates = tuple[Array, Array, Array]
"""One array for each gate: r, z, n."""


def split_gates(array: Array) -> Gates:
    """Split [..., 3 H] into the three gates.

    From the inputs on, the gates stay apart: XLA's CPU code for a slice of a [B, 3 H] array, fused
    with what follows in a loop, is scalar, and outside of one a copy of tens of megabytes.
    """
    reset, update, candidate = jnp.split(array, 3, axis=-1)
    return reset, update, candidate


@jax.custom_vjp
def scan_gates(
    projected: Gates, carry: Array, hidden_kernel: Array, candidate_bias: Array
) -> Array:
    """`scan_gru` with the projected inputs of each gate on their own, [T, B, H] each."""
    return _forward(projected, carry, hidden_kernel, candidate_bias)[0]


def _forward(
    projected: Gates, carry: Array, hidden_kernel: Array, candidate_bias: Array
) -> tuple[Array, tuple[Array, ...]]:
    given = (projected, carry, split_gates(hidden_kernel), candidate_bias)
    if gru_kernel.fits(len(projected[0]), carry.shape[-1]):
        told = jax.lax.platform_dependent(*given, cuda=gru_kernel.forward, default=_scan_forward)
    else:
        told = _scan_forward(*given)
    hidden, *gates = told
    return hidden, (hidden, carry, hidden_kernel, *gates)


def _scan_forward(
    projected: Gates, carry: Array, kernels: Gates, candidate_bias: Array
) -> tuple[Array, ...]:
    """Hidden state, r, z, n and U_n h + c of each step, [T, B, H] each."""
    reset_kernel, update_kernel, candidate_kernel = kernels
    bias = jnp.expand_dims(candidate_bias, 0)

    def advance(hidden: Array, inputs: Gates) -> tuple[Array, tuple[Array, ...]]:
        to_reset, to_update, to_candidate = inputs
        recurrent = hidden @ candidate_kernel + bias
        reset = jax.nn.sigmoid(to_reset + hidden @ reset_kernel)
        update = jax.nn.sigmoid(to_update + hidden @ update_kernel)
        candidate = jnp.tanh(to_candidate + reset * recurrent)
        new_hidden = (1 - update) * candidate + update * hidden
        return new_hidden, (new_hidden, reset, update, candidate, recurrent)

    told: tuple[Array, ...] = jax.lax.scan(advance, carry, projected)[1]
    return told


def _backward(
    saved: tuple[Array, ...], hidden_gradient: Array
) -> tuple[Gates, Array, Array, Array]:
    hidden, carry, hidden_kernel, *gates = saved
    previous = jnp.concatenate([carry[None], hidden[:-1]])
    given = (hidden_gradient, previous, tuple(gates), split_gates(hidden_kernel))
    if gru_kernel.fits(len(hidden), carry.shape[-1]):
        told = jax.lax.platform_dependent(*given, cuda=gru_kernel.backward, default=_scan_backward)
    else:
        told = _scan_backward(*given)
    carry_gradient, to_projected, to_recurrent = told
    before = previous.reshape(-1, carry.shape[-1]).T
    to_hidden = [x.reshape(-1, x.shape[-1]) for x in (*to_projected[:2], to_recurrent)]
    kernel_gradient = jnp.concatenate([before @ rows for rows in to_hidden], axis=-1)
    return to_projected, carry_gradient, kernel_gradient, sum_rows(to_hidden[2])


def _scan_backward(
    hidden_gradient: Array, previous: Array, gates: tuple[Array, ...], kernels: Gates
) -> tuple[Array, Gates, Array]:
    """Gradients of the carry [B, H], of the projected inputs and of U_n h + c, [T, B, H]."""
    from_reset, from_update, from_candidate = (kernel.T for kernel in kernels)

    def retreat(later: Array, step: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        gradient, before, reset, update, candidate, recurrent = step
        total = gradient + later
        to_candidate = total * (1 - update) * (1 - candidate * candidate)
        to_update = total * (before - candidate) * update * (1 - update)
        to_reset = to_candidate * recurrent * reset * (1 - reset)
        to_recurrent = to_candidate * reset
        to_before = to_reset @ from_reset + to_update @ from_update + to_recurrent @ from_candidate
        return total * update + to_before, (to_reset, to_update, to_candidate, to_recurrent)

    carry_gradient, (*to_projected, to_recurrent) = jax.lax.scan(
        retreat,
        jnp.zeros_like(hidden_gradient[0]),
        (hidden_gradient, previous, *gates),
        reverse=True,
    )
    to_reset, to_update, to_candidate = to_projected
    return carry_gradient, (to_reset, to_update, to_candidate), to_recurrent


scan_gates.defvjp(_forward, _backward)
