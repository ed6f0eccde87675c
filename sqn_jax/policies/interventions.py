"""Changing what a trained SQN decides between its skills, to see what each of them does.

`fix_skill_weights` and `swap_skills` return a policy of the same form with other parameters in the
last layer of the skill decision (paper eq. 4), `single_head` one of the R2D2 agent,
`with_motion_inputs` one that could look at its last action: each can be evaluated, recorded and
drawn like any other, and training can start from it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.motion import MOTION_SIZE


def fix_skill_weights(policy: Policy, weights: Sequence[float]) -> Policy:
    """The policy with the same skill weights in every step.

    Args:
        policy: of an SQN.
        weights: [K] from 0 to 1, adding up to 1; (1, 0) lets the first of two skills act alone.

    Raises:
        ValueError: the policy is no SQN, or the weights do not fit it.
    """
    wanted = np.asarray(weights, np.float64)
    num_skills = _num_skills(policy)
    fits = wanted.shape == (num_skills,) and (wanted >= 0).all()
    if not fits or not np.isclose(wanted.sum(), 1.0, atol=1e-6):
        raise ValueError(
            f"weights are {list(weights)}, expected {num_skills} numbers from 0 to 1 that add up "
            "to 1"
        )
    # The softmax of logarithms; one of -1e4 is a weight of 0 in single precision.
    logits = np.where(wanted > 0, np.log(np.maximum(wanted, 1e-30)), -1e4)
    bias = jnp.asarray(logits, jnp.float32)
    return _with_output(policy, lambda kernel, _: (jnp.zeros_like(kernel), bias))


def swap_skills(policy: Policy, order: Sequence[int] | None = None) -> Policy:
    """The policy with the weights of its skills exchanged: what was given to one goes to another.

    Args:
        policy: of an SQN.
        order: [K] a permutation; skill k gets the weight that skill `order[k]` had. By default all
            in reverse.

    Raises:
        ValueError: the policy is no SQN, or the order is no permutation of its skills.
    """
    num_skills = _num_skills(policy)
    places = list(range(num_skills))[::-1] if order is None else list(order)
    whole = all(isinstance(place, int) for place in places)
    if not whole or sorted(places) != list(range(num_skills)):
        raise ValueError(f"order is {places}, expected a permutation of 0 to {num_skills - 1}")
    chosen = np.array(places)
    return _with_output(policy, lambda kernel, bias: (kernel[:, chosen], bias[chosen]))


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
        head, embedding = modules[f"skill_{skill}"], modules[f"skill_{skill}_embedding"]
        hidden = head["hidden"]
        bias = hidden["bias"] + embedding @ hidden["kernel"]
        selected = {name: modules[name] for name in ("features", "perception")}
        selected["skill_0"] = {**head, "hidden": {**hidden, "bias": bias}}
        return {**params, "params": selected}

    config = dataclasses.replace(policy.config, algo="r2d2")
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


def _with_output(policy: Policy, change: Callable[[Array, Array], tuple[Array, Array]]) -> Policy:
    """The policy with another kernel and bias in the output layer of its skill decision."""

    def changed(params: Any) -> Any:
        modules = params["params"]
        decision = modules["decision"]
        output = decision["output"]
        kernel, bias = change(output["kernel"], output["bias"])
        decision = {**decision, "output": {"kernel": kernel, "bias": bias}}
        return {**params, "params": {**modules, "decision": decision}}

    return dataclasses.replace(policy, params=tuple(changed(params) for params in policy.params))
