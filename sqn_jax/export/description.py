"""What a robot's computer must know of a policy, and which policies can be exported at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from sqn_jax import __version__
from sqn_jax import config as configs
from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig
from sqn_jax.env import ACTION_NAMES
from sqn_jax.env.geometry import beam_angles
from sqn_jax.env.prepare import commands_of
from sqn_jax.policies.run_policies import Policy

BEAM_ORDER = "from right to left; 0 is straight ahead, positive to the left"

KNOWN_SETTINGS: dict[type[EnvConfig] | type[NetworkConfig], frozenset[str]] = {
    NetworkConfig: frozenset(
        {"hidden_size", "num_skills", "layer_norm", "dqn_width_factor", "motion_inputs"}
    ),
    EnvConfig: frozenset(
        {
            # What the graph and `sqn_policy.py` act on.
            *("num_beams", "field_of_view_deg", "max_range", "max_goal_distance"),
            *("goal_distance_encoding", "goal_distance_scale"),
            *("heading_encoding", "forward_speed", "backward_speed", "turn_rate", "time_step"),
            # What a policy in use has nothing to do with, or is only described.
            *("robot_radius", "bumper", "goal_radius", "max_steps", "coverage_cell", "ray_sectors"),
            *("ray_iterations", "velocity_noise", "velocity_noise_unit", "range_noise"),
            *("range_noise_unit", "near_goal_fraction", "reward_navigation"),
            *("reward_exploration", "reward_time", "reward_collision"),
        }
    ),
}
"""The settings of which an export knows what they mean; others may only have their default."""

KNOWN_CHOICES = {
    "algo": ("sqn", "r2d2", "dqn"),
    "env.goal_distance_encoding": ("clipped", "rational"),
    "env.heading_encoding": ("linear", "sincos"),
}


def require_exportable(
    config: TrainConfig,
    *,
    verb: str = "exported",
    beyond: Mapping[str, tuple[object, ...]] = MappingProxyType({}),
) -> None:
    """Refuse by name what the exported files do not compute.

    Args:
        config: of the policy.
        verb: what it is wanted for, in the error.
        beyond: what else is computed there: settings by their names, each with the values it may
            have, or with none where it may have any.

    Raises:
        ValueError: a setting of the network or of what it sees is unknown there.
    """
    choices = {**KNOWN_CHOICES, **beyond}
    for prefix, group in (("network", config.network), ("env", config.env)):
        known = KNOWN_SETTINGS[type(group)]
        for field in dataclasses.fields(group):
            name, value = f"{prefix}.{field.name}", getattr(group, field.name)
            default = getattr(type(group)(), field.name)
            if field.name not in known and name not in choices and value != default:
                raise ValueError(
                    f"{name} is {value!r}, which cannot be {verb}, expected {default!r}"
                )
    values = configs.flat(configs.to_dict(config))
    for name, allowed in choices.items():
        if allowed and values[name] not in allowed:
            raise ValueError(
                f"{name} is {values[name]!r}, which cannot be {verb}, expected one of "
                f"{', '.join(map(str, allowed))}"
            )


def observation_size(config: TrainConfig) -> int:
    """Numbers a policy is given each step: ranges, the goal's two, and if the move was refused."""
    return config.env.num_beams + 2 + config.network.motion_inputs


def state_size(config: TrainConfig) -> int:
    """Numbers a policy hands on to the next step: its memory, and with motion inputs the action."""
    return config.network.hidden_size + len(ACTION_NAMES) * config.network.motion_inputs


def describe_robot(config: TrainConfig) -> dict[str, Any]:
    """The robot that a policy is for: what stands in `config.json` and in the ONNX file.

    Returns:
        Numbers, texts and lists of them; each name ends in its unit, where it has one.
    """
    env = config.env
    return {
        "agent": config.algo,
        "beam_angles_rad": beam_angles(env).tolist(),
        "beam_order": BEAM_ORDER,
        "max_range_m": env.max_range,
        "actions": list(ACTION_NAMES),
        "commands_m_s_rad_s": [
            [float(number) for number in command] for command in commands_of(env).tolist()
        ],
        "time_step_s": env.time_step,
        "robot_radius_m": env.robot_radius,
        "goal_radius_m": env.goal_radius,
        "goal_distance_encoding": env.goal_distance_encoding,
        "max_goal_distance_m": env.max_goal_distance,
        "goal_distance_scale_m": env.goal_distance_scale,
        "heading_encoding": env.heading_encoding,
        "motion_inputs": config.network.motion_inputs,
    }


def describe_policy(policy: Policy) -> dict[str, Any]:
    """The contents of `config.json` but for the digest: name, versions, robot, all settings."""
    return {
        "name": policy.name,
        "versions": {"sqn_jax": __version__},
        "robot": describe_robot(policy.config),
        "config": configs.to_public_dict(policy.config),
    }
