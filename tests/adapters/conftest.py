"""The room that all adapters are tested in."""

from __future__ import annotations

import pytest
from one_room import LENGTH
from rooms import small_room_map

from sqn_jax.maps import OccupancyMap


@pytest.fixture(scope="session")
def room() -> OccupancyMap:
    return small_room_map(LENGTH)
