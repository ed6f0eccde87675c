"""A loop that is written out on a GPU counts the same passes in the same order."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from sqn_jax.env.loops import repeat


@pytest.mark.parametrize("count", [0, 1, 5])
@pytest.mark.parametrize("unroll", [1, 2])
def test_it_goes_from_nought_to_the_count(count: int, unroll: int) -> None:
    def body(index: jax.Array | int, digits: jax.Array) -> jax.Array:
        return 10 * digits + index + 1

    digits = int("0" + "".join(str(index + 1) for index in range(count)))
    found = jax.jit(lambda start: repeat(count, body, start, unroll=unroll))(jnp.int32(0))
    assert int(found) == digits


@pytest.mark.parametrize(("kind", "platform", "loops"), [("gpu", "cuda", 0), ("cpu", "cpu", 1)])
def test_a_gpu_gets_it_written_out_and_a_cpu_as_a_loop(
    monkeypatch: pytest.MonkeyPatch, kind: str, platform: str, loops: int
) -> None:
    """The program for a GPU has no loop left."""
    monkeypatch.setattr(jax, "default_backend", lambda: kind)

    def body(_: jax.Array | int, x: jax.Array) -> jax.Array:
        return x * x

    program = jax.jit(lambda start: repeat(6, body, start, unroll=1))
    text = program.trace(jnp.float32(0)).lower(lowering_platforms=(platform,)).as_text()
    assert text.count("stablehlo.while") == loops
