"""The Skill Q-Network and one R2D2 update in PyTorch, to compare the learner with.

The same network, loss and optimizer as `sqn_jax.agent` (preset `paper`), written the way one would
in PyTorch and with what it has for speed: `nn.GRU` over the whole sequence, fused Adam, no graph
for burn-in and target. Tensors are time-major, as there: T steps, B episodes, R beams, G goal
numbers, A actions, K skills, H hidden units. Needs `pip install torch`.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sqn_jax.agent.returns import RESCALING_EPSILON
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.config import LearnerConfig, NetworkConfig

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Batch:
    """Whole episodes and their importance weights."""

    ranges: Tensor
    """[T + 1, B, R] float32."""
    goal: Tensor
    """[T + 1, B, G] float32."""
    actions: Tensor
    """[T, B] int64."""
    rewards: Tensor
    """[T, B] float32."""
    terminated: Tensor
    """[T, B] bool."""
    carry: Tensor
    """[1, B, H] float32."""
    weights: Tensor
    """[B] float32."""


def to_torch(episodes: Trajectory, weights: Any) -> Batch:
    """Copy episodes and importance weights [B] from JAX."""

    def tensor(array: Any) -> Tensor:
        return torch.tensor(np.asarray(array))

    return Batch(
        ranges=tensor(episodes.obs.ranges),
        goal=tensor(episodes.obs.goal),
        actions=tensor(episodes.actions).long(),
        rewards=tensor(episodes.rewards),
        terminated=tensor(episodes.terminated),
        carry=tensor(episodes.carry)[None],
        weights=tensor(weights),
    )


class MLP(nn.Module):
    """Two linear layers with a ReLU in between."""

    def __init__(self, input_size: int, hidden_size: int, output_size: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(input_size, hidden_size)
        self.output = nn.Linear(hidden_size, output_size)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map [..., D] to [..., output_size]."""
        return self.output(self.hidden(inputs).relu_())


class SkillQNetwork(nn.Module):
    """GRU perception, skill decision and K latent skills (paper eq. 1 to 6).

    Raises:
        ValueError: the config asks for layer normalization.
    """

    def __init__(
        self, config: NetworkConfig, num_beams: int, goal_size: int, num_actions: int
    ) -> None:
        super().__init__()
        if config.layer_norm:
            raise ValueError("network.layer_norm is True, expected False, the paper's")
        size = config.hidden_size
        self.ranges = MLP(num_beams, size, size)
        self.goal = MLP(goal_size, size, size)
        self.perception = nn.GRU(2 * size, size)
        self.decision = MLP(size, size, config.num_skills)
        self.skills = nn.ModuleList(MLP(size, size, num_actions) for _ in range(config.num_skills))
        self.decision_embedding = nn.Parameter(torch.zeros(size))
        self.skill_embeddings = nn.ParameterList(torch.zeros(size) for _ in self.skills)
        # nn.GRU adds two biases to each of the gates r and z where one is enough. The second ones
        # stay zero, or an update would move the sum of the two twice as far as ours.
        candidate_only = torch.cat([torch.zeros(2 * size), torch.ones(size)])
        second = self.perception.get_parameter("bias_hh_l0")
        second.register_hook(lambda gradient: gradient * candidate_only)

    def perceive(self, ranges: Tensor, goal: Tensor, carry: Tensor) -> tuple[Tensor, Tensor]:
        """What the GRU makes of observations [T, B, ...]: [T, B, H], and its last state."""
        features = torch.cat([self.ranges(ranges), self.goal(goal)], dim=-1)
        perception, carry = self.perception(features, carry)
        return perception, carry

    def forward(self, ranges: Tensor, goal: Tensor, carry: Tensor) -> Tensor:
        """Q-values [T, B, A] of observations [T, B, ...] from the recurrent state [1, B, H] on."""
        perception, _ = self.perceive(ranges, goal, carry)
        decision = self.decision(perception + self.decision_embedding)
        skill_q_values = torch.stack(
            [
                skill(perception + embedding)
                for skill, embedding in zip(self.skills, self.skill_embeddings, strict=True)
            ],
            dim=-2,
        )
        return (decision.softmax(dim=-1)[..., None] * skill_q_values).sum(dim=-2)


def counterparts(network: SkillQNetwork, params: Any) -> Iterator[tuple[nn.Parameter, Floats]]:
    """Every parameter of the network with its counterpart in a JAX tree, in PyTorch's layout.

    Args:
        network: where the parameters are.
        params: a tree of parameters, or of gradients, of `sqn_jax`'s network `sqn`.
    """
    tree = params["params"]
    blocks = {"ranges": tree["features"]["ranges"], "goal": tree["features"]["goal"]}
    blocks["decision"] = tree["decision"]
    modules = {name: getattr(network, name) for name in blocks}
    for index, skill in enumerate(network.skills):
        blocks[f"skill_{index}"], modules[f"skill_{index}"] = tree[f"skill_{index}"], skill
        yield network.skill_embeddings[index], np.asarray(tree[f"skill_{index}_embedding"])
    yield network.decision_embedding, np.asarray(tree["decision_embedding"])
    for name, module in modules.items():
        for layer in ("hidden", "output"):
            yield getattr(module, layer).weight, np.asarray(blocks[name][layer]["kernel"]).T
            yield getattr(module, layer).bias, np.asarray(blocks[name][layer]["bias"])
    gru, given = network.perception, tree["perception"]
    candidate_bias = np.asarray(given["candidate_bias"])
    yield gru.get_parameter("weight_ih_l0"), np.asarray(given["input_kernel"]).T
    yield gru.get_parameter("bias_ih_l0"), np.asarray(given["input_bias"])
    yield gru.get_parameter("weight_hh_l0"), np.asarray(given["hidden_kernel"]).T
    yield (
        gru.get_parameter("bias_hh_l0"),
        np.concatenate([np.zeros(2 * gru.hidden_size), candidate_bias]),
    )


