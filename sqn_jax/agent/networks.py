"""The three networks of the paper behind one interface: SQN, R2D2, DQN (sections III-B, IV-D).

Each maps a time-major sequence of observations and a recurrent state to Q-values. The learner and
the rollout know only this interface; which network runs is a matter of configuration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

import flax.linen as nn
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.gru import GRU
from sqn_jax.agent.linear import Dense
from sqn_jax.agent.refined_gru import RefinedGRU
from sqn_jax.config import Algorithm, NetworkConfig

Params = Any
"""A Linen parameter tree."""

GOAL_SCALE = 4.0
"""Initial scale of the layer that sees the goal. Where to turn is decided within a twentieth of the
heading's range and a hundredth of the distance's; at scale 1 no ReLU bends that sharply. The goal's
radius of 0.3 m is 1/80 of the range of a distance up to 24 m, and 1/18 of that of one encoded as
d / (d + 5 m): as fine as the heading, so the same scale serves."""

HEAD_SCALE = 0.1
"""Initial scale of Q-heads and of the skill decision: small values, no skill preferred."""


_CELLS: dict[str, Callable[..., GRU | RefinedGRU]] = {"gru": GRU, "refined_gru": RefinedGRU}


class HasObservation(Protocol):
    """What a network looks at: `ranges` [T, B, R] and `goal` [T, B, G], all in 0..1."""

    @property
    def ranges(self) -> Array: ...

    @property
    def goal(self) -> Array: ...


class HasMotion(HasObservation, Protocol):
    """What a network with `motion_inputs` looks at, too: `motion` [T, B, A + 1] in 0..1."""

    @property
    def motion(self) -> Array: ...


@struct.dataclass
class QOutput:
    """Output of a network for T steps of B robots, A actions and K skills (K is 1 without)."""

    q_values: Array
    """[T, B, A] action values (eq. 6); with value rescaling, of h(Q)."""
    skill_weights: Array
    """[T, B, K] the skill decision eta (eq. 4), positive and summing to 1."""
    skill_q_values: Array
    """[T, B, K, A] action values of each skill (eq. 5)."""


class MLP(nn.Module):
    """Two linear layers with a ReLU in between, optionally layer-normalized before it."""

    hidden_size: int
    output_size: int
    layer_norm: bool = False
    input_scale: float = 1.0
    """Scale of the first layer's initial weights and biases."""
    output_scale: float = 1.0
    """Scale of the output layer's initial weights and biases: small for a head, near 0 at first."""

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        """Map inputs [T, B, D] to outputs [T, B, E]."""
        hidden = Dense(self.hidden_size, self.input_scale, name="hidden")(inputs)
        if self.layer_norm:
            hidden = nn.LayerNorm(name="norm")(hidden)
        return Dense(self.output_size, self.output_scale, name="output")(nn.relu(hidden))


class Features(nn.Module):
    """The features of both observations, each through an MLP of its own (eq. 1)."""

    size: int
    motion_inputs: bool

    @nn.compact
    def __call__(self, obs: HasObservation) -> Array:
        """Map an observation [T, B, ...] to the features [z_range; z_goal], [T, B, 2 size].

        With `motion_inputs` the motion follows as it is, as R2D2 feeds its memory the last action.
        """
        # Never normalized: over two inputs it would keep their ratio and lose their size.
        z_range = MLP(self.size, self.size, name="ranges")(obs.ranges)
        z_goal = MLP(self.size, self.size, input_scale=GOAL_SCALE, name="goal")(obs.goal)
        motion = [cast(HasMotion, obs).motion] if self.motion_inputs else []
        return jnp.concatenate([z_range, z_goal, *motion], axis=-1)


