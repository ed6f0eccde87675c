"""A gated recurrent unit whose candidate is scaled by the input, with a refined update gate.

After the spatially enhanced recurrent units of Yang et al. 2025 ("Spatially-Enhanced Recurrent
Memory for Long-Range Mapless Navigation"), on the equations of `agent.gru`:

    i = sigmoid(W_i x + b_i + U_i h),   g = i (1 - (1 - z)^2) + (1 - i) z^2
    s = W_s x + b_s,                    n = tanh(s (W_n x + b_n + r (U_n h + c)))
    h' = (1 - g) n + g h

with r and z as there. The product with s lets what is seen stretch and turn over what is
remembered, as a move does to places; i lets the gate come near 0 or 1, where the sigmoid of z alone
hardly learns. With s = 1 and i = 1/2 it is the GRU: g = z.

As there, only U h stays in the loops. The derivative of a step is that of `_step` by automatic
differentiation; the matrices' gradients are gathered afterward in one product.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from sqn_jax.agent.gru import orthogonal_gates
from sqn_jax.agent.linear import affine, sum_rows

Gates = tuple[Array, ...]
"""One array for each of r, z, i, n, and of what comes from the input a fifth for s."""


class RefinedGRU(nn.Module):
    """The unit over time-major sequences; it takes the place of `GRU`."""

    hidden_size: int

    @nn.compact
    def __call__(self, inputs: Array, carry: Array) -> tuple[Array, Array]:
        """Run over a sequence, as `GRU` does."""
        size = self.hidden_size
        input_kernel = self.param(
            "input_kernel", nn.initializers.lecun_normal(), (inputs.shape[-1], 5 * size)
        )
        input_bias = self.param("input_bias", _initial_bias, (5 * size,))
        hidden_kernel = self.param("hidden_kernel", orthogonal_gates, (size, 4 * size))
        candidate_bias = self.param("candidate_bias", nn.initializers.zeros, (size,))
        projected = affine(inputs, input_kernel, input_bias)
        hidden = scan_refined_gru(projected, carry, hidden_kernel, candidate_bias)
        return hidden[-1], hidden


def _initial_bias(key: Array, shape: tuple[int]) -> Array:
    """0 for the gates and 1 for the scale: on average, a GRU."""
    del key
    return (jnp.arange(shape[0]) >= shape[0] // 5 * 4).astype(jnp.float32)


def _step(projected: Gates, recurrent: Gates, hidden: Array) -> Array:
    """The next hidden state from [B, H] arrays: W x + b, U h + (0, 0, 0, c) and h."""
    to_reset, to_update, to_refine, to_candidate, scale = projected
    from_reset, from_update, from_refine, from_candidate = recurrent
    reset = jax.nn.sigmoid(to_reset + from_reset)
    update = jax.nn.sigmoid(to_update + from_update)
    refine = jax.nn.sigmoid(to_refine + from_refine)
    candidate = jnp.tanh(scale * (to_candidate + reset * from_candidate))
    gate = refine * (1 - (1 - update) ** 2) + (1 - refine) * update**2
    return (1 - gate) * candidate + gate * hidden


@jax.custom_vjp
def scan_refined_gru(
    projected: Array, carry: Array, hidden_kernel: Array, candidate_bias: Array
) -> Array:
    """Hidden states [T, B, H] from projected inputs [T, B, 5 H] in the order r, z, i, n, s.

    `carry` is [B, H], `hidden_kernel` [H, 4 H], `candidate_bias` [H].
    """
    return _forward(projected, carry, hidden_kernel, candidate_bias)[0]


def _forward(
    projected: Array, carry: Array, hidden_kernel: Array, candidate_bias: Array
) -> tuple[Array, tuple[Array, ...]]:
    kernels, bias = jnp.split(hidden_kernel, 4, axis=1), candidate_bias[None]

    def advance(hidden: Array, projected: Gates) -> tuple[Array, Array]:
        *gates, candidate = (hidden @ kernel for kernel in kernels)
        hidden = _step(projected, (*gates, candidate + bias), hidden)
        return hidden, hidden

    hidden = jax.lax.scan(advance, carry, tuple(jnp.split(projected, 5, axis=-1)))[1]
    return hidden, (projected, carry, hidden_kernel, candidate_bias, hidden)


def _backward(saved: tuple[Array, ...], gradient: Array) -> tuple[Array, Array, Array, Array]:
    projected, carry, hidden_kernel, candidate_bias, hidden = saved
    size = carry.shape[-1]
    previous = jnp.concatenate([carry[None], hidden[:-1]])
    recurrent = affine(previous, hidden_kernel, jnp.pad(candidate_bias, (3 * size, 0)))
    back = [kernel.T for kernel in jnp.split(hidden_kernel, 4, axis=1)]

    def retreat(
        later: Array, inputs: tuple[Array, Array, Gates, Gates]
    ) -> tuple[Array, tuple[Gates, Gates]]:
        gradient, before, projected, recurrent = inputs
        _, pull_back = jax.vjp(_step, projected, recurrent, before)
        to_projected, to_recurrent, to_before = pull_back(gradient + later)
        products = (x @ kernel for x, kernel in zip(to_recurrent, back, strict=True))
        return sum(products, to_before), (to_projected, to_recurrent)

    steps = (
        gradient,
        previous,
        tuple(jnp.split(projected, 5, axis=-1)),
        tuple(jnp.split(recurrent, 4, axis=-1)),
    )
    to_carry, gates = jax.lax.scan(retreat, jnp.zeros_like(carry), steps, reverse=True)
    to_projected, to_recurrent = (jnp.concatenate(x, axis=-1) for x in gates)
    rows = to_recurrent.reshape(-1, 4 * size)
    to_kernel = previous.reshape(-1, size).T @ rows
    return to_projected, to_carry, to_kernel, sum_rows(rows)[3 * size :]


scan_refined_gru.defvjp(_forward, _backward)
