"""The programs of the tests are those of users, compiled another way: both give the same."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rooms import random_params, small_room

from sqn_jax.agent import initial_carry, make_network
from sqn_jax.config import NetworkConfig
from sqn_jax.env import Observation, reset, step

NETWORK = make_network("sqn", NetworkConfig(hidden_size=8), 5)


def as_tests_and_as_users(function: Any, *arguments: Any) -> tuple[Any, Any]:
    """What a function returns, compiled as `conftest.py` says and as XLA does by itself."""
    lowered = jax.jit(function).lower(*arguments)
    as_users = {
        "xla_backend_optimization_level": 3,
        "xla_llvm_disable_expensive_passes": False,
        "xla_cpu_use_fusion_emitters": True,
        "xla_cpu_parallel_codegen_split_count": 32,
    }
    programs = lowered.compile(), lowered.compile(compiler_options=as_users)
    quick, usual = (program(*arguments) for program in programs)
    return quick, usual


def test_steps_of_the_simulator_are_those_of_a_user() -> None:
    """12 actions, turned over before rounding can grow: poses, rewards, scans, covered area."""
    room = small_room(12, velocity_noise=0.1)

    def act(key: jax.Array, room: Any) -> Any:
        def one_step(state: Any, now: tuple[jax.Array, jax.Array]) -> tuple[Any, Any]:
            obs, state, reward, *_, info = step(now[0], state, now[1], room)
            return state, (state.pose, reward, obs.ranges, info)

        start, rest = jax.random.split(key)
        actions = jax.random.randint(start, (12,), 0, 5)
        return jax.lax.scan(one_step, reset(start, room)[1], (jax.random.split(rest, 12), actions))[
            1
        ]

    quick, usual = as_tests_and_as_users(act, jax.random.key(1), room)
    assert np.ptp(quick[0], axis=0).max() > 0.1, "the robot stood still"
    for ours, theirs in zip(jax.tree.leaves(quick), jax.tree.leaves(usual), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_slopes_of_a_network_are_those_of_a_user() -> None:
    params = random_params(NETWORK, small_room(12))
    rng = np.random.default_rng(2)
    obs = Observation(
        ranges=jnp.asarray(rng.random((4, 3, 71)), jnp.float32),
        goal=jnp.asarray(rng.random((4, 3, 2)), jnp.float32),
    )
    carry = initial_carry(NETWORK.config, 3)

    def loss(params: Any) -> jax.Array:
        return jnp.square(NETWORK.apply(params, obs, carry)[1].q_values - 1).mean()

    quick, usual = as_tests_and_as_users(jax.value_and_grad(loss), params)
    for ours, theirs in zip(jax.tree.leaves(quick), jax.tree.leaves(usual), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-3 * np.abs(theirs).max())
