"""Skill Q-Networks for mapless navigation: simulator, learner and evaluation in one JAX program.

import jax, sqn_jax
params = sqn_jax.make_env("maze")
obs, state = sqn_jax.reset(jax.random.key(0), params)
obs, state, reward, terminated, truncated, info = sqn_jax.step(key, state, action, params)
"""

from sqn_jax.env import EnvParams, EnvState, Observation, make_env, reset, step

__version__ = "0.1.0"

__all__ = ["EnvParams", "EnvState", "Observation", "__version__", "make_env", "reset", "step"]
