"""Changing what a trained SQN decides between its skills, to see what each of them does.

`fix_skill_weights`, `swap_skills` and `without_skill` return a policy of the same form with other
parameters in the last layer of the skill decision (paper eq. 4), `single_head` one of the R2D2
agent, `with_motion_inputs` one that could look at its last action: each can be evaluated, recorded
and drawn like any other, and training can start from it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.agent.networks import GATE_BALANCE
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.motion import MOTION_SIZE

NO_WEIGHT = -1e4
"""A logit, before it is divided by a temperature, whose softmax is 0 in single precision."""


def fix_skill_weights(policy: Policy, weights: Sequence[float]) -> Policy:
    """The policy with the same skill weights in every step.

    Args:
        policy: of an SQN.
        weights: [K] from 0 to 1, adding up to 1; (1, 0) lets the first of two skills act alone.

    Raises:
        ValueError: the policy is no SQN, its gate is not learned, or the weights do not fit it.
    """
    wanted = np.asarray(weights, np.float64)
    num_skills = _num_decided(policy)
    fits = wanted.shape == (num_skills,) and (wanted >= 0).all()
    if not fits or not np.isclose(wanted.sum(), 1.0, atol=1e-6):
        raise ValueError(
            f"weights are {list(weights)}, expected {num_skills} numbers from 0 to 1 that add up "
            "to 1"
        )
    logits = np.where(wanted > 0, np.log(np.maximum(wanted, 1e-30)), NO_WEIGHT)
    bias = jnp.asarray(logits * policy.config.network.gate_temperature, jnp.float32)
    return _with_output(policy, lambda kernel, _: (jnp.zeros_like(kernel), bias))


def swap_skills(policy: Policy, order: Sequence[int] | None = None) -> Policy:
    """The policy with the weights of its skills exchanged: what was given to one goes to another.

    Args:
        policy: of an SQN.
        order: [K] a permutation; skill k gets the weight that skill `order[k]` had. By default all
            in reverse.

    Raises:
        ValueError: the policy is no SQN, its gate is not learned, or the order is no permutation of
            its skills.
    """
    num_skills = _num_decided(policy)
    places = list(range(num_skills))[::-1] if order is None else list(order)
    whole = all(isinstance(place, int) for place in places)
    if not whole or sorted(places) != list(range(num_skills)):
        raise ValueError(f"order is {places}, expected a permutation of 0 to {num_skills - 1}")
    chosen = np.array(places)
    return _with_output(policy, lambda kernel, bias: (kernel[:, chosen], bias[chosen]))


def without_skill(policy: Policy, skill: int) -> Policy:
    """The policy without one of its skills: the others divide its weight as they divide the rest.

    Args:
        policy: of an SQN with two skills or more.
        skill: which, from 0.

    Raises:
        ValueError: the policy is no SQN, its gate is not learned, it has no such skill or no other.
    """
    num_skills = _num_decided(policy)
    if num_skills < 2 or not 0 <= skill < num_skills:
        expected = f"0 to {num_skills - 1}" if num_skills > 1 else "a policy with several skills"
        raise ValueError(f"skill is {skill}, expected {expected}")
    logit = NO_WEIGHT * policy.config.network.gate_temperature
    return _with_output(
        policy, lambda kernel, bias: (kernel.at[:, skill].set(0.0), bias.at[skill].set(logit))
    )


def single_head(policy: Policy, skill: int = 0) -> Policy:
    """The R2D2 agent that does what one skill of an SQN does alone.

    It has the perception and the layers of that skill, whose embedding (paper eq. 5) becomes part
    of a bias; the other skills and the decision between them are gone.

    Args:
        policy: of an SQN.
        skill: which, from 0.

    Raises:
        ValueError: the policy is no SQN, or has no such skill.
    """
    num_skills = _num_skills(policy)
    if not 0 <= skill < num_skills:
        raise ValueError(f"skill is {skill}, expected 0 to {num_skills - 1}")

    def reduced(params: Any) -> Any:
        modules = params["params"]
        head = modules[f"skill_{skill}"]
        hidden = head["hidden"]
        bias = hidden["bias"]
        if policy.config.network.embeddings:
            bias = bias + modules[f"skill_{skill}_embedding"] @ hidden["kernel"]
        selected = {name: modules[name] for name in ("features", "perception")}
        selected["skill_0"] = {**head, "hidden": {**hidden, "bias": bias}}
        return {**params, "params": selected}

    network = dataclasses.replace(policy.config.network, r2d2_width_factor=1)
    config = dataclasses.replace(policy.config, algo="r2d2", network=network)
    return Policy(policy.name, config, tuple(reduced(params) for params in policy.params))


def with_motion_inputs(policy: Policy) -> Policy:
    """The policy with `network.motion_inputs`, whose weights are zero: it does what it did.

    Args:
        policy: of any agent; one that has the inputs is returned as it is.
    """
    if policy.config.network.motion_inputs:
        return policy

    def widened(params: Any) -> Any:
        modules = params["params"]
        perception = modules["perception"]
        name = "kernel" if policy.config.algo == "dqn" else "input_kernel"
        kernel = jnp.pad(perception[name], ((0, MOTION_SIZE), (0, 0)))
        return {**params, "params": {**modules, "perception": {**perception, name: kernel}}}

    network = dataclasses.replace(policy.config.network, motion_inputs=True)
    config = dataclasses.replace(policy.config, network=network)
    return Policy(policy.name, config, tuple(widened(params) for params in policy.params))


def _num_skills(policy: Policy) -> int:
    if policy.config.algo != "sqn":
        raise ValueError(f"policy {policy.name}: is of {policy.config.algo}, expected an sqn")
    return policy.config.network.num_skills


def _num_decided(policy: Policy) -> int:
    """The number of skills that a policy has learned to decide between."""
    num_skills, gate = _num_skills(policy), policy.config.network.gate
    if gate != "learned":
        raise ValueError(f"policy {policy.name}: its network.gate is {gate}, expected learned")
    return num_skills


def _with_output(policy: Policy, change: Callable[[Array, Array], tuple[Array, Array]]) -> Policy:
    """The policy with another kernel and bias in the output layer of its skill decision.

    The bias that balances the skills becomes part of the other one, before it is changed.
    """

    def changed(params: Any) -> Any:
        modules = params["params"]
        decision = modules["decision"]
        output = decision["output"]
        balance = {name: modules[name] for name in (GATE_BALANCE,) if name in modules}
        kernel, bias = change(output["kernel"], sum(balance.values(), output["bias"]))
        decision = {**decision, "output": {"kernel": kernel, "bias": bias}}
        moved = jax.tree.map(jnp.zeros_like, balance)
        return {**params, "params": {**modules, "decision": decision, **moved}}

    return dataclasses.replace(policy, params=tuple(changed(params) for params in policy.params))
