"""Linear layers against NumPy in double precision, and their derivatives against the formula's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from sqn_jax.agent.linear import Branches, Linear, affine, sum_rows, then


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
FOLLOWING = (7, 2)
"""F_j of two layers that follow both."""
FEW, MANY = 2, 400


def two_after_two(rows: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Random inputs of two layers and the kernels and biases of all four layers."""
    rng = np.random.default_rng(rows)
    inputs = [rng.normal(size=(2, rows // 2, given)) for given, _ in SIZES]
    shapes = [*SIZES, *((4 + 6, made) for made in FOLLOWING)]
    layers = [rng.normal(size=shape) for given, made in shapes for shape in ((given, made), made)]
    return inputs, layers


def two_in_a_row(inputs: list[Array], layers: list[Array]) -> tuple[Array, ...]:
    singles = [jnp.asarray(x, jnp.float32) for x in layers]
    first, second, *following = (
        Linear(*pair) for pair in zip(singles[::2], singles[1::2], strict=True)
    )
    given = tuple(jnp.asarray(x, jnp.float32) for x in inputs)
    return then(Branches(given, (first, second)), following)


@pytest.mark.parametrize("rows", [FEW, MANY])
def test_layers_in_a_row_are_one_after_the_other_whatever_the_order(rows: int) -> None:
    inputs, layers = two_after_two(rows)
    outputs = [x @ layers[2 * i] + layers[2 * i + 1] for i, x in enumerate(inputs)]
    features = np.concatenate(outputs, axis=-1)
    for index, got in enumerate(two_in_a_row(inputs, layers)):
        expected = features @ layers[4 + 2 * index] + layers[5 + 2 * index]
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rows", [FEW, MANY])
def test_layers_in_a_row_have_the_derivatives_of_the_product_written_out(rows: int) -> None:
    inputs, layers = two_after_two(rows)

    def written_out(layers: list[Array]) -> Array:
        outputs = [
            jnp.asarray(x, jnp.float32) @ layers[2 * i] + layers[2 * i + 1][None, None]
            for i, x in enumerate(inputs)
        ]
        features = jnp.concatenate(outputs, axis=-1)
        told = [features @ layers[i] + layers[i + 1][None, None] for i in (4, 6)]
        return sum((jnp.sin(x).sum() for x in told), jnp.float32(0))

    def ours(layers: list[Array]) -> Array:
        return sum((jnp.sin(x).sum() for x in two_in_a_row(inputs, layers)), jnp.float32(0))

    singles = [jnp.asarray(x, jnp.float32) for x in layers]
    for got, expected in zip(jax.grad(ours)(singles), jax.grad(written_out)(singles), strict=True):
        np.testing.assert_allclose(got, expected, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("rows", [FEW, MANY])
def test_layers_in_a_row_take_the_order_with_fewer_multiplications(rows: int) -> None:
    """By XLA's own count, which also has the few additions."""
    counted = jax.jit(two_in_a_row).lower(*two_after_two(rows)).compile().cost_analysis()["flops"]
    layer_by_layer = 2 * rows * (5 * 4 + 3 * 6 + 10 * (7 + 2))
    layers_first = 2 * (rows * (5 + 3) * (7 + 2) + (5 * 4 + 3 * 6) * (7 + 2))
    fewer, more = sorted((layer_by_layer, layers_first))
    assert fewer <= counted < 1.35 * fewer < 0.8 * more
