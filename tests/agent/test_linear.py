"""Linear layers against NumPy in double precision, and their derivatives against the formula's."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from sqn_jax.agent.linear import (
    Branches,
    Linear,
    affine,
    apply_each,
    stacked,
    sum_rows,
    then,
)


def arrays(*leading: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(len(leading))
    return rng.normal(size=(*leading, 4)), rng.normal(size=(4, 3)), rng.normal(size=3)


@pytest.mark.parametrize("leading", [(), (5,), (2, 5), (3, 2, 5)])
def test_it_is_a_product_and_a_sum_whatever_the_leading_axes(leading: tuple[int, ...]) -> None:
    inputs, kernel, bias = arrays(*leading)
    got = affine(*(jnp.asarray(x, jnp.float32) for x in (inputs, kernel, bias)))
    np.testing.assert_allclose(got, inputs @ kernel + bias, atol=1e-5)


def test_its_derivative_is_that_of_the_formula() -> None:
    """d/dX = G K', d/dK = X' G and d/db = 1' G over all rows, in double precision by NumPy."""
    inputs, kernel, bias = arrays(3, 2)
    weights = np.random.default_rng(9).normal(size=(3, 2, 3))

    def loss(*given: Array) -> Array:
        return (affine(*given) * jnp.asarray(weights, jnp.float32)).sum()

    singles = (jnp.asarray(x, jnp.float32) for x in (inputs, kernel, bias))
    to_inputs, to_kernel, to_bias = jax.grad(loss, argnums=(0, 1, 2))(*singles)
    np.testing.assert_allclose(to_inputs, weights @ kernel.T, atol=1e-5)
    np.testing.assert_allclose(to_kernel, np.einsum("abd,abe->de", inputs, weights), atol=1e-5)
    np.testing.assert_allclose(to_bias, weights.sum(axis=(0, 1)), atol=1e-5)


def test_several_seeds_side_by_side_have_the_derivatives_of_each_alone() -> None:
    inputs, kernel, bias = (
        jnp.asarray(np.stack([x, 2 * x - 1]), jnp.float32) for x in arrays(3, 2)
    )
    gradient = jax.grad(lambda k, b, x: (affine(x, k, b) ** 2).sum(), argnums=(0, 1))
    together = jax.vmap(gradient)(kernel, bias, inputs)
    for seed in range(2):
        alone = gradient(kernel[seed], bias[seed], inputs[seed])
        for one, many in zip(alone, together, strict=True):
            np.testing.assert_allclose(many[seed], one, rtol=1e-4)


def test_rows_are_summed() -> None:
    rows = jnp.arange(12.0).reshape(4, 3)
    assert sum_rows(rows).tolist() == [0 + 3 + 6 + 9, 1 + 4 + 7 + 10, 2 + 5 + 8 + 11]


SIZES = ((5, 4), (3, 6))
"""D_i and E_i of two layers side by side."""
AFTER = 7
"""F of a layer that follows both."""
FEW, MANY = 2, 400


def random_layers(rng: np.random.Generator, sizes: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(rng.normal(size=(given, made)), rng.normal(size=made)) for given, made in sizes]


def as_linear(layers: Any) -> list[Linear]:
    return [Linear(*(jnp.asarray(x, jnp.float32) for x in layer)) for layer in layers]


def test_stacked_layers_do_what_each_does_with_the_same_inputs() -> None:
    rng = np.random.default_rng(1)
    layers = random_layers(rng, [(5, 4), (5, 1), (5, 3)])
    inputs = rng.normal(size=(2, 5))
    got = affine(jnp.asarray(inputs, jnp.float32), *stacked(as_linear(layers)))
    expected = [inputs @ kernel + bias for kernel, bias in layers]
    np.testing.assert_allclose(got, np.concatenate(expected, axis=1), atol=1e-5)


def test_layers_with_inputs_of_their_own_see_nothing_of_each_other_s() -> None:
    rng = np.random.default_rng(2)
    layers = random_layers(rng, [(5, 4), (3, 1), (2, 6)])
    inputs = [rng.normal(size=(2, given)) for given in (5, 3, 2)]
    joined = jnp.asarray(np.concatenate(inputs, axis=1), jnp.float32)
    got = apply_each(joined, as_linear(layers))
    expected = [x @ kernel + bias for x, (kernel, bias) in zip(inputs, layers, strict=True)]
    np.testing.assert_allclose(got, np.concatenate(expected, axis=1), atol=1e-5)


def two_then_one(rows: int) -> tuple[list[np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
    """Random inputs of two layers, and the kernels and biases of all three layers."""
    rng = np.random.default_rng(rows)
    inputs = [rng.normal(size=(2, rows // 2, given)) for given, _ in SIZES]
    return inputs, random_layers(rng, [*SIZES, (4 + 6, AFTER)])


def in_a_row(inputs: Sequence[Any], layers: list[Linear]) -> Array:
    first, second, following = layers
    joined = jnp.concatenate([jnp.asarray(x, jnp.float32) for x in inputs], axis=-1)
    return then(Branches(joined, (first, second)), following)


def test_layers_in_a_row_are_one_after_the_other() -> None:
    inputs, layers = two_then_one(MANY)
    outputs = [x @ kernel + bias for x, (kernel, bias) in zip(inputs, layers, strict=False)]
    kernel, bias = layers[2]
    expected = np.concatenate(outputs, axis=-1) @ kernel + bias
    got = in_a_row(inputs, as_linear(layers))
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4)


def test_layers_in_a_row_have_the_derivatives_of_the_product_written_out() -> None:
    inputs, layers = two_then_one(MANY)

    def written_out(layers: list[Linear]) -> Array:
        outputs = [
            jnp.asarray(x, jnp.float32) @ kernel + bias[None, None]
            for x, (kernel, bias) in zip(inputs, layers, strict=False)
        ]
        kernel, bias = layers[2]
        return jnp.sin(jnp.concatenate(outputs, axis=-1) @ kernel + bias[None, None]).sum()

    def ours(layers: list[Linear]) -> Array:
        return jnp.sin(in_a_row(inputs, layers)).sum()

    found = [jax.tree.leaves(jax.grad(f)(as_linear(layers))) for f in (ours, written_out)]
    for got, expected in zip(*found, strict=True):
        np.testing.assert_allclose(got, expected, rtol=2e-3, atol=2e-3)


def test_many_rows_through_layers_in_a_row_take_the_multiplications_of_one_layer() -> None:
    """By XLA's own count, which also has the few additions."""
    inputs, layers = two_then_one(MANY)
    compiled = jax.jit(lambda layers: in_a_row(inputs, layers)).lower(as_linear(layers)).compile()
    one_layer = 2 * MANY * (5 + 3) * AFTER
    both_kernels = 2 * (5 * 4 + 3 * 6) * AFTER
    assert one_layer <= compiled.cost_analysis()["flops"] < 1.35 * (one_layer + both_kernels)


def test_few_rows_in_a_loop_do_not_multiply_the_layers_again_and_again() -> None:
    """What XLA's loop is given is the one layer, [8, 7], not the last of the two, [10, 7]."""
    inputs, layers = two_then_one(FEW)

    def turns(layers: list[Linear]) -> Array:
        def turn(total: Array, _: None) -> tuple[Array, None]:
            return in_a_row([x + total for x in inputs], layers).sum(), None

        return jax.lax.scan(turn, jnp.float32(0), None, length=9)[0]

    text = jax.jit(turns).lower(as_linear(layers)).compile().as_text()
    (held,) = re.findall(r" = \((.*)\) while\(", text)
    assert "f32[8,7]" in held
    assert "f32[10,7]" not in held
