"""A gated recurrent unit over a whole sequence, arranged for speed.

Same equations as `flax.linen.GRUCell` (Cho et al. 2014, reset gate after the product):

    r = sigmoid(W_r x + b_r + U_r h),   z = sigmoid(W_z x + b_z + U_z h)
    n = tanh(W_n x + b_n + r * (U_n h + c)),   h' = (1 - z) n + z h

Only U h depends on the step before. The input half is one matrix product over all steps, and the
backward pass leaves just one small product a step in its loop: the gradient of U is gathered
afterwards in a single large product. Automatic differentiation would add up a [128, 384] matrix
400 times instead.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array


class GRU(nn.Module):
    """Gated recurrent unit over time-major sequences."""

    hidden_size: int

    @nn.compact
    def __call__(self, inputs: Array, carry: Array) -> tuple[Array, Array]:
        """Run over a sequence.

        Args:
            inputs: [T, B, D].
            carry: [B, H] hidden state before the first step.

        Returns:
            The hidden state after the last step [B, H], and after every step [T, B, H].
        """
        size = self.hidden_size
        input_kernel = self.param(
            "input_kernel", nn.initializers.lecun_normal(), (inputs.shape[-1], 3 * size)
        )
        input_bias = self.param("input_bias", nn.initializers.zeros, (3 * size,))
        hidden_kernel = self.param("hidden_kernel", _orthogonal_gates, (size, 3 * size))
        candidate_bias = self.param("candidate_bias", nn.initializers.zeros, (size,))
        projected = multiply(inputs, input_kernel) + jnp.expand_dims(input_bias, (0, 1))
        hidden = scan_gru(projected, carry, hidden_kernel, candidate_bias)
        return hidden[-1], hidden


def multiply(inputs: Array, kernel: Array) -> Array:
    """Matrix product of [..., D] and [D, E], as one of two dimensions.

    The gradient of the kernel sums over all leading axes; over more than one at once, XLA's CPU
    backend copies both operands into another order first.
    """
    flat = inputs.reshape(-1, inputs.shape[-1]) @ kernel
    return flat.reshape(*inputs.shape[:-1], kernel.shape[-1])


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


@jax.custom_vjp
def scan_gru(projected: Array, carry: Array, hidden_kernel: Array, candidate_bias: Array) -> Array:
    """Hidden states [T, B, H] from projected inputs [T, B, 3 H] in the gate order r, z, n.

    `carry` is [B, H], `hidden_kernel` [H, 3 H], `candidate_bias` [H].
    """
    return _forward(projected, carry, hidden_kernel, candidate_bias)[0]


def _by_gate(array: Array) -> tuple[Array, Array, Array]:
    """Split [..., 3 H] into the three gates.

    Inside a loop the gates stay apart: XLA's CPU code for a slice of a [B, 3 H] array, fused with
    what follows, is scalar and takes twice the time of all the rest.
    """
    reset, update, candidate = jnp.split(array, 3, axis=-1)
    return reset, update, candidate


def _forward(
    projected: Array, carry: Array, hidden_kernel: Array, candidate_bias: Array
) -> tuple[Array, tuple[Array, ...]]:
    reset_kernel, update_kernel, candidate_kernel = _by_gate(hidden_kernel)
    bias = jnp.expand_dims(candidate_bias, 0)

    def advance(
        hidden: Array, inputs: tuple[Array, Array, Array]
    ) -> tuple[Array, tuple[Array, ...]]:
        to_reset, to_update, to_candidate = inputs
        recurrent = hidden @ candidate_kernel + bias
        reset = jax.nn.sigmoid(to_reset + hidden @ reset_kernel)
        update = jax.nn.sigmoid(to_update + hidden @ update_kernel)
        candidate = jnp.tanh(to_candidate + reset * recurrent)
        new_hidden = (1 - update) * candidate + update * hidden
        return new_hidden, (new_hidden, reset, update, candidate, recurrent)

    _, (hidden, *gates) = jax.lax.scan(advance, carry, _by_gate(projected))
    return hidden, (hidden, carry, hidden_kernel, *gates)


def _backward(
    saved: tuple[Array, ...], hidden_gradient: Array
) -> tuple[Array, Array, Array, Array]:
    hidden, carry, hidden_kernel, reset, update, candidate, recurrent = saved
    previous = jnp.concatenate([carry[None], hidden[:-1]])
    transposed = hidden_kernel.T

    def retreat(later: Array, step: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        gradient, before, reset, update, candidate, recurrent = step
        total = gradient + later
        to_candidate = total * (1 - update) * (1 - candidate * candidate)
        to_update = total * (before - candidate) * update * (1 - update)
        to_reset = to_candidate * recurrent * reset * (1 - reset)
        to_recurrent = jnp.concatenate([to_reset, to_update, to_candidate * reset], axis=-1)
        return total * update + to_recurrent @ transposed, (to_recurrent, to_candidate)

    carry_gradient, (to_recurrent, to_candidate) = jax.lax.scan(
        retreat,
        jnp.zeros_like(carry),
        (hidden_gradient, previous, reset, update, candidate, recurrent),
        reverse=True,
    )
    size = carry.shape[-1]
    to_projected = jnp.concatenate([to_recurrent[..., : 2 * size], to_candidate], axis=-1)
    kernel_gradient = previous.reshape(-1, size).T @ to_recurrent.reshape(-1, 3 * size)
    bias_gradient = to_recurrent[..., 2 * size :].sum(axis=(0, 1))
    return to_projected, carry_gradient, kernel_gradient, bias_gradient


scan_gru.defvjp(_forward, _backward)
