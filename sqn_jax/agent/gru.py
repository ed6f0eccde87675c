"""A gated recurrent unit over a whole sequence, arranged for speed.

Same equations as `flax.linen.GRUCell` (Cho et al. 2014, reset gate after the product):

    r = sigmoid(W_r x + b_r + U_r h),   z = sigmoid(W_z x + b_z + U_z h)
    n = tanh(W_n x + b_n + r * (U_n h + c)),   h' = (1 - z) n + z h

Only U h depends on the step before. The input half is one matrix product over all steps, and the
backward pass leaves just the three small products of a step in its loop: the gradients of both
halves' matrices are gathered afterward in a single large product each, from arrays with the three
gates side by side. Automatic differentiation would add up a [128, 384] matrix 400 times instead.

On an NVIDIA GPU with enough memory the loops are two kernels (`gru_kernel`).
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from sqn_jax.agent import gru_kernel
from sqn_jax.agent.linear import affine, sum_rows


class GRU(nn.Module):
    """Gated recurrent unit over time-major sequences."""

    hidden_size: int

    @nn.compact
    def __call__(self, inputs: Array, carry: Array) -> tuple[Array, Array]:
        """Run over a sequence.

        Args:
            inputs: [T, B, D] features.
            carry: [B, H] hidden state before the first step.

        Returns:
            The hidden state after the last step [B, H], and after every step [T, B, H].
        """
        size = self.hidden_size
        input_kernel = self.param(
            "input_kernel", nn.initializers.lecun_normal(), (inputs.shape[-1], 3 * size)
        )
        input_bias = self.param("input_bias", nn.initializers.zeros, (3 * size,))
        hidden_kernel = self.param("hidden_kernel", orthogonal_gates, (size, 3 * size))
        candidate_bias = self.param("candidate_bias", nn.initializers.zeros, (size,))
        projected = affine(inputs, input_kernel, input_bias)
        hidden = scan_gru(projected, carry, hidden_kernel, candidate_bias)
        return hidden[-1], hidden


def orthogonal_gates(key: Array, shape: tuple[int, int]) -> Array:
    """One orthogonal matrix for each gate [H, H] of a kernel of this shape, [H, gates H]."""
    keys = jax.random.split(key, shape[1] // shape[0])
    return jnp.concatenate([_orthogonal(gate, shape[0]) for gate in keys], axis=1)


def _orthogonal(key: Array, size: int) -> Array:
    """A random orthogonal matrix [size, size]: the columns of a normal one, made orthonormal.

    Gram and Schmidt, each column twice, not the library's QR: jaxlib's batched factorization waits
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


Gates = tuple[Array, Array, Array]
"""One array for each gate: r, z, n."""


def split_gates(array: Array) -> Gates:
    """Split [..., 3 H] into the three gates."""
    reset, update, candidate = jnp.split(array, 3, axis=-1)
    return reset, update, candidate


@jax.custom_vjp
def scan_gru(projected: Array, carry: Array, hidden_kernel: Array, candidate_bias: Array) -> Array:
    """Hidden states [T, B, H] from projected inputs [T, B, 3 H] in the gate order r, z, n.

    `carry` is [B, H], `hidden_kernel` [H, 3 H], `candidate_bias` [H].
    """
    return _forward(projected, carry, hidden_kernel, candidate_bias)[0]


def _forward(
    projected: Array, carry: Array, hidden_kernel: Array, candidate_bias: Array
) -> tuple[Array, tuple[Array, ...]]:
    arguments = (projected, carry, split_gates(hidden_kernel), candidate_bias)
    if gru_kernel.fits(len(projected), carry.shape[-1]):
        outputs = jax.lax.platform_dependent(
            *arguments, cuda=gru_kernel.forward, default=_scan_forward
        )
    else:
        outputs = _scan_forward(*arguments)
    hidden, *gates = outputs
    return hidden, (hidden, carry, hidden_kernel, *gates)


