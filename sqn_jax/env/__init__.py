"""The simulator: pure functions on the device, for one robot; `jax.vmap` makes many."""

from sqn_jax.env.navigation import (
    ACTION_NAMES,
    NUM_ACTIONS,
    observe,
    reset,
    reset_to,
    sample_task,
    step,
    true_ranges,
)
from sqn_jax.env.params import EnvParams, EnvState, Observation
from sqn_jax.env.prepare import make_env

__all__ = [
    "ACTION_NAMES",
    "NUM_ACTIONS",
    "EnvParams",
    "EnvState",
    "Observation",
    "make_env",
    "observe",
    "reset",
    "reset_to",
    "sample_task",
    "step",
    "true_ranges",
]
