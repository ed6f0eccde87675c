"""What happened to N robots over T steps: the one record that learning, statistics and pictures
share.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
from flax import struct

LEARNING = ("obs", "actions", "rewards", "terminated", "carry")
"""The fields of a `Trajectory` that learning needs."""


@struct.dataclass
class Trajectory:
    """T steps of N robots, time-major; what was left out is None.

    A whole episode, or a window of one. Either is cut after T steps, which is no end: `terminated`
    alone stops the bootstrap. Arrays of T + 1 hold what was before each step, and after the last.
    """

    obs: Any = None
    """A pytree of [T + 1, N, ...] arrays in 0..1: what the agent saw, with noise if configured."""
    actions: Any = None
    """[T, N] int32."""
    rewards: Any = None
    """[T, N] float32."""
    terminated: Any = None
    """[T, N] bool: the episode truly ended with this step."""
    carry: Any = None
    """[N, H] the network's recurrent state before the first step; zero at an episode's start."""
    poses: Any = None
    """[T + 1, N, 3] x m, y m, heading rad; the first is the start."""
    goals: Any = None
    """[N, 2] x m, y m, of the task before the first step."""
    info: Any = None
    """What `navigation.step` says of each step by name, [T, N] each: distance to the goal, refused
    moves, area newly covered, parts of the reward."""
    output: Any = None
    """`QOutput` [T, N, ...] by which the actions were chosen."""
    covered: Any = None
    """[T + 1, N, ...] uint32, the points seen so far, a bit each; see `env.coverage.Lattice`."""

    def only(self, *fields: str) -> Trajectory:
        """The same with these fields alone."""
        return Trajectory(**{name: getattr(self, name) for name in fields})

    def for_learning(self) -> Trajectory:
        """The same without what learning does not need."""
        return self.only(*LEARNING)

    def of_robots(self, chosen: Any) -> Trajectory:
        """Some of the robots by a slice or an array; one, without the axis of robots, by an int."""
        return over_robots(lambda x, axis: x[chosen] if axis == 0 else x[:, chosen], self)

    def first_steps(self, count: int) -> Trajectory:
        """The beginning, at most all of it."""

        def cut(name: str, length: int) -> Any:
            return jax.tree.map(lambda x: x[:length], getattr(self, name))

        in_steps = {name: cut(name, count) for name in _OF_STEPS}
        around_steps = {name: cut(name, count + 1) for name in _AROUND_STEPS}
        return dataclasses.replace(self, **in_steps, **around_steps)


_AROUND_STEPS = ("obs", "poses", "covered")
"""Fields of T + 1 moments."""
_OF_STEPS = ("actions", "rewards", "terminated", "info", "output")
"""Fields of T steps."""
_OF_ROBOTS = ("carry", "goals")
"""Fields without an axis of time."""


def over_robots(function: Callable[..., Any], *trajectories: Trajectory) -> Trajectory:
    """Apply a function to each array of one or more trajectories that hold the same fields.

    Args:
        function: called with the arrays of the same place and, as `axis`, with the number of their
            axis of robots.
        trajectories: with an axis of robots.
    """
    first, *others = trajectories
    applied = {}
    for field in dataclasses.fields(Trajectory):
        axis = 0 if field.name in _OF_ROBOTS else 1
        values = [getattr(each, field.name) for each in (first, *others)]
        applied[field.name] = jax.tree.map(lambda *x, n=axis: function(*x, axis=n), *values)
    return Trajectory(**applied)