def _scan_forward(
    projected: Array, carry: Array, kernels: Gates, candidate_bias: Array
) -> tuple[Array, ...]:
    """Hidden state, r, z, n and U_n h + c of each step, [T, B, H] each."""
    reset_kernel, update_kernel, candidate_kernel = kernels
    bias = jnp.expand_dims(candidate_bias, 0)

    def advance(hidden: Array, step: Array) -> tuple[Array, tuple[Array, ...]]:
        # Read gate by gate: XLA's CPU code for a slice of a [B, 3 H] array is scalar.
        to_reset, to_update, to_candidate = (
            jax.lax.dynamic_slice(projected, (step, 0, place), (1, *hidden.shape))[0]
            for place in _places(hidden)
        )
        recurrent = hidden @ candidate_kernel + bias
        reset = jax.nn.sigmoid(to_reset + hidden @ reset_kernel)
        update = jax.nn.sigmoid(to_update + hidden @ update_kernel)
        candidate = jnp.tanh(to_candidate + reset * recurrent)
        new_hidden = (1 - update) * candidate + update * hidden
        return new_hidden, (new_hidden, reset, update, candidate, recurrent)

    outputs: tuple[Array, ...] = jax.lax.scan(advance, carry, jnp.arange(len(projected)))[1]
    return outputs


def _places(hidden: Array) -> tuple[int, int, int]:
    """Where in an array with the gates side by side each of them starts."""
    size = hidden.shape[-1]
    return 0, size, 2 * size


def _backward(
    saved: tuple[Array, ...], hidden_gradient: Array
) -> tuple[Array, Array, Array, Array]:
    hidden, carry, hidden_kernel, *gates = saved
    previous = jnp.concatenate([carry[None], hidden[:-1]])
    arguments = (hidden_gradient, previous, tuple(gates), split_gates(hidden_kernel))
    if gru_kernel.fits(len(hidden), carry.shape[-1]):
        outputs = jax.lax.platform_dependent(
            *arguments, cuda=gru_kernel.backward, default=_scan_backward
        )
    else:
        outputs = _scan_backward(*arguments)
    carry_gradient, to_projected, to_recurrent = outputs
    size = carry.shape[-1]
    rows = to_recurrent.reshape(-1, 3 * size)
    kernel_gradient = previous.reshape(-1, size).T @ rows
    return to_projected, carry_gradient, kernel_gradient, sum_rows(rows)[2 * size :]


def _scan_backward(
    hidden_gradient: Array, previous: Array, gates: tuple[Array, ...], kernels: Gates
) -> tuple[Array, Array, Array]:
    """Gradients of the carry [B, H], and of W x + b and U h + (0, 0, c), [T, B, 3 H] each."""
    from_reset, from_update, from_candidate = (kernel.T for kernel in kernels)
    num_steps, *shape = previous.shape
    rows = jnp.zeros((num_steps, shape[0], 3 * shape[1]), previous.dtype)

    def retreat(
        carried: tuple[Array, Array, Array], inputs: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array, Array], None]:
        later, to_projected, to_recurrent = carried
        step, gradient, before, reset, update, candidate, recurrent = inputs
        total = gradient + later
        to_candidate = total * (1 - update) * (1 - candidate * candidate)
        to_update = total * (before - candidate) * update * (1 - update)
        to_reset = to_candidate * recurrent * reset * (1 - reset)
        to_inner = to_candidate * reset
        to_before = to_reset @ from_reset + to_update @ from_update + to_inner @ from_candidate
        # Written gate by gate, as they are read: a concatenation first would be scalar, too.
        halves = (to_reset, to_update, to_candidate), (to_reset, to_update, to_inner)
        for place, from_input, from_hidden in zip(_places(later), *halves, strict=True):
            start = (step, 0, place)
            to_projected = jax.lax.dynamic_update_slice(to_projected, from_input[None], start)
            to_recurrent = jax.lax.dynamic_update_slice(to_recurrent, from_hidden[None], start)
        return (total * update + to_before, to_projected, to_recurrent), None

    outputs: tuple[Array, Array, Array] = jax.lax.scan(
        retreat,
        (jnp.zeros_like(hidden_gradient[0]), rows, rows),
        (jnp.arange(num_steps), hidden_gradient, previous, *gates),
        reverse=True,
    )[0]
    return outputs


scan_gru.defvjp(_forward, _backward)
