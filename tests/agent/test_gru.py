"""The fast GRU against Flax's own cell, an oracle in NumPy, and derivatives found otherwise."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from learning_oracle import projected_gru_step

from sqn_jax.agent.gru import GRU, _orthogonal, scan_gru

SIZE, BATCH, INPUTS = 3, 2, 4
ARGUMENTS = ("projected", "carry", "hidden_kernel", "candidate_bias")


def random_arguments(seed: int, length: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    shapes = [(length, BATCH, 3 * SIZE), (BATCH, SIZE), (SIZE, 3 * SIZE), (SIZE,)]
    return [rng.normal(size=shape) for shape in shapes]


def plain_scan(projected: Array, carry: Array, hidden_kernel: Array, bias: Array) -> Array:
    """The same recurrence without a scan and without a derivative of its own."""
    states = []
    for inputs in projected:
        recurrent = carry @ hidden_kernel
        reset = nn.sigmoid(inputs[:, :SIZE] + recurrent[:, :SIZE])
        update = nn.sigmoid(inputs[:, SIZE : 2 * SIZE] + recurrent[:, SIZE : 2 * SIZE])
        inner = recurrent[:, 2 * SIZE :] + bias[None]
        candidate = jnp.tanh(inputs[:, 2 * SIZE :] + reset * inner)
        carry = (1 - update) * candidate + update * carry
        states.append(carry)
    return jnp.stack(states)


def numpy_scan(projected, carry, hidden_kernel, bias):
    hidden = np.zeros((len(projected), *carry.shape))
    for b in range(len(carry)):
        state = carry[b]
        for t in range(len(projected)):
            state = projected_gru_step(projected[t, b], state, hidden_kernel, bias)
            hidden[t, b] = state
    return hidden


def test_it_equals_the_flax_cell_with_the_same_weights() -> None:
    rng = np.random.default_rng(1)
    inputs = jnp.asarray(rng.normal(size=(6, BATCH, INPUTS)), jnp.float32)
    carry = jnp.asarray(rng.normal(size=(BATCH, SIZE)), jnp.float32)
    kernel, bias = rng.normal(size=(INPUTS, 3 * SIZE)), rng.normal(size=3 * SIZE)
    hidden_kernel, candidate_bias = rng.normal(size=(SIZE, 3 * SIZE)), rng.normal(size=SIZE)
    ours = {
        "input_kernel": jnp.asarray(kernel, jnp.float32),
        "input_bias": jnp.asarray(bias, jnp.float32),
        "hidden_kernel": jnp.asarray(hidden_kernel, jnp.float32),
        "candidate_bias": jnp.asarray(candidate_bias, jnp.float32),
    }
    theirs = {}
    for index, gate in enumerate("rzn"):
        part = slice(index * SIZE, (index + 1) * SIZE)
        theirs[f"i{gate}"] = {"kernel": kernel[:, part], "bias": bias[part]}
        theirs[f"h{gate}"] = {"kernel": hidden_kernel[:, part]}
    theirs["hn"]["bias"] = candidate_bias
    theirs = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), theirs)

    last, hidden = GRU(SIZE).apply({"params": ours}, inputs, carry)

    # Flax adds its biases by implicit broadcasting.
    with jax.numpy_rank_promotion("allow"):
        expected = []
        cell = jax.jit(nn.GRUCell(SIZE).apply)
        for t in range(6):
            carry, _ = cell({"params": theirs}, carry, inputs[t])
            expected.append(carry)
    np.testing.assert_allclose(hidden, np.array(expected), atol=2e-6)
    np.testing.assert_array_equal(last, hidden[-1])


@pytest.mark.parametrize("length", [1, 5])
def test_its_derivative_equals_finite_differences_in_double_precision(length: int) -> None:
    arguments = random_arguments(2, length)
    cotangent = np.random.default_rng(3).normal(size=(length, BATCH, SIZE))
    singles = [jnp.asarray(x, jnp.float32) for x in arguments]
    _, pull_back = jax.vjp(scan_gru, *singles)
    gradients = pull_back(jnp.asarray(cotangent, jnp.float32))
    for place, name in enumerate(ARGUMENTS):
        expected = np.zeros_like(arguments[place])
        for index in np.ndindex(expected.shape):
            sides = []
            for step in (1e-5, -1e-5):
                moved = [x.copy() for x in arguments]
                moved[place][index] += step
                sides.append((cotangent * numpy_scan(*moved)).sum())
            expected[index] = (sides[0] - sides[1]) / 2e-5
        np.testing.assert_allclose(gradients[place], expected, atol=1e-5, err_msg=name)


def test_its_derivative_equals_automatic_differentiation_of_a_plain_loop() -> None:
    arguments = [jnp.asarray(x, jnp.float32) for x in random_arguments(4, 7)]
    cotangent = jnp.asarray(np.random.default_rng(5).normal(size=(7, BATCH, SIZE)), jnp.float32)

    def both(function):
        return jax.jit(lambda cotangent, *args: jax.vjp(function, *args)[1](cotangent))

    gradients = both(scan_gru)(cotangent, *arguments)
    expected = both(plain_scan)(cotangent, *arguments)
    for name, ours, theirs in zip(ARGUMENTS, gradients, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-6, err_msg=name)


def test_vmapped_derivatives_are_those_of_each_seed_alone() -> None:
    seeds = [[jnp.asarray(x, jnp.float32) for x in random_arguments(s, 4)] for s in (6, 7)]
    gradient = jax.jit(jax.grad(lambda args: (scan_gru(*args) ** 2).sum()))
    together = jax.vmap(gradient)(jax.tree.map(lambda *x: jnp.stack(x), *seeds))
    for index, alone in enumerate(seeds):
        for ours, theirs in zip(together, gradient(alone), strict=True):
            np.testing.assert_allclose(ours[index], theirs, atol=1e-5)


def test_each_gate_starts_orthogonal_as_numpy_s_factorisation_has_it() -> None:
    size = 128
    layer = GRU(size)
    key = jax.random.key(5)
    inputs, carry = jnp.zeros((1, 1, 2)), jnp.zeros((1, size))
    kernel = layer.init(key, inputs, carry)["params"]["hidden_kernel"]
    gates = np.split(np.asarray(kernel, np.float64), 3, axis=1)
    for gate in gates:
        np.testing.assert_allclose(gate.T @ gate, np.eye(size), atol=2e-6)
    assert np.abs(gates[0] - gates[1]).max() > 0.1
    # The factor Q of a normal matrix, with the signs that make the diagonal of R positive.
    normal = np.asarray(jax.random.normal(key, (size, size)), np.float64)
    factor, triangle = np.linalg.qr(normal)
    expected = factor * np.sign(np.diag(triangle))
    np.testing.assert_allclose(_orthogonal(key, size), expected, atol=1e-4)


def test_initialisation_calls_no_factorisation_of_the_library() -> None:
    """Batched over seeds it can wait for itself for ever, see `gru._orthogonal`."""

    def initial(key: Array) -> object:
        return GRU(8).init(key, jnp.zeros((1, 1, 2)), jnp.zeros((1, 8)))

    keys = jax.random.split(jax.random.key(0), 2)
    assert "lapack" not in jax.jit(jax.vmap(initial)).lower(keys).as_text()
