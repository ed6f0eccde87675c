"""What stays the same during a run, bound once: the settings, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import optax
from jax.sharding import Mesh

from sqn_jax.agent.networks import QNetwork, make_network
from sqn_jax.agent.shards import AXIS, SEEDS
from sqn_jax.config import LearnerConfig, TrainConfig
from sqn_jax.config.validation import require


@dataclass(frozen=True)
class Program:
    """The last argument of all that trains; static in compiled functions.

    Two of equal fields are equal, and one compiled function serves both: network and optimizer
    follow from the fields, are made once and not compared.

    Raises:
        ValueError: the window does not divide the episode, or burn-in leaves nothing of it; or the
            updates of the run cannot be counted.
    """

    config: TrainConfig
    max_steps: int
    """Steps of an episode, which may depend on the map."""
    num_actions: int
    """A."""
    mesh: Mesh | None = None
    """The devices that seeds and robots are divided between; None for one alone."""

    def __post_init__(self) -> None:
        learner, steps = self.config.learner, f"the episode's {self.max_steps} steps"
        if self.config.env.max_steps == 0:
            steps += " (env.max_steps 0: the limit of the map)"
        require(
            self.max_steps % self.window_length == 0,
            "learner.window_length",
            learner.window_length,
            f"a divisor of {steps}",
        )
        require(
            self.config.method != "r2d2" or learner.burn_in_length < self.max_steps,
            "learner.burn_in_length",
            learner.burn_in_length,
            f"less than {steps}",
        )
        require(
            learner.discount_start < 1, "learner.discount_start", learner.discount_start, "below 1"
        )
        require(
            self.total_updates < 2**31,
            "total_episodes",
            self.config.total_episodes,
            f"fewer than 2147483648 updates, at {self.updates_per_round:,} a round",
        )

    @cached_property
    def network(self) -> QNetwork:
        """The agent."""
        config = self.config
        return make_network(config.algo, config.network, self.num_actions, config.env)

    @cached_property
    def optimizer(self) -> optax.GradientTransformation:
        """Its schedule spans the run."""
        return make_optimizer(self.config.learner, self.total_updates)

    @property
    def axis_name(self) -> str | None:
        """Of the devices that share a seed, for what they do together; None for one alone."""
        return None if self.mesh is None or self.mesh.shape[AXIS] == 1 else AXIS

    @property
    def seed_axis_name(self) -> str | None:
        """Of the devices that have seeds of their own; None where all have all."""
        return None if self.mesh is None or self.mesh.shape[SEEDS] == 1 else SEEDS

    @property
    def window_length(self) -> int:
        """Steps of a robot between two calls of `learn`: the whole episode for `r2d2`."""
        window = self.config.learner.window_length if self.config.method == "pqn" else 0
        return window or self.max_steps

    @property
    def num_windows(self) -> int:
        """Windows of an episode."""
        return self.max_steps // self.window_length

    @property
    def num_minibatches(self) -> int:
        """Minibatches that `pqn` divides the robots into."""
        return self.config.num_envs // self.config.learner.batch_size

    @property
    def updates_per_round(self) -> int:
        """Updates of the network in one round, once learning has begun."""
        if self.config.method == "r2d2":
            return self.config.updates_per_round
        return self.num_windows * self.num_minibatches * self.config.learner.num_passes

    @property
    def total_updates(self) -> int:
        """Updates of the whole run, those included that `r2d2` leaves out at first."""
        return self.config.num_rounds * self.updates_per_round


def make_optimizer(config: LearnerConfig, total_updates: int) -> optax.GradientTransformation:
    """Adam with gradients clipped by their global norm and the configured schedule."""
    learning_rate: float | optax.Schedule = config.learning_rate
    if config.learning_rate_schedule == "linear":
        learning_rate = optax.linear_schedule(config.learning_rate, 0.0, total_updates)
    return optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.adam(learning_rate, eps=config.adam_epsilon),
    )
