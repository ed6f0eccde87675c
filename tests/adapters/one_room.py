"""One small room for all adapters, so that they share their compiled programs."""

from __future__ import annotations

import jax

import sqn_jax

LENGTH = 6
"""Steps of an episode."""

NOISE = {"velocity_noise": 0.1, "range_noise": 0.1}

take = jax.jit(sqn_jax.step)
begin = jax.jit(sqn_jax.reset)
