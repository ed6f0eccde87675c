"""The learning side once more, slowly: NumPy, float64, one robot and one step at a time.

Written from the equations (Skill Q-Network eq. 1 to 6, Cho et al. 2014, R2D2 eq. 1 and section 2.3,
PQN) and never calling the code under test. Parameters are the nested dicts of the networks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FLOATS = NDArray[np.float64]
Tree = Any

LAYER_NORM_EPSILON = 1e-6
RESCALING_EPSILON = 1e-3


def sigmoid(x: FLOATS) -> FLOATS:
    return 1 / (1 + np.exp(-x))


def dense(layer: Tree, x: FLOATS) -> FLOATS:
    """A linear layer on one vector."""
    return x @ layer["kernel"] + layer["bias"]


def mlp(block: Tree, x: FLOATS) -> FLOATS:
    """Two linear layers on one vector, layer-normalised before the ReLU if the tree says so."""
    hidden = dense(block["hidden"], x)
    if "norm" in block:
        hidden = layer_norm(block["norm"], hidden)
    return dense(block["output"], np.maximum(hidden, 0))


def layer_norm(block: Tree, x: FLOATS) -> FLOATS:
    spread = np.sqrt(((x - x.mean()) ** 2).mean() + LAYER_NORM_EPSILON)
    return (x - x.mean()) / spread * block["scale"] + block["bias"]


def gru_step(block: Tree, x: FLOATS, hidden: FLOATS) -> FLOATS:
    """One step of a GRU whose reset gate acts after the product."""
    projected = x @ block["input_kernel"] + block["input_bias"]
    return projected_gru_step(projected, hidden, block["hidden_kernel"], block["candidate_bias"])


def projected_gru_step(
    projected: FLOATS, hidden: FLOATS, hidden_kernel: FLOATS, candidate_bias: FLOATS
) -> FLOATS:
    size = len(hidden)
    r, z, n = slice(0, size), slice(size, 2 * size), slice(2 * size, None)
    reset = sigmoid(projected[r] + hidden @ hidden_kernel[:, r])
    update = sigmoid(projected[z] + hidden @ hidden_kernel[:, z])
    recurrent = hidden @ hidden_kernel[:, n] + candidate_bias
    candidate = np.tanh(projected[n] + reset * recurrent)
    return (1 - update) * candidate + update * hidden


def refined_gru_step(
    projected: FLOATS, hidden: FLOATS, hidden_kernel: FLOATS, candidate_bias: FLOATS
) -> FLOATS:
    """One step of the unit with a refined gate and a scaled candidate, number by number."""
    size = len(hidden)
    new = np.zeros(size)
    for k in range(size):
        r, z, i, n, s = (projected[gate * size + k] for gate in range(5))
        from_r, from_z, from_i, from_n = (
            sum(hidden[j] * hidden_kernel[j, gate * size + k] for j in range(size))
            for gate in range(4)
        )
        reset, update, refine = sigmoid(r + from_r), sigmoid(z + from_z), sigmoid(i + from_i)
        candidate = np.tanh(s * (n + reset * (from_n + candidate_bias[k])))
        gate = refine * (1 - (1 - update) ** 2) + (1 - refine) * update**2
        new[k] = (1 - gate) * candidate + gate * hidden[k]
    return new


@dataclass
class Outputs:
    """What a network says about T steps of B robots."""

    q_values: FLOATS
    skill_weights: FLOATS
    skill_q_values: FLOATS
    carry: FLOATS


def forward(
    algo: str,
    params: Tree,
    ranges: FLOATS,
    goal: FLOATS,
    carry: FLOATS,
    motion: FLOATS | None = None,
) -> Outputs:
    """Run one of the three networks over ranges [T, B, R], goal [T, B, G] and, for one that takes
    it, motion [T, B, A + 1]."""
    tree = params["params"]
    length, batch = ranges.shape[:2]
    carry = np.array(carry, np.float64)
    q_values, skill_weights, skill_q_values = [], [], []
    for t in range(length):
        for b in range(batch):
            features = np.concatenate(
                [
                    mlp(tree["features"]["ranges"], ranges[t, b]),
                    mlp(tree["features"]["goal"], goal[t, b]),
                    np.zeros(0) if motion is None else motion[t, b],
                ]
            )
            if algo == "dqn":
                hidden = dense(tree["perception"], features)
                if "norm" in tree:
                    hidden = layer_norm(tree["norm"], hidden)
                skills = [mlp(tree["skill_0"], np.maximum(hidden, 0))]
                weights = np.ones(1)
            else:
                carry[b] = gru_step(tree["perception"], features, carry[b])
                weights, skills = heads(algo, tree, carry[b])
            skill_weights.append(weights)
            skill_q_values.append(skills)
            q_values.append(sum(w * q for w, q in zip(weights, skills, strict=True)))
    return Outputs(
        np.array(q_values).reshape(length, batch, -1),
        np.array(skill_weights).reshape(length, batch, -1),
        np.array(skill_q_values).reshape(length, batch, len(weights), -1),
        carry,
    )


def heads(algo: str, tree: Tree, perception: FLOATS) -> tuple[FLOATS, list[FLOATS]]:
    """Skill decision and every skill's Q-values for one perceptual feature."""
    if algo == "r2d2":
        return np.ones(1), [mlp(tree["skill_0"], perception)]
    num_skills = sum(name.endswith("_embedding") for name in tree) - 1
    scores = np.exp(mlp(tree["decision"], perception + tree["decision_embedding"]))
    skills = [
        mlp(tree[f"skill_{i}"], perception + tree[f"skill_{i}_embedding"])
        for i in range(num_skills)
    ]
    return scores / scores.sum(), skills


