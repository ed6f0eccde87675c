"""Every setting of a run, as frozen dataclasses that check themselves.

A config is static: it is hashable, decides shapes and branches, and is passed to jitted functions
as a static argument. Numbers that one might sweep inside one program (speeds, noise, reward
weights) are copied from `EnvConfig` into the traced `EnvParams` when an environment is made.

The defaults follow the paper (sections III-B and IV-A to IV-D); where it is silent,
docs/ARCHITECTURE.md states the value chosen and why. The other presets stand in `presets.py`.
"""

from sqn_jax.config.files import flat, from_dict, load, save, to_dict, to_public_dict
from sqn_jax.config.groups import (
    EnvConfig,
    EvalConfig,
    ExplorationConfig,
    LearnerConfig,
    NetworkConfig,
    RandomizationConfig,
    ReplayConfig,
)
from sqn_jax.config.run import Algorithm, Method, TrainConfig

__all__ = [
    "Algorithm",
    "EnvConfig",
    "EvalConfig",
    "ExplorationConfig",
    "LearnerConfig",
    "Method",
    "NetworkConfig",
    "RandomizationConfig",
    "ReplayConfig",
    "TrainConfig",
    "flat",
    "from_dict",
    "load",
    "save",
    "to_dict",
    "to_public_dict",
]
