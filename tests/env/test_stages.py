"""A stage is what it wraps, compiled apart or not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from sqn_jax.env.stages import stage


def doubled_and_summed(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    return 2 * x, (x + y).sum()


def test_a_stage_gives_what_its_function_gives_alone_and_for_many() -> None:
    x, y = np.random.default_rng(0).normal(size=(2, 6, 5)).astype(np.float32)
    always = jnp.float32(0.05) > 0
    staged = jax.jit(lambda always, x, y: stage(always, doubled_and_summed, x, y))
    alone = staged(always, x[0], y[0])
    for got, expected in zip(alone, doubled_and_summed(x[0], y[0]), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-6)
    many = jax.vmap(staged, in_axes=(None, 0, 0))(always, x, y)
    np.testing.assert_array_equal(many[0], 2 * x)
    np.testing.assert_allclose(many[1], (x + y).sum(axis=1), rtol=1e-5)


def test_a_stage_is_a_conditional_on_the_cpu() -> None:
    """Without one, the compiler would fuse it with its neighbours again."""
    x = jnp.ones(8)
    compiled = jax.jit(lambda a, x: stage(a, jnp.sin, x)).lower(x[0] > 0, x).compile()
    assert "conditional(" in compiled.as_text()