def rescale(x: float) -> float:
    """R2D2, eq. 1."""
    return float(np.sign(x) * (np.sqrt(abs(x) + 1) - 1) + RESCALING_EPSILON * x)


def inverse_rescale(y: float) -> float:
    """The number whose `rescale` is y, found by bisection."""
    low, high = -1.0, 1.0
    while rescale(low) > y:
        low *= 2
    while rescale(high) < y:
        high *= 2
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if rescale(middle) < y else (low, middle)
    return (low + high) / 2


def n_step_return(rewards: FLOATS, discounts: FLOATS, values: FLOATS, t: int, n_step: int) -> float:
    """Up to n rewards from step t on, and the value of wherever that leads."""
    total, factor, place = 0.0, 1.0, t
    while place < len(rewards) and place < t + n_step:
        total += factor * rewards[place]
        factor *= discounts[place]
        place += 1
    return total + factor * values[place]


def lambda_return(
    rewards: FLOATS, discounts: FLOATS, values: FLOATS, t: int, trace_decay: float
) -> float:
    """The forward view: n-step returns weighted (1 - lambda) lambda^(n-1), the longest the rest."""
    longest = len(rewards) - t
    total = 0.0
    for n in range(1, longest + 1):
        share = trace_decay ** (n - 1) * (1 if n == longest else 1 - trace_decay)
        total += share * n_step_return(rewards, discounts, values, t, n)
    return total


@dataclass
class Batch:
    """Episodes [T (+ 1), B, ...] in float64, and the recurrent state [B, H] they begin with."""

    ranges: FLOATS
    goal: FLOATS
    actions: NDArray[np.int64]
    rewards: FLOATS
    terminated: NDArray[np.bool_]
    carry: FLOATS


def r2d2_loss(
    algo: str,
    params: Tree,
    target_params: Tree,
    batch: Batch,
    weights: FLOATS,
    *,
    frozen_params: Tree | None = None,
    burn_in_length: int,
    n_step: int,
    discount: float,
    double_q: bool,
    value_rescaling: bool,
    advantage_learning: float = 0.0,
) -> tuple[float, FLOATS]:
    """The R2D2 loss and the TD errors [T', B].

    Only predictions after burn-in see `params`; the carry they start from, the choice of the
    bootstrap action and the targets come from `frozen_params` (the same numbers, unless one wants
    to differentiate by moving `params` alone).
    """
    frozen_params = params if frozen_params is None else frozen_params
    online, _ = after_burn_in(algo, params, frozen_params, batch, burn_in_length)
    chooser, _ = after_burn_in(algo, frozen_params, frozen_params, batch, burn_in_length)
    target, _ = after_burn_in(algo, target_params, target_params, batch, burn_in_length)

    def bootstrap(t: int, b: int) -> float:
        best = np.argmax((chooser if double_q else target)[t, b])
        return float(target[t, b, best])

    def multi_step(rewards: FLOATS, discounts: FLOATS, values: FLOATS, t: int) -> float:
        return n_step_return(rewards, discounts, values, t, n_step)

    penalty = lowered(chooser, batch, burn_in_length, advantage_learning)
    return squared_errors(
        online,
        bootstrap,
        multi_step,
        batch,
        burn_in_length,
        discount,
        value_rescaling,
        weights,
        penalty,
    )


