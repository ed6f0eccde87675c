"""The linear layer of all networks: `nn.Dense`, with a faster derivative and biases spread out."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array


class Dense(nn.Module):
    """A linear layer over the last axis, with the parameters and the call of `nn.Dense`."""

    features: int
    """Number E of outputs."""
    scale: float = 1.0
    """Scale of the initial weights and biases."""

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        """Map inputs [..., D] to outputs [..., E]."""
        fan_in = inputs.shape[-1]
        initializer = nn.initializers.variance_scaling(self.scale**2, "fan_in", "truncated_normal")
        kernel = self.param("kernel", initializer, (fan_in, self.features))
        bias = self.param("bias", _uniform_bias(self.scale / fan_in**0.5), (self.features,))
        return affine(inputs, kernel, bias)


def _uniform_bias(bound: float) -> nn.initializers.Initializer:
    """Biases spread over +-bound, so that the ReLUs of few inputs bend apart."""

    def initialize(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return initialize


@jax.custom_vjp
def affine(inputs: Array, kernel: Array, bias: Array) -> Array:
    """Matrix product of `inputs` [..., D] and `kernel` [D, E], plus `bias` [E].

    The derivatives sum over all leading axes: as one axis, and the bias's as a product with ones.
    Summed over two axes, XLA's CPU backend first copies both operands of a product into another
    order, and its sum over many rows takes three times as long as the product.
    """
    flat = _rows(inputs) @ kernel + bias[None]
    return flat.reshape(*inputs.shape[:-1], bias.shape[0])


def _rows(array: Array) -> Array:
    return array.reshape(-1, array.shape[-1])


def _forward(inputs: Array, kernel: Array, bias: Array) -> tuple[Array, tuple[Array, Array]]:
    return affine(inputs, kernel, bias), (inputs, kernel)


def _backward(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array, Array]:
    inputs, kernel = saved
    rows = _rows(gradient)
    to_inputs = (rows @ kernel.T).reshape(inputs.shape)
    return to_inputs, _rows(inputs).T @ rows, sum_rows(rows)


def sum_rows(rows: Array) -> Array:
    """[M, E] to [E]."""
    return (jnp.ones((1, rows.shape[0]), rows.dtype) @ rows)[0]


affine.defvjp(_forward, _backward)
