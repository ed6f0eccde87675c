"""The three networks of the paper behind one interface: SQN, R2D2, DQN (sections III-B, IV-D).

Each maps a time-major sequence of observations and a recurrent state to Q-values. The learner and
the rollout know only this interface; which network runs is a matter of configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.gru import GRU
from sqn_jax.agent.linear import Branches, Linear, affine, apply_each, stacked, then
from sqn_jax.config import Algorithm, NetworkConfig

Params = Any
"""A Linen parameter tree."""

GOAL_SCALE = 4.0
"""Initial scale of the layer that sees the goal. Where to turn is decided within a twentieth of the
heading's range and a hundredth of the distance's; at scale 1 no ReLU bends that sharply."""

HEAD_SCALE = 0.1
"""Initial scale of Q-heads and of the skill decision: small values, no skill preferred."""


class HasObservation(Protocol):
    """What a network looks at: `ranges` [T, B, R] and `goal` [T, B, G], all in 0..1."""

    @property
    def ranges(self) -> Array: ...

    @property
    def goal(self) -> Array: ...


@struct.dataclass
class QOutput:
    """Output of a network for T steps of B robots, A actions and K skills (K is 1 without)."""

    q_values: Array
    """[T, B, A] action values; with value rescaling, of h(Q)."""
    skill_weights: Array
    """[T, B, K] the skill decision eta (eq. 4), positive and summing to 1."""
    skill_q_values: Array
    """[T, B, K, A] action values of each skill (eq. 5)."""


class Norm(NamedTuple):
    """Scale and bias [H] after a layer normalisation."""

    scale: Array
    bias: Array


class TwoLayers(NamedTuple):
    """The parameters of an MLP with one hidden layer."""

    hidden: Linear
    norm: Norm | None
    output: Linear


class MLP(nn.Module):
    """Two linear layers with a ReLU in between, optionally layer-normalised before it.

    Only their parameters: heads are computed side by side (`side_by_side`), and so are features.
    """

    hidden_size: int
    output_size: int
    layer_norm: bool
    output_scale: float = 1.0
    """Scale of the output layer's initial weights and biases: small for a head, near 0 at first."""
    input_scale: float = 1.0
    """Scale of the first layer's initial weights and biases."""

    @nn.compact
    def __call__(self, fan_in: int) -> TwoLayers:
        """The layers for inputs [..., fan_in]."""
        hidden = _linear(fan_in, self.hidden_size, "hidden", self.input_scale)
        norm = _Norm(self.hidden_size, name="norm")() if self.layer_norm else None
        output = _linear(self.hidden_size, self.output_size, "output", self.output_scale)
        return TwoLayers(hidden, norm, output)


def side_by_side(inputs: Array, mlps: Sequence[TwoLayers]) -> Branches:
    """Several MLPs with the same inputs [..., D], all but their output layers done."""
    hidden = affine(inputs, *stacked([mlp.hidden for mlp in mlps]))
    norms = [mlp.norm for mlp in mlps if mlp.norm is not None]
    if norms:
        hidden = _normalise(hidden, norms)
    return Branches(nn.relu(hidden), tuple(mlp.output for mlp in mlps))


def _normalise(hidden: Array, norms: Sequence[Norm]) -> Array:
    """Layer normalisation of each of several layers of equal size side by side, [..., n H]."""
    groups = hidden.reshape(*hidden.shape[:-1], len(norms), -1)
    normal = cast(Array, nn.LayerNorm(use_scale=False, use_bias=False).apply({}, groups))
    shape = (1,) * (hidden.ndim - 1) + groups.shape[-2:]
    scale, bias = (jnp.stack(each).reshape(shape) for each in zip(*norms, strict=True))
    return (normal * scale + bias).reshape(hidden.shape)


class Features(nn.Module):
    """Both observations through an MLP each, side by side (eq. 1): [..., 2 x hidden_size]."""

    config: NetworkConfig

    @nn.compact
    def __call__(self, obs: HasObservation) -> Branches:
        """Map an observation [T, B, ...] to features [T, B, 2 H], all but the last layers done."""
        size = self.config.hidden_size
        # Never normalised: over two inputs it would keep their ratio and lose their size.
        ranges = MLP(size, size, layer_norm=False, name="ranges")(obs.ranges.shape[-1])
        goal = MLP(size, size, layer_norm=False, input_scale=GOAL_SCALE, name="goal")(
            obs.goal.shape[-1]
        )
        inputs = jnp.concatenate([obs.ranges, obs.goal], axis=-1)
        hidden = apply_each(inputs, [ranges.hidden, goal.hidden])
        return Branches(nn.relu(hidden), (ranges.output, goal.output))