def copy_params(network: SkillQNetwork, params: Any) -> None:
    """Give the network the parameters of a JAX tree."""
    with torch.no_grad():
        for parameter, values in counterparts(network, params):
            parameter.copy_(torch.tensor(values))


def rescale(value: Tensor) -> Tensor:
    """The squashing h(x) = sign(x) (sqrt(|x| + 1) - 1) + eps x (R2D2, eq. 1)."""
    return value.sign() * ((value.abs() + 1).sqrt() - 1) + RESCALING_EPSILON * value


def inverse_rescale(value: Tensor) -> Tensor:
    """The inverse of `rescale`, without cancellation."""
    eps = RESCALING_EPSILON
    bound = value.abs() + 1 + eps
    ratio = 2 * bound / ((1 + 4 * eps * bound).sqrt() + 1)
    return value.sign() * (ratio * ratio - 1)


def n_step_targets(rewards: Tensor, discounts: Tensor, values: Tensor, n_step: int) -> Tensor:
    """n-step returns [T, B] from rewards and discounts [T, B] and values [T + 1, B].

    Near the end of the sequence the sum is shorter and bootstraps from the last value.
    """
    length = rewards.shape[0]
    rewards = nn.functional.pad(rewards, (0, 0, 0, n_step - 1))
    discounts = nn.functional.pad(discounts, (0, 0, 0, n_step - 1), value=1.0)
    targets = torch.cat([values[1:], values[-1:].expand(n_step - 1, -1)])[n_step - 1 :]
    for offset in reversed(range(n_step)):
        steps = slice(offset, offset + length)
        targets = rewards[steps] + discounts[steps] * targets
    return targets


def pick(q_values: Tensor, actions: Tensor) -> Tensor:
    """Values [T, B] of actions [T, B] out of [T, B, A]."""
    return q_values.gather(-1, actions[..., None]).squeeze(-1)


def r2d2_loss(
    online: SkillQNetwork, target: SkillQNetwork, batch: Batch, config: LearnerConfig
) -> tuple[Tensor, Tensor]:
    """Half the mean squared TD error after burn-in, weighted, and the TD errors [T', B].

    Against n-step double-Q targets with value rescaling.
    """
    burn_in = config.burn_in_length
    seen = (batch.ranges[burn_in:], batch.goal[burn_in:])
    carries = [batch.carry, batch.carry]
    with torch.no_grad():
        if burn_in:
            warm_up = (batch.ranges[:burn_in], batch.goal[:burn_in], batch.carry)
            carries = [network.perceive(*warm_up)[1] for network in (online, target)]
        target_values = target(*seen, carries[1])
    q_values = online(*seen, carries[0])
    with torch.no_grad():
        bootstrap = inverse_rescale(pick(target_values, q_values.argmax(dim=-1)))
        discounts = config.discount * (~batch.terminated[burn_in:]).float()
        rewards = batch.rewards[burn_in:]
        targets = rescale(n_step_targets(rewards, discounts, bootstrap, config.n_step))
    td_errors = targets - pick(q_values[:-1], batch.actions[burn_in:])
    return 0.5 * (batch.weights * td_errors.square()).mean(), td_errors.detach()


class Learner:
    """Online and target network and the optimizer.

    Raises:
        ValueError: a setting of the learner that is a switch is not the preset `paper`'s.
    """

    def __init__(
        self, network: SkillQNetwork, config: LearnerConfig, max_priority_weight: float
    ) -> None:
        paper = LearnerConfig()
        for name in ("double_q", "value_rescaling", "learning_rate_schedule"):
            value, expected = getattr(config, name), getattr(paper, name)
            if value != expected:
                raise ValueError(f"learner.{name} is {value!r}, expected {expected!r}")
        self.online = network
        self.target = copy.deepcopy(network).requires_grad_(False)
        self.config = config
        self.max_priority_weight = max_priority_weight
        self.optimizer = torch.optim.Adam(
            network.parameters(), lr=config.learning_rate, eps=config.adam_epsilon, fused=True
        )

    def update(self, batch: Batch) -> Tensor:
        """One step of the optimizer and one of the target network; returns priorities [B]."""
        loss, td_errors = r2d2_loss(self.online, self.target, batch, self.config)
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.online.parameters(), self.config.max_grad_norm)
        self.optimizer.step()
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.online.parameters(), strict=True)
            for slow, fast in pairs:
                slow.lerp_(fast, self.config.target_update_rate)
        magnitude, share = td_errors.abs(), self.max_priority_weight
        return share * magnitude.amax(dim=0) + (1 - share) * magnitude.mean(dim=0)

    def updates(self, batches: Sequence[Batch]) -> list[Tensor]:
        """One update from each batch; returns their priorities."""
        return [self.update(batch) for batch in batches]