def pqn_loss(
    algo: str,
    params: Tree,
    batch: Batch,
    *,
    frozen_params: Tree | None = None,
    trace_decay: float,
    discount: float,
    value_rescaling: bool,
    advantage_learning: float = 0.0,
) -> tuple[float, FLOATS]:
    """The recurrent PQN loss and the TD errors [T, B]; targets come from `frozen_params`."""
    frozen_params = params if frozen_params is None else frozen_params
    online, _ = after_burn_in(algo, params, frozen_params, batch, 0)
    frozen, _ = after_burn_in(algo, frozen_params, frozen_params, batch, 0)

    def multi_step(rewards: FLOATS, discounts: FLOATS, values: FLOATS, t: int) -> float:
        return lambda_return(rewards, discounts, values, t, trace_decay)

    return squared_errors(
        online,
        lambda t, b: float(frozen[t, b].max()),
        multi_step,
        batch,
        0,
        discount,
        value_rescaling,
        np.ones(batch.rewards.shape[1]),
        lowered(frozen, batch, 0, advantage_learning),
    )


def lowered(values: FLOATS, batch: Batch, burn_in_length: int, alpha: float) -> FLOATS:
    """By how much advantage learning lowers the targets: alpha (V(s) - Q(s, a)), [T', B]."""
    length, count = len(batch.rewards) - burn_in_length, batch.rewards.shape[1]
    found = np.zeros((length, count))
    for t in range(length):
        for b in range(count):
            action = batch.actions[burn_in_length + t, b]
            found[t, b] = alpha * (max(values[t, b]) - values[t, b, action])
    return found


def after_burn_in(
    algo: str, params: Tree, burn_in_params: Tree, batch: Batch, burn_in_length: int
) -> tuple[FLOATS, FLOATS]:
    """Q-values [T' + 1, B, A] of the steps after burn-in, and the carry they began with."""
    carry = batch.carry
    if burn_in_length > 0:
        early = slice(0, burn_in_length)
        carry = forward(algo, burn_in_params, batch.ranges[early], batch.goal[early], carry).carry
    late = slice(burn_in_length, None)
    return forward(algo, params, batch.ranges[late], batch.goal[late], carry).q_values, carry


def squared_errors(
    online: FLOATS,
    bootstrap: Callable[[int, int], float],
    multi_step: Callable[[FLOATS, FLOATS, FLOATS, int], float],
    batch: Batch,
    burn_in_length: int,
    discount: float,
    value_rescaling: bool,
    weights: FLOATS,
    penalty: FLOATS,
) -> tuple[float, FLOATS]:
    """Half the weighted mean of squared TD errors, sequence by sequence and step by step."""
    length = len(batch.rewards) - burn_in_length
    num_sequences = batch.rewards.shape[1]
    errors = np.zeros((length, num_sequences))
    loss = 0.0
    for b in range(num_sequences):
        rewards = batch.rewards[burn_in_length:, b]
        discounts = np.where(batch.terminated[burn_in_length:, b], 0.0, discount)
        values = np.array([bootstrap(t, b) for t in range(length + 1)])
        if value_rescaling:
            values = np.array([inverse_rescale(value) for value in values])
        for t in range(length):
            target = multi_step(rewards, discounts, values, t)
            if value_rescaling:
                target = rescale(target)
            prediction = online[t, b, batch.actions[burn_in_length + t, b]]
            errors[t, b] = target - penalty[t, b] - prediction
            loss += 0.5 * weights[b] * errors[t, b] ** 2
    return loss / (length * num_sequences), errors


def adam_step(
    params: list[FLOATS],
    gradients: list[FLOATS],
    moments: list[tuple[FLOATS, FLOATS]],
    step: int,
    *,
    learning_rate: float,
    epsilon: float,
    max_norm: float,
) -> tuple[list[FLOATS], list[tuple[FLOATS, FLOATS]]]:
    """Adam (Kingma and Ba 2015, algorithm 1) after scaling gradients to at most `max_norm`.

    `step` counts from 1; `moments` are pairs of first and second moment.
    """
    norm = np.sqrt(sum((gradient**2).sum() for gradient in gradients))
    scale = min(1.0, max_norm / norm)
    new_params, new_moments = [], []
    for param, gradient, (first, second) in zip(params, gradients, moments, strict=True):
        gradient = gradient * scale
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * gradient**2
        unbiased = first / (1 - 0.9**step)
        spread = np.sqrt(second / (1 - 0.999**step)) + epsilon
        new_params.append(param - learning_rate * unbiased / spread)
        new_moments.append((first, second))
    return new_params, new_moments