class SkillQNetwork(nn.Module):
    """The Skill Q-Network (paper eq. 1 to 6): GRU perception, skill decision, N latent skills."""

    config: NetworkConfig
    num_actions: int

    @nn.compact
    def __call__(self, obs: HasObservation, carry: Array) -> tuple[Array, QOutput]:
        """Return the next carry [B, H] and the Q-values for observations [T, B, ...]."""
        config = self.config
        size, norm = config.hidden_size, config.layer_norm
        features = Features(config, name="features")(obs)
        carry, perception = GRU(size, name="perception")(features, carry)
        heads = [("decision", config.num_skills)]
        heads += [(f"skill_{index}", self.num_actions) for index in range(config.num_skills)]
        mlps = []  # Each sees the perception plus an embedding of its own.
        for name, outputs in heads:
            mlp = MLP(size, outputs, norm, HEAD_SCALE, name=name)(size)
            mlps.append(mlp._replace(hidden=_shifted(mlp.hidden, self._embedding(name))))
        told = side_by_side(perception, mlps).outputs()
        skill_weights = nn.softmax(told[..., : config.num_skills], axis=-1)
        skill_q_values = told[..., config.num_skills :].reshape(
            *told.shape[:-1], config.num_skills, self.num_actions
        )
        q_values = (skill_weights[..., None] * skill_q_values).sum(axis=-2)
        return carry, QOutput(q_values, skill_weights, skill_q_values)

    def _embedding(self, name: str) -> Array:
        """A head's learnable module embedding [H]; small at first, so that it does not drown z."""
        shape = (self.config.hidden_size,)
        embedding: Array = self.param(f"{name}_embedding", nn.initializers.normal(0.02), shape)
        return embedding


def _shifted(layer: Linear, embedding: Array) -> Linear:
    """The layer [D, E] that makes of z what `layer` makes of z + embedding, [D]."""
    return Linear(layer.kernel, layer.bias + embedding @ layer.kernel)


class RecurrentQNetwork(nn.Module):
    """The R2D2 baseline: the same perception, a single Q-head (section IV-D)."""

    config: NetworkConfig
    num_actions: int

    @nn.compact
    def __call__(self, obs: HasObservation, carry: Array) -> tuple[Array, QOutput]:
        """Return the next carry [B, H] and the Q-values for observations [T, B, ...]."""
        size, norm = self.config.hidden_size, self.config.layer_norm
        features = Features(self.config, name="features")(obs)
        carry, perception = GRU(size, name="perception")(features, carry)
        head = MLP(size, self.num_actions, norm, HEAD_SCALE, name="skill_0")(size)
        return carry, _single_head(side_by_side(perception, [head]).outputs())


class FeedForwardQNetwork(nn.Module):
    """The DQN baseline: no memory, the layers after the features three times as wide (IV-D)."""

    config: NetworkConfig
    num_actions: int

    @nn.compact
    def __call__(self, obs: HasObservation, carry: Array) -> tuple[Array, QOutput]:
        """Return the carry unchanged and the Q-values for observations [T, B, ...]."""
        width = self.config.hidden_size * self.config.dqn_width_factor
        features = Features(self.config, name="features")(obs)
        hidden = then(features, _linear(features.size, width, "perception"))
        if self.config.layer_norm:
            hidden = _normalise(hidden, [_Norm(width, name="norm")()])
        head = MLP(width, self.num_actions, self.config.layer_norm, HEAD_SCALE, name="skill_0")
        return carry, _single_head(side_by_side(nn.relu(hidden), [head(width)]).outputs())


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


def _single_head(q_values: Array) -> QOutput:
    return QOutput(
        q_values=q_values,
        skill_weights=jnp.ones((*q_values.shape[:-1], 1)),
        skill_q_values=q_values[..., None, :],
    )


class _Linear(nn.Module):
    """The parameters of a linear layer."""

    size: int
    scale: float

    @nn.compact
    def __call__(self, fan_in: int) -> Linear:
        initializer = nn.initializers.variance_scaling(self.scale**2, "fan_in", "truncated_normal")
        kernel = self.param("kernel", initializer, (fan_in, self.size))
        return Linear(kernel, self.param("bias", _uniform_bias(fan_in, self.scale), (self.size,)))


def _uniform_bias(fan_in: int, scale: float) -> nn.initializers.Initializer:
    """Biases spread over +-scale / sqrt(fan_in), so that the ReLUs of few inputs bend apart."""
    bound = scale / fan_in**0.5

    def initialize(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return initialize


def _linear(fan_in: int, size: int, name: str, scale: float = 1.0) -> Linear:
    """A layer of the module that is being set up, named as a part of it."""
    layer: Linear = _Linear(size, scale, name=name)(fan_in)
    return layer


class _Norm(nn.Module):
    """The parameters after a layer normalisation."""

    size: int

    @nn.compact
    def __call__(self) -> Norm:
        shape = (self.size,)
        scale = self.param("scale", nn.initializers.ones, shape)
        return Norm(scale, self.param("bias", nn.initializers.zeros, shape))
