"""The growing horizon by hand."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

from sqn_jax.agent.learner import discount_schedule
from sqn_jax.config import LearnerConfig


def test_the_horizon_grows_geometrically_from_start_to_end() -> None:
    config = LearnerConfig(discount_start=0.9, discount=0.999)
    # Horizons 10, 100, 1000: a factor of ten in each half of the run.
    for progress, discount in ((0.0, 0.9), (0.5, 0.99), (1.0, 0.999), (1.3, 0.999)):
        got = discount_schedule(jnp.float32(progress), config)
        assert float(got) == pytest.approx(discount, abs=1e-6)


def test_without_a_start_the_discount_is_constant() -> None:
    config = LearnerConfig(discount=0.997)
    assert [discount_schedule(jnp.float32(x), config) for x in (0.0, 0.5, 1.0)] == [0.997] * 3
