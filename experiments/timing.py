"""Timing several programs side by side, fairly on a machine that others use too."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import jax

Timed = Callable[[int], Any]
"""What is timed: takes the number of the turn and returns results, which are waited for."""

Name = TypeVar("Name", bound=Hashable)


@dataclass(frozen=True)
class Timing:
    """How long a program took."""

    first_call: float
    """Seconds of the first call, in which it is compiled."""
    seconds: tuple[float, ...]
    """Seconds of each turn after that."""

    @property
    def median(self) -> float:
        """Median seconds of a turn."""
        return statistics.median(self.seconds)

    def rates(self, amount: float, unit: str) -> dict[str, float]:
        """`amount` a second: the median turn as `unit`, the slowest and the fastest turn."""
        return {
            unit: four_digits(amount / self.median),
            "slowest": four_digits(amount / max(self.seconds)),
            "fastest": four_digits(amount / min(self.seconds)),
            "first_call_seconds": round(self.first_call, 2),
        }


def four_digits(value: float) -> float:
    """Rounded to four significant digits; whole from 1000 on."""
    return round(value) if value >= 1000 else float(f"{value:.4g}")


def time_in_turns(programs: Mapping[Name, Timed], repeats: int) -> dict[Name, Timing]:
    """Time programs one after the other, again and again.

    All are called once first, to compile and to warm up. Then each runs once a turn, so that a busy
    moment of the machine hits all of them and none in particular.
    """
    first_call = {name: _seconds(program, 0) for name, program in programs.items()}
    seconds: dict[Name, list[float]] = {name: [] for name in programs}
    for turn in range(repeats):
        for name, program in programs.items():
            seconds[name].append(_seconds(program, turn))
    return {name: Timing(first_call[name], tuple(seconds[name])) for name in programs}


def _seconds(program: Timed, turn: int) -> float:
    started = time.perf_counter()
    jax.block_until_ready(program(turn))
    return time.perf_counter() - started
