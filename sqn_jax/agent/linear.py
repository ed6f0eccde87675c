"""Linear layers over all leading axes at once, arranged for speed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


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


class Linear(NamedTuple):
    """A linear layer's `kernel` [D, E] and `bias` [E]."""

    kernel: Array
    bias: Array


def stacked(layers: Sequence[Linear]) -> Linear:
    """One layer [D, E_1 + E_2 + ...] that does what several do with the same inputs.

    One product packs the inputs once, and so does that for the gradients of all kernels.
    """
    if len(layers) == 1:
        return layers[0]
    kernel = jnp.concatenate([layer.kernel for layer in layers], axis=1)
    return Linear(kernel, jnp.concatenate([layer.bias for layer in layers]))


def apply_each(inputs: Array, layers: Sequence[Linear]) -> Array:
    """Several layers [D_i, E_i], each on inputs of its own: [..., D_1 + ...] to [..., E_1 + ...].

    As one product with zeros off the diagonal. Of layers with few inputs or few outputs that takes
    less time than taking their inputs apart.
    """
    if len(layers) == 1:
        return affine(inputs, *layers[0])
    kernel = jax.scipy.linalg.block_diag(*(layer.kernel for layer in layers))
    return affine(inputs, kernel, jnp.concatenate([layer.bias for layer in layers]))


class Branches(NamedTuple):
    """Linear layers side by side, not applied yet: what follows may make it unnecessary."""

    inputs: Array
    """[..., D_1 + D_2 + ...] what the layers are given."""
    layers: tuple[Linear, ...]
    """Kernels [D_i, E_i]."""

    @property
    def size(self) -> int:
        """Number E of outputs, the sum of all E_i."""
        return sum(layer.bias.size for layer in self.layers)

    def outputs(self) -> Array:
        """What the layers make of their inputs, side by side: [..., E]."""
        return apply_each(self.inputs, self.layers)


def then(branches: Branches, following: Linear) -> Array:
    """The outputs of `branches` through a further linear layer [E, F]: [..., F].

    Two linear layers in a row, (x A + a) B + b, are one, x (A B) + (a B + b): fewer multiplications
    for many rows x, and A's output need not be written and read. In a loop with few rows a turn the
    compiler multiplies A and B once, before the loop.
    """
    return affine(branches.inputs, *_composed(branches.layers, following))


def _composed(first: Sequence[Linear], second: Linear) -> Linear:
    """One layer [D, F] for those of `first`, side by side, and `second` [E, F] after them."""
    *ends, _ = accumulate(layer.bias.size for layer in first)
    pieces = jnp.split(second.kernel, ends)
    pairs = list(zip(first, pieces, strict=True))
    kernel = jnp.concatenate([layer.kernel @ piece for layer, piece in pairs])
    return Linear(kernel, second.bias + sum(layer.bias @ piece for layer, piece in pairs))
