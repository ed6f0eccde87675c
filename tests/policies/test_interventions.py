"""Skill decisions fixed or exchanged: the network must do what the arithmetic says."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest
from rooms import random_params, small_room

from sqn_jax.agent import initial_carry, make_network
from sqn_jax.agent.networks import QOutput
from sqn_jax.config import NetworkConfig, TrainConfig
from sqn_jax.env import NUM_ACTIONS, Observation
from sqn_jax.policies.interventions import (
    fix_skill_weights,
    single_head,
    swap_skills,
    with_motion_inputs,
    without_skill,
)
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.motion import MotionObservation
from sqn_jax.training.state import params_shapes

CONFIG = TrainConfig(network=NetworkConfig(hidden_size=8, num_skills=3))
NETWORK = make_network("sqn", CONFIG.network, NUM_ACTIONS)


@pytest.fixture(scope="module")
def policy() -> Policy:
    params = [random_params(NETWORK, small_room(9), seed) for seed in (0, 1)]
    return Policy("made up", dataclasses.replace(CONFIG, num_seeds=2), tuple(params))


def outputs(policy: Policy, index: int = 0) -> QOutput:
    network = make_network(policy.config.algo, policy.config.network, NUM_ACTIONS)
    rng = np.random.default_rng(7)
    obs = Observation(ranges=rng.random((6, 2, 71)), goal=rng.random((6, 2, 2)))
    obs = jax.tree.map(lambda x: x.astype(np.float32), obs)
    output: QOutput = network.apply(policy.params[index], obs, initial_carry(CONFIG.network, 2))[1]
    return output


@pytest.mark.parametrize("weights", [(0.2, 0.5, 0.3), (0.0, 1.0, 0.0), (0.5, 0.0, 0.5)])
def test_fixed_weights_hold_in_every_step_and_leave_the_skills_alone(
    policy: Policy, weights: Any
) -> None:
    for index in range(2):
        before, after = outputs(policy, index), outputs(fix_skill_weights(policy, weights), index)
        assert np.ptp(before.skill_weights, axis=0).max() > 0.1
        np.testing.assert_allclose(
            after.skill_weights, np.broadcast_to(weights, (6, 2, 3)), atol=1e-6
        )
        np.testing.assert_array_equal(after.skill_q_values, before.skill_q_values)
        mixed = np.einsum("k,tbka->tba", weights, before.skill_q_values)
        np.testing.assert_allclose(after.q_values, mixed, rtol=1e-4, atol=1e-4)


def test_a_skill_gets_the_weight_of_the_one_it_changes_places_with(policy: Policy) -> None:
    before = outputs(policy)
    for order, places in ((None, [2, 1, 0]), ((1, 2, 0), [1, 2, 0])):
        after = outputs(swap_skills(policy, order))
        np.testing.assert_allclose(
            after.skill_weights, before.skill_weights[..., places], rtol=1e-4, atol=1e-7
        )
        np.testing.assert_array_equal(after.skill_q_values, before.skill_q_values)


def test_without_a_skill_the_others_divide_its_weight() -> None:
    """Also where the gate is balanced and its softmax warmed."""
    changes = {"gate_balance_rate": 0.1, "gate_temperature": 3.0}
    config = dataclasses.replace(
        CONFIG, network=dataclasses.replace(CONFIG.network, **changes), num_seeds=1
    )
    network = make_network("sqn", config.network, NUM_ACTIONS)
    policy = Policy("made up", config, (random_params(network, small_room(9)),))
    before = outputs(policy)
    assert np.ptp(before.skill_weights, axis=0).max() > 0.1
    for skill in (0, 2):
        after = outputs(without_skill(policy, skill))
        expected = np.array(before.skill_weights)
        expected[..., skill] = 0
        expected /= expected.sum(axis=-1, keepdims=True)
        np.testing.assert_allclose(after.skill_weights, expected, rtol=1e-4, atol=1e-7)
        np.testing.assert_array_equal(after.skill_q_values, before.skill_q_values)
    fixed, swapped = fix_skill_weights(policy, (0.2, 0.0, 0.8)), swap_skills(policy, (1, 2, 0))
    np.testing.assert_allclose(outputs(fixed).skill_weights[3, 1], [0.2, 0.0, 0.8], atol=1e-6)
    turned = before.skill_weights[..., [1, 2, 0]]
    np.testing.assert_allclose(outputs(swapped).skill_weights, turned, rtol=1e-4, atol=1e-7)


def test_nothing_is_taken_from_a_gate_that_was_not_learned_or_has_one_skill() -> None:
    for changes, expected in (
        ({"gate": "equal"}, "policy made up: its network.gate is equal, expected learned"),
        ({"num_skills": 1}, "skill is 0, expected a policy with several skills"),
        ({}, "skill is 3, expected 0 to 2"),
    ):
        network = dataclasses.replace(CONFIG.network, **changes)
        policy = Policy("made up", dataclasses.replace(CONFIG, network=network), ({},))
        with pytest.raises(ValueError, match=f"^{expected}$"):
            without_skill(policy, 0 if changes else 3)


@pytest.mark.parametrize("skill", [0, 1, 2])
def test_a_single_head_has_the_values_of_its_skill(policy: Policy, skill: int) -> None:
    left = single_head(policy, skill)
    assert (left.config.algo, left.training_seeds) == ("r2d2", policy.training_seeds)
    for index in range(2):
        expected = outputs(policy, index).skill_q_values[:, :, skill]
        np.testing.assert_allclose(outputs(left, index).q_values, expected, rtol=1e-4, atol=1e-4)
    expected_shapes = params_shapes(dataclasses.replace(CONFIG, algo="r2d2"))
    assert jax.tree.map(np.shape, left.params[0]) == jax.tree.map(np.shape, expected_shapes)


@pytest.mark.parametrize("skill", [-1, 3])
def test_a_single_head_is_that_of_a_skill_there_is(policy: Policy, skill: int) -> None:
    with pytest.raises(ValueError, match=f"skill is {skill}, expected 0 to 2"):
        single_head(policy, skill)


def test_the_policy_that_was_given_stays_as_it_is(policy: Policy) -> None:
    before = outputs(policy)
    fix_skill_weights(policy, (1, 0, 0))
    swap_skills(policy)
    jax.tree.map(np.testing.assert_array_equal, outputs(policy), before)


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.6, 0.6, -0.2), (0.5, 0.2, 0.2), (2, -1, 0)])
def test_weights_that_are_no_decision_between_the_skills_are_refused(
    policy: Policy, weights: Any
) -> None:
    with pytest.raises(ValueError, match="expected 3 numbers from 0 to 1 that add up to 1"):
        fix_skill_weights(policy, weights)


def test_orders_and_agents_that_do_not_fit_are_refused(policy: Policy) -> None:
    with pytest.raises(ValueError, match=r"order is .*, expected a permutation of 0 to 2"):
        swap_skills(policy, (0, 0, 1))
    single = dataclasses.replace(policy, config=dataclasses.replace(CONFIG, algo="r2d2"))
    with pytest.raises(ValueError, match="is of r2d2, expected an sqn"):
        fix_skill_weights(single, (1,))


@pytest.mark.parametrize("algo", ["sqn", "r2d2", "dqn"])
def test_with_motion_inputs_the_q_values_are_what_they_were(algo: Any) -> None:
    """Whatever the motion: its weights are zero, and all others are where they were."""
    config = dataclasses.replace(CONFIG, algo=algo)
    network = make_network(algo, config.network, NUM_ACTIONS)
    before = Policy("made up", config, (random_params(network, small_room(9)),))
    after = with_motion_inputs(before)
    wider = make_network(algo, after.config.network, NUM_ACTIONS)
    assert jax.tree.map(np.shape, after.params[0]) == jax.tree.map(
        lambda x: x.shape, params_shapes(after.config)
    )
    rng, carry = np.random.default_rng(8), initial_carry(CONFIG.network, 2)
    seen = (rng.random((6, 2, size), np.float32) for size in (71, 2, NUM_ACTIONS + 1))
    obs = MotionObservation(*seen)
    expected = network.apply(before.params[0], Observation(obs.ranges, obs.goal), carry)
    found = wider.apply(after.params[0], obs, carry)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), found, expected)
    assert with_motion_inputs(after) is after
