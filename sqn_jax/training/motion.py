"""What a robot knows of its own last step: an input of the network beside what the env shows.

R2D2 feeds the last action in the same way. It belongs to the agent, as its recurrent state does:
the observation of the env is the same for all agents. On a robot the action is the command that was
given last; a move counts as refused where it was commanded and odometry shows none.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.networks import HasObservation
from sqn_jax.config import NetworkConfig
from sqn_jax.env import NUM_ACTIONS, Observation
from sqn_jax.env.navigation import BACKWARD, FORWARD

MOTION_SIZE = NUM_ACTIONS + 1
"""Numbers that say what the last step was."""


@struct.dataclass
class MotionObservation(Observation):
    """An observation of the env, and the step before it."""

    motion: Array
    """[A + 1] the last action, one-hot, and 1 if it was a move that was refused, else 0; all zeros
    before the first action of a task."""


def first_observation(obs: Observation, config: NetworkConfig) -> Observation:
    """What a network sees before the first action of a task.

    Args:
        obs: of the env, [..., R] and [..., G].
        config: of the network; without `motion_inputs` it sees what the env shows.
    """
    if not config.motion_inputs:
        return obs
    motion = jnp.zeros((*obs.goal.shape[:-1], MOTION_SIZE))
    return MotionObservation(ranges=obs.ranges, goal=obs.goal, motion=motion)


def next_observation(
    seen: Observation, obs: Observation, actions: Array, refused: Array
) -> Observation:
    """What a network sees after a step, that has seen `seen` before it.

    An action is the one the robot chose. In a mirrored world it is the commands that are turned
    (`env.randomize`): the robot's left stays its left, in what it does as in what it has done.

    Args:
        seen: what it saw before; it says whether there is `motion`.
        obs: what the env shows now, [..., R] and [..., G].
        actions: [...] int32, taken in the step.
        refused: [...] bool, from `navigation.step`; those of other actions than moves, which
            only velocity noise causes and a robot cannot notice, do not count.
    """
    if not isinstance(seen, MotionObservation):
        return obs
    return with_motion(obs, jax.nn.one_hot(actions, NUM_ACTIONS), refused)


def with_motion(obs: HasObservation, last: Array, refused: Array) -> MotionObservation:
    """An observation with the step before it.

    Args:
        obs: of the env, [..., R] and [..., G].
        last: [..., A] the action of that step, one-hot, or zeros before the first.
        refused: [...] bool, whether the robot was kept from moving; only moves count.
    """
    refused_move = refused * (last[..., FORWARD] + last[..., BACKWARD])
    motion = jnp.concatenate([last, refused_move[..., None]], axis=-1)
    return MotionObservation(ranges=obs.ranges, goal=obs.goal, motion=motion)
