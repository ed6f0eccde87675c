"""Skill Q-Networks for mapless navigation: simulator, learner and evaluation in one JAX program.

import jax, sqn_jax
params = sqn_jax.make_env("maze")
obs, state = sqn_jax.reset(jax.random.key(0), params)
obs, state, reward, terminated, truncated, info = sqn_jax.step(key, state, action, params)

Nothing is loaded before it is asked for: `import sqn_jax` and `sqn --help` start no JAX.
"""

from __future__ import annotations

import importlib
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sqn_jax.env import EnvParams, EnvState, Observation, make_env, reset, step
    from sqn_jax.policies.greedy import GreedyPolicy, load_policy

__version__ = "0.1.0"

__all__ = [
    "EnvParams",
    "EnvState",
    "GreedyPolicy",
    "Observation",
    "__version__",
    "load_policy",
    "make_env",
    "reset",
    "step",
]

_POLICIES = ("GreedyPolicy", "load_policy")

_IMPORTED = time.time()
"""When the first module of this package was imported, s since the epoch."""


def __getattr__(name: str) -> Any:
    """Load what is named in `__all__` upon its first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place = "sqn_jax.policies.greedy" if name in _POLICIES else "sqn_jax.env"
    value = getattr(importlib.import_module(place), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(globals().keys() | set(__all__))
