"""The GPU kernels, run as plain array operations, against a GRU in NumPy and its scans."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning_oracle import projected_gru_step

from sqn_jax.agent import gru, gru_kernel

STEPS, SIZE = 11, 16


def random_problem(batch: int) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Projected inputs [T, B, 3 H], carry, hidden kernel [H, 3 H] and bias."""
    rng = np.random.default_rng(batch)
    projected = rng.normal(size=(STEPS, batch, 3 * SIZE))
    carry = rng.uniform(-1, 1, size=(batch, SIZE))
    kernel = rng.normal(size=(SIZE, 3 * SIZE)) / SIZE**0.5
    bias = rng.normal(size=SIZE)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (projected, carry, kernel, bias))


def forward(projected, carry, kernel, bias) -> tuple[jax.Array, ...]:
    kernels = gru.split_gates(kernel)
    return gru_kernel.forward(projected, carry, kernels, bias, interpret=True)


@pytest.mark.parametrize("batch", [1, 16, 19])
def test_forward_is_the_gru_to_ten_bits(batch: int) -> None:
    """Also for numbers of robots that do not fill the last program."""
    projected, carry, kernel, bias = random_problem(batch)
    told = forward(projected, carry, kernel, bias)
    assert [x.shape for x in told] == [(STEPS, batch, SIZE)] * 5
    state = np.asarray(carry)
    for step in range(STEPS):
        rows = range(batch)
        state = np.stack(
            [projected_gru_step(projected[step, b], state[b], kernel, bias) for b in rows]
        )
        np.testing.assert_allclose(told[0][step], state, atol=2e-3)


@pytest.mark.parametrize("batch", [16, 19])
@pytest.mark.parametrize("largest", [1.0, 1e-9])
def test_backward_is_the_scan_to_ten_bits(batch: int, largest: float) -> None:
    """Also where gradients are smaller than any float16."""
    projected, carry, kernel, bias = random_problem(batch)
    kernels = gru.split_gates(kernel)
    hidden, *gates = gru._scan_forward(projected, carry, kernels, bias)
    previous = jnp.concatenate([carry[None], hidden[:-1]])
    rng = np.random.default_rng(0)
    gradient = jnp.asarray(largest * rng.normal(size=hidden.shape), jnp.float32)
    given = (gradient, previous, tuple(gates), kernels)
    expected = gru._scan_backward(*given)
    found = gru_kernel.backward(*given, interpret=True)
    for theirs, ours in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-3 * float(jnp.abs(theirs).max()))


def test_seeds_side_by_side_are_each_on_its_own() -> None:
    problems = [random_problem(16), random_problem(16)]
    problems[1] = jax.tree.map(lambda x: x * 0.5, problems[1])
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *problems)
    together = jax.vmap(forward)(*stacked)
    for index, problem in enumerate(problems):
        for both, alone in zip(together, forward(*problem), strict=True):
            np.testing.assert_allclose(both[index], alone, atol=1e-6)


@pytest.mark.parametrize(
    ("capability", "num_steps", "hidden_size", "expected"),
    [
        ("9.0", 100, 128, True),
        ("8.0", 8, 64, True),
        ("8.9", 100, 128, False),  # A GeForce: 99 KB of shared memory, 104 are needed.
        ("9.0", 1, 128, False),
        ("9.0", 100, 256, False),
        ("9.0", 100, 96, False),
        (None, 100, 128, False),  # A CPU.
    ],
)
def test_there_is_a_kernel_where_it_fits(
    monkeypatch: pytest.MonkeyPatch,
    capability: str | None,
    num_steps: int,
    hidden_size: int,
    expected: bool,
) -> None:
    monkeypatch.setattr(gru_kernel, "_compute_capability", lambda: capability)
    assert gru_kernel.fits(num_steps, hidden_size) is expected


def test_without_triton_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gru_kernel, "_compute_capability", lambda: "9.0")
    monkeypatch.setattr(gru_kernel, "pl_triton", None)
    assert not gru_kernel.fits(100, 128)


def test_the_gru_asks_for_the_kernel_on_a_gpu_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lowered for a CPU with a GPU beside it, the program holds the scan."""
    monkeypatch.setattr(gru_kernel, "_compute_capability", lambda: "9.0")
    arguments = random_problem(16)
    calls = []
    monkeypatch.setattr(gru_kernel, "forward", lambda *given: calls.append(1) or _scan(*given))
    told = jax.jit(gru.scan_gru)(*arguments)
    monkeypatch.setattr(gru_kernel, "_compute_capability", lambda: None)
    np.testing.assert_array_equal(told, gru.scan_gru(*arguments))
    assert calls == [1]


def _scan(*given: object) -> tuple[jax.Array, ...]:
    return tuple(x * 0 for x in gru._scan_forward(*given))
