"""A policy that is made up, and scans for it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from sqn_navigation.conversions import Scan

BEAMS = np.radians(np.linspace(-175, 175, 71))


class MadeUpPolicy:
    """Drives forward while nothing is near ahead, else turns left; counts its steps."""

    beam_angles = BEAMS
    time_step = 0.1
    env = {"max_range": 5.0, "robot_radius": 0.1}  # noqa: RUF012

    def __init__(self) -> None:
        self.seen: list[tuple[Any, float, float, Any]] = []

    def act(self, ranges: Any, distance: float, heading: float, hidden: Any) -> tuple[Any, int]:
        self.seen.append((ranges, distance, heading, hidden))
        return ((2.5, 0.0) if ranges[35] > 1 else (0.0, math.pi)), (hidden or 0) + 1


def scan(ahead: float = 3.0) -> Scan:
    ranges = np.full(360, 4.0)
    ranges[:3] = ahead
    return Scan(ranges, 0.0, math.radians(1), 0.1, 12.0)