class SkillQNetwork(nn.Module):
    """The Skill Q-Network (eq. 1 to 6): GRU perception, skill decision, K latent skills."""

    config: NetworkConfig
    num_actions: int

    @nn.compact
    def __call__(self, obs: HasObservation, carry: Array) -> tuple[Array, QOutput]:
        """Return the next carry [B, H] and the Q-values for observations [T, B, ...]."""
        size, norm = self.config.hidden_size, self.config.layer_norm
        num_skills = self.config.num_skills
        features = Features(size, self.config.motion_inputs, name="features")(obs)  # eq. 1
        cell = _CELLS[self.config.cell](size, name="perception")
        carry, perception = cell(features, carry)  # eq. 2

        decision = MLP(size, num_skills, norm, output_scale=HEAD_SCALE, name="decision")
        z_decision = decision(perception + self._embedding("decision"))  # eq. 3
        skill_weights = nn.softmax(z_decision, axis=-1)  # eq. 4

        each_skill = []
        for name in [f"skill_{index}" for index in range(num_skills)]:
            skill = MLP(size, self.num_actions, norm, output_scale=HEAD_SCALE, name=name)
            each_skill.append(skill(perception + self._embedding(name)))  # eq. 5
        skill_q_values = jnp.stack(each_skill, axis=-2)

        q_values = (skill_weights[..., None] * skill_q_values).sum(axis=-2)  # eq. 6
        return carry, QOutput(q_values, skill_weights, skill_q_values)

    def _embedding(self, name: str) -> Array:
        """The learnable embedding e_mod of a module [1, 1, H]; small, so as not to drown z."""
        shape = (self.config.hidden_size,)
        embedding: Array = self.param(f"{name}_embedding", nn.initializers.normal(0.02), shape)
        return embedding[None, None]


class RecurrentQNetwork(nn.Module):
    """The R2D2 baseline: the same perception, a single Q-head (section IV-D)."""

    config: NetworkConfig
    num_actions: int

    @nn.compact
    def __call__(self, obs: HasObservation, carry: Array) -> tuple[Array, QOutput]:
        """Return the next carry [B, H] and the Q-values for observations [T, B, ...]."""
        size, norm = self.config.hidden_size, self.config.layer_norm
        features = Features(size, self.config.motion_inputs, name="features")(obs)
        carry, perception = _CELLS[self.config.cell](size, name="perception")(features, carry)
        head = MLP(size, self.num_actions, norm, output_scale=HEAD_SCALE, name="skill_0")
        return carry, _single_head(head(perception))


class FeedForwardQNetwork(nn.Module):
    """The DQN baseline: no memory, the layers after the features three times as wide (IV-D)."""

    config: NetworkConfig
    num_actions: int

    @nn.compact
    def __call__(self, obs: HasObservation, carry: Array) -> tuple[Array, QOutput]:
        """Return the carry unchanged and the Q-values for observations [T, B, ...]."""
        width, norm = self.config.hidden_size * self.config.dqn_width_factor, self.config.layer_norm
        features = Features(self.config.hidden_size, self.config.motion_inputs, name="features")(
            obs
        )
        hidden = Dense(width, name="perception")(features)
        if norm:
            hidden = nn.LayerNorm(name="norm")(hidden)
        head = MLP(width, self.num_actions, norm, output_scale=HEAD_SCALE, name="skill_0")
        return carry, _single_head(head(nn.relu(hidden)))


def _single_head(q_values: Array) -> QOutput:
    """The output of a network without skills: one that has all the weight."""
    return QOutput(
        q_values=q_values,
        skill_weights=jnp.ones((*q_values.shape[:-1], 1)),
        skill_q_values=q_values[..., None, :],
    )


QNetwork = SkillQNetwork | RecurrentQNetwork | FeedForwardQNetwork

_NETWORKS: dict[str, Callable[..., QNetwork]] = {
    "sqn": SkillQNetwork,
    "r2d2": RecurrentQNetwork,
    "dqn": FeedForwardQNetwork,
}


def make_network(algo: Algorithm, config: NetworkConfig, num_actions: int) -> QNetwork:
    """The network of an agent."""
    return _NETWORKS[algo](config, num_actions)


def initial_carry(config: NetworkConfig, batch_size: int) -> Array:
    """The recurrent state [B, H] at the start of an episode: zero."""
    return jnp.zeros((batch_size, config.hidden_size))
