"""Linear layers over all leading axes at once, arranged for speed."""

from __future__ import annotations

import math
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


class Branches(NamedTuple):
    """Linear layers side by side, not applied yet: what follows may make it unnecessary."""

    inputs: tuple[Array, ...]
    """[..., D_i] what each layer is given."""
    layers: tuple[Linear, ...]
    """Kernels [D_i, E_i]."""

    @property
    def size(self) -> int:
        """Number E of outputs, the sum of all E_i."""
        return sum(layer.bias.size for layer in self.layers)

    def outputs(self) -> Array:
        """What the layers make of their inputs, side by side: [..., E]."""
        pairs = zip(self.inputs, self.layers, strict=True)
        outputs = [affine(inputs, *layer) for inputs, layer in pairs]
        return outputs[0] if len(outputs) == 1 else jnp.concatenate(outputs, axis=-1)


def then(branches: Branches, following: Sequence[Linear]) -> tuple[Array, ...]:
    """The outputs of `branches` through each of further linear layers, [..., F_j] each.

    Two linear layers in a row, (x A + a) B + b, are one, x (A B) + (a B + b). Of many rows x that
    takes fewer multiplications, and A's output need not be written and read; of few it takes more.
    The order is chosen by their number.

    Args:
        branches: with E outputs in all.
        following: kernels [E, F_j].
    """
    rows = math.prod(branches.inputs[0].shape[:-1])
    ahead = sum(layer.bias.size for layer in following)
    given = sum(layer.kernel.shape[0] for layer in branches.layers)
    apart = rows * sum(layer.kernel.size for layer in (*branches.layers, *following))
    at_once = ahead * (rows * given + sum(layer.kernel.size for layer in branches.layers))
    if apart <= at_once:
        return one_by_one(branches, following)
    inputs = jnp.concatenate(branches.inputs, axis=-1)
    return tuple(affine(inputs, *_composed(branches.layers, layer)) for layer in following)


def one_by_one(branches: Branches, following: Sequence[Linear]) -> tuple[Array, ...]:
    """What `then` returns, layer by layer, as a network is written."""
    outputs = branches.outputs()
    return tuple(affine(outputs, *layer) for layer in following)


def _composed(first: Sequence[Linear], second: Linear) -> Linear:
    """One layer [D, F] for those of `first`, side by side, and `second` [E, F] after them."""
    *ends, _ = accumulate(layer.bias.size for layer in first)
    pieces = jnp.split(second.kernel, ends)
    pairs = list(zip(first, pieces, strict=True))
    kernel = jnp.concatenate([layer.kernel @ piece for layer, piece in pairs])
    return Linear(kernel, second.bias + sum(layer.bias @ piece for layer, piece in pairs))
