"""Policies of few units for a robot of few beams."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.state import params_shapes

ROBOT = {"num_beams": 7, "field_of_view_deg": 270.0, "max_range": 3.0, "max_goal_distance": 10.0}


def tiny(algo: str = "sqn", **changes: Any) -> TrainConfig:
    """A network of 8 units for a robot of 7 beams."""
    names = ("heading_encoding", "goal_distance_encoding", "goal_distance_scale")
    env = EnvConfig(**ROBOT, **{name: changes.pop(name) for name in names if name in changes})
    return TrainConfig(algo=algo, env=env, network=NetworkConfig(hidden_size=8, **changes))


def random_policy(config: TrainConfig, seed: int = 0) -> Policy:
    """Weights of every part, biases and norms among them, large enough to matter."""
    rng = np.random.default_rng(seed)

    def draw(leaf: Any) -> Any:
        return jnp.asarray(rng.normal(size=leaf.shape), jnp.float32)

    return Policy("tiny", config, (jax.tree.map(draw, params_shapes(config)),))
