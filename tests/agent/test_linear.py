"""Linear layers against NumPy in double precision, and their derivatives against the formula's."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from sqn_jax.agent.linear import Dense, affine, sum_rows


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


def test_the_layer_is_that_of_flax_for_the_same_parameters() -> None:
    inputs = jnp.asarray(arrays(3, 2)[0], jnp.float32)
    params = Dense(3).init(jax.random.key(0), inputs)
    theirs = nn.Dense(3)
    assert jax.tree.map(jnp.shape, params) == jax.tree.map(
        jnp.shape, theirs.init(jax.random.key(0), inputs)
    )
    np.testing.assert_allclose(
        Dense(3).apply(params, inputs), theirs.apply(params, inputs), atol=1e-6
    )


@pytest.mark.parametrize("scale", [1.0, 4.0, 0.1])
def test_a_fresh_layer_has_weights_of_the_scale_and_biases_spread_over_its_range(
    scale: float,
) -> None:
    """Weights of standard deviation scale / sqrt(D), biases even over +-scale / sqrt(D)."""
    fan_in, size = 64, 2000
    params = Dense(size, scale).init(jax.random.key(1), jnp.zeros((1, fan_in)))["params"]
    kernel, bias = (np.asarray(params[name]) * fan_in**0.5 / scale for name in ("kernel", "bias"))
    assert kernel.std() == pytest.approx(1, rel=0.02)
    assert np.abs(kernel).max() < 2.3  # Cut off at two standard deviations of the uncut normal.
    assert np.abs(bias).max() <= 1
    counts, _ = np.histogram(bias, bins=4, range=(-1, 1))
    assert counts.min() > 0.85 * size / 4
