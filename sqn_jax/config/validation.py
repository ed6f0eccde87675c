"""Checks of settings: each refuses by name, with the value and what was expected.

The limits of all numbers stand here, so that what a run or an evaluation cannot use is refused
before anything is computed.
"""

from __future__ import annotations

import math
import typing
from typing import Literal

MOST = 10**9
"""Of whole numbers: what counts steps, episodes or updates holds 32 bits."""

LARGEST, SMALLEST = 1e30, 1e-30
"""Of other numbers, and of those above 0: what single precision holds."""

LIMITS: dict[str, tuple[float, float]] = {
    "env.num_beams": (2, 4096),
    "env.field_of_view_deg": (0.1, 360),
    "env.max_steps": (0, 100_000),  # More would not fit into memory.
    "env.goal_radius": (1e-6, 1e6),
    "env.max_range": (1e-6, 1e6),
    "env.coverage_cell": (1e-3, 1e6),
    "env.max_goal_distance": (1e-6, 1e6),
    "env.goal_distance_scale": (1e-3, 1e6),  # Below, single precision rounds distances to 1.
    "env.velocity_noise": (0, 1e6),
    "env.range_noise": (0, 1e6),
    "env.forward_speed": (0, 100),
    "env.backward_speed": (0, 100),
    "env.turn_rate": (0, 100),
    "env.time_step": (1e-6, 10),
    "env.robot_radius": (0, 100),
    "env.bumper": (0, 100),
    "env.scan_margin": (0, 100),
    "env.reward_navigation": (-1e6, 1e6),
    "env.reward_exploration": (-1e6, 1e6),
    "env.reward_time": (-1e6, 1e6),
    "env.reward_collision": (-1e6, 1e6),
    "env.ray_sectors": (4, 1024),
    "env.ray_iterations": (1, 1000),
    "randomization.velocity_noise": (0, 1e6),
    "randomization.range_noise": (0, 1e6),
    "network.hidden_size": (1, 65_536),
    "network.num_skills": (1, 1024),
    "network.dqn_width_factor": (1, 1024),
    "network.r2d2_width_factor": (1, 1024),
    "network.gate_temperature": (1e-3, 1e3),
    "network.gate_balance_rate": (0, 1e3),
    "learner.gate_entropy_weight": (0, 1e6),
    "exploration.decay_fraction": (1e-6, 1),
    "learner.target_update_rate": (1e-9, 1),
    "learner.n_step": (1, 1000),  # Each is written out in the compiled program.
    "eval.episodes": (1, 100_000),  # More would not fit into memory.
    "eval.seeds": (1, 10_000),
    "eval.seed": (0, 2**31 - 1),
    "eval.curve_points": (0, 1_000_000),
    "eval.curve_episodes": (1, 100_000),
    "seed": (0, 2**31 - 1),
    "num_seeds": (1, 10_000),
}
"""Least and most of settings by their dotted names, where their own checks do not say both."""
MAX_SHOWN = 200
"""Letters of a value that an error shows."""


def require(condition: bool, name: str, value: object, expected: str) -> None:
    """Raise ValueError, in one line, where a condition does not hold."""
    if not condition:
        text = repr(value)
        shown_value = text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."
        raise ValueError(f"{name} is {shown_value}, expected {expected}")


def require_known_choices(config: object, group: str) -> None:
    """Check every field that takes one of a few strings."""
    for name, hint in typing.get_type_hints(type(config)).items():
        if typing.get_origin(hint) is Literal:
            choices = typing.get_args(hint)
            value = getattr(config, name)
            require(value in choices, _label(group, name), value, f"one of {', '.join(choices)}")


def require_within_limits(config: object, group: str) -> None:
    """Check that every number is finite and within `LIMITS`, or not larger than any may be."""
    for name, hint in typing.get_type_hints(type(config)).items():
        if hint in (int, float):
            label, value = _label(group, name), getattr(config, name)
            most = MOST if hint is int else LARGEST
            if label in LIMITS:
                require_limits(value, label, *LIMITS[label])
            require(label in LIMITS or abs(value) <= most, label, value, f"at most {_text(most)}")


def require_limits(value: float, name: str, least: float, most: float) -> None:
    """Check that a number lies between two, both included."""
    require(
        least <= value <= most, name, value, f"at least {_text(least)} and at most {_text(most)}"
    )


def _text(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def _label(group: str, name: str) -> str:
    return f"{group}.{name}" if group else name


def require_positive(config: object, group: str, name: str) -> None:
    """Check that a field is above 0, also in single precision, and finite."""
    value = getattr(config, name)
    require(0 < value < math.inf, _label(group, name), value, "a positive number")
    require(value >= SMALLEST, _label(group, name), value, f"at least {SMALLEST:g}")


def require_not_negative(config: object, group: str, name: str) -> None:
    """Check that a field is at least 0 and finite."""
    value = getattr(config, name)
    require(0 <= value < math.inf, _label(group, name), value, "0 or a positive number")
