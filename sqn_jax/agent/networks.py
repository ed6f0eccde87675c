"""The three networks of the paper behind one interface: SQN, R2D2, DQN (sections III-B, IV-D).

Each maps a time-major sequence of observations and a recurrent state to Q-values. The learner and
the rollout know only this interface; which network runs is a matter of configuration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.gru import GRU
from sqn_jax.agent.linear import Dense
from sqn_jax.agent.reachability import goal_seems_reachable
from sqn_jax.agent.refined_gru import RefinedGRU
from sqn_jax.config import Algorithm, EnvConfig, NetworkConfig

Params = Any
"""A Linen parameter tree."""

GOAL_SCALE = 4.0
"""Initial scale of the layer that sees the goal. Where to turn is decided within a twentieth of the
heading's range and a hundredth of the distance's; at scale 1 no ReLU bends that sharply. The goal's
radius of 0.3 m is 1/80 of the range of a distance up to 24 m, and 1/18 of that of one encoded as
d / (d + 5 m): as fine as the heading, so the same scale serves."""

HEAD_SCALE = 0.1
"""Initial scale of Q-heads and of the skill decision: small values, no skill preferred."""

GATE_BALANCE = "decision_balance"
"""Name of the bias [K] on the logits of the skill decision, where there is one. It stands among the
parameters, so that checkpoints, averages and target networks have it, too."""


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
    sensors: EnvConfig
    """What the gate `reachable` reads the observation by; nothing else depends on it."""

    @nn.compact
    def __call__(self, obs: HasObservation, carry: Array) -> tuple[Array, QOutput]:
        """Return the next carry [B, H] and the Q-values for observations [T, B, ...]."""
        size, norm = self.config.hidden_size, self.config.layer_norm
        features = Features(size, self.config.motion_inputs, name="features")(obs)  # eq. 1
        cell = _CELLS[self.config.cell](size, name="perception")
        carry, perception = cell(features, carry)  # eq. 2

        if self.config.gate == "learned":
            skill_weights = self._decision(perception)
        else:
            skill_weights = _fixed_gate(obs, self.config, self.sensors)

        each_skill = []
        for name in [f"skill_{index}" for index in range(self.config.num_skills)]:
            skill = MLP(size, self.num_actions, norm, output_scale=HEAD_SCALE, name=name)
            each_skill.append(skill(self._embedded(perception, name)))  # eq. 5
        skill_q_values = jnp.stack(each_skill, axis=-2)

        q_values = (skill_weights[..., None] * skill_q_values).sum(axis=-2)  # eq. 6
        return carry, QOutput(q_values, skill_weights, skill_q_values)

    def _decision(self, perception: Array) -> Array:
        """The skill decision eta [T, B, K] of perceptions [T, B, H]."""
        config = self.config
        decision = MLP(
            *(config.hidden_size, config.num_skills, config.layer_norm),
            output_scale=HEAD_SCALE,
            name="decision",
        )
        z_decision = decision(self._embedded(perception, "decision"))  # eq. 3
        if config.gate_balance_rate > 0:
            # No gradient: the learner moves it by the load of the skills (`learner.balanced`).
            balance = self.param(GATE_BALANCE, nn.initializers.zeros, (config.num_skills,))
            z_decision += jax.lax.stop_gradient(balance)[None, None]
        if config.gate_temperature != 1:
            z_decision /= config.gate_temperature
        return nn.softmax(z_decision, axis=-1)  # eq. 4

    def _embedded(self, perception: Array, name: str) -> Array:
        """The perception [T, B, H] plus the learnable embedding e_mod of a module."""
        if not self.config.embeddings:
            return perception
        # Small, so as not to drown z.
        initializer, shape = nn.initializers.normal(0.02), (self.config.hidden_size,)
        embedding: Array = self.param(f"{name}_embedding", initializer, shape)
        return perception + embedding[None, None]


def _fixed_gate(obs: HasObservation, config: NetworkConfig, sensors: EnvConfig) -> Array:
    """Skill weights [T, B, K] that are not learned, for observations [T, B, ...]."""
    if config.gate == "equal":
        return jnp.full((*obs.goal.shape[:2], config.num_skills), 1 / config.num_skills)
    reachable = goal_seems_reachable(obs.ranges, obs.goal, sensors)
    return jnp.stack([reachable, ~reachable], axis=-1).astype(jnp.float32)


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
        width = size * self.config.r2d2_width_factor
        head = MLP(width, self.num_actions, norm, output_scale=HEAD_SCALE, name="skill_0")
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

_SINGLE_HEADS: dict[str, Callable[..., QNetwork]] = {
    "r2d2": RecurrentQNetwork,
    "dqn": FeedForwardQNetwork,
}


def make_network(
    algo: Algorithm, config: NetworkConfig, num_actions: int, sensors: EnvConfig | None = None
) -> QNetwork:
    """The network of an agent.

    Args:
        algo: which of the three.
        config: its sizes and switches.
        num_actions: A.
        sensors: of the robot, for the gate `reachable`; None: those of the paper. Networks that do
            not read it are equal whatever it is.
    """
    if algo != "sqn":
        return _SINGLE_HEADS[algo](config, num_actions)
    if sensors is None or config.gate != "reachable":
        sensors = EnvConfig()
    return SkillQNetwork(config, num_actions, sensors)


def initial_carry(config: NetworkConfig, batch_size: int) -> Array:
    """The recurrent state [B, H] at the start of an episode: zero."""
    return jnp.zeros((batch_size, config.hidden_size))
