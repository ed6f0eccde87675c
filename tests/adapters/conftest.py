"""One small room for all adapters, so that they share their compiled programs."""

from __future__ import annotations

import jax
import pytest
from rooms import small_room_map

import sqn_jax
from sqn_jax.maps import OccupancyMap

LENGTH = 6
"""Steps of an episode."""

take = jax.jit(sqn_jax.step)
begin = jax.jit(sqn_jax.reset)

NOISE = {"velocity_noise": 0.1, "range_noise": 0.1}


@pytest.fixture(scope="session")
def room() -> OccupancyMap:
    return small_room_map(LENGTH)
