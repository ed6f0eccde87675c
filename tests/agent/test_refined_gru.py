"""The refined unit against NumPy in double precision, finite differences, and the plain GRU."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning_oracle import refined_gru_step
from small_problems import random_obs, small_network

from sqn_jax.agent import initial_carry
from sqn_jax.agent.gru import scan_gru
from sqn_jax.agent.refined_gru import RefinedGRU, scan_refined_gru

SIZE, BATCH, LENGTH = 3, 2, 5
ARGUMENTS = ("projected", "carry", "hidden_kernel", "candidate_bias")


def random_arguments(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    shapes = [(LENGTH, BATCH, 5 * SIZE), (BATCH, SIZE), (SIZE, 4 * SIZE), (SIZE,)]
    return [rng.normal(size=shape) for shape in shapes]


def numpy_scan(projected, carry, hidden_kernel, bias):
    hidden = np.zeros((len(projected), *carry.shape))
    for b, state in enumerate(carry):
        for t in range(len(projected)):
            state = refined_gru_step(projected[t, b], state, hidden_kernel, bias)
            hidden[t, b] = state
    return hidden


def test_it_and_its_derivative_are_those_of_the_equations_in_double_precision() -> None:
    arguments = random_arguments(2)
    cotangent = np.random.default_rng(3).normal(size=(LENGTH, BATCH, SIZE))
    singles = [jnp.asarray(x, jnp.float32) for x in arguments]
    hidden, pull_back = jax.vjp(scan_refined_gru, *singles)
    np.testing.assert_allclose(hidden, numpy_scan(*arguments), atol=2e-6)
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
        np.testing.assert_allclose(gradients[place], expected, atol=2e-5, err_msg=name)


def test_with_a_scale_of_1_and_a_refinement_of_a_half_it_is_the_gru() -> None:
    projected, carry, kernel, bias = (jnp.asarray(x, jnp.float32) for x in random_arguments(4))
    reset, update, _, candidate, _ = jnp.split(projected, 5, axis=-1)
    neutral = jnp.concatenate(
        [reset, update, jnp.zeros_like(reset), candidate, jnp.ones_like(reset)], axis=-1
    )
    kernel = kernel.at[:, 2 * SIZE : 3 * SIZE].set(0.0)
    three = [0, 1, 3]
    expected = scan_gru(
        jnp.concatenate([reset, update, candidate], axis=-1),
        carry,
        jnp.concatenate([jnp.split(kernel, 4, axis=1)[gate] for gate in three], axis=1),
        bias,
    )
    np.testing.assert_allclose(scan_refined_gru(neutral, carry, kernel, bias), expected, atol=2e-6)


def test_it_starts_with_orthogonal_gates_and_a_scale_of_1_on_average() -> None:
    params = RefinedGRU(8).init(jax.random.key(1), jnp.zeros((1, 1, 2)), jnp.zeros((1, 8)))
    tree = params["params"]
    np.testing.assert_array_equal(tree["input_bias"], np.repeat([0.0, 0, 0, 0, 1], 8))
    for gate in np.split(np.asarray(tree["hidden_kernel"]), 4, axis=1):
        np.testing.assert_allclose(gate.T @ gate, np.eye(8), atol=2e-6)


@pytest.mark.parametrize("algo", ["sqn", "r2d2"])
def test_networks_have_the_cell_that_is_set(algo: str) -> None:
    network = small_network(algo, cell="refined_gru")
    obs = random_obs(np.random.default_rng(5), LENGTH, BATCH)
    shapes = jax.eval_shape(network.init, jax.random.key(0), obs, initial_carry(network.config, 2))
    assert shapes["params"]["perception"]["hidden_kernel"].shape == (5, 4 * 5)
