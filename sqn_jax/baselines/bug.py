"""A classical navigator without a map: heads for the goal and follows walls that are in the way.

It knows what an agent knows, the range readings and the goal's distance and heading of each
observation, and remembers what it has commanded. In the manner of the tangent bug it does one of
three things:

- go: head for the goal, or at the nearer end of the obstacle in the way, as long as that brings
  it closer;
- follow: when every direction leads away from the goal, keep the obstacle at one hand;
- cross: when a place in sight is nearer to the goal than any seen so far, leave the wall for it.

A crossing needs a place nearer by `PROGRESS` than all before. A robot that comes to the same pose
again while following a wall runs in a circle: it goes into the open and takes the other hand.
Angles are relative to the robot's heading, positive to the left, unless said otherwise. All is for
one robot, in JAX: an episode runs in a compiled program, as that of a network.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import NDArray

from sqn_jax.config import EnvConfig
from sqn_jax.env.arithmetic import larger, smaller
from sqn_jax.env.geometry import beam_angles, decode_goal, farthest_shown, wrap_angle
from sqn_jax.env.navigation import BACKWARD, FORWARD, LEFT, RIGHT, STAND
from sqn_jax.env.params import Observation

GO, FOLLOW, CROSS = range(3)
"""What the robot does, see above."""
FINENESS = 3
"""Directions looked at for each turn of one step."""
SIDE_CLEARANCE = 0.06
"""Clearance from obstacles, m, at each side."""
WALL_CLEARANCE = 0.2
"""The same while following a wall: narrower notches are passed by, the robot could not turn."""
STEADY = 0.75
"""Turns that a heading may be off before it is corrected; half a turn cannot be helped."""
FRONT_CLEARANCE = 0.05
"""m of free space beyond the end of a move."""
GRAZING = 0.35
"""A point farther aside than this, cosine, is passed and not met, however near it is."""
HUG = 0.45
"""m that must be free ahead while following a wall; less keeps nearer to it."""
RETURN = math.radians(50)
"""Directions this near to straight back are the last choice while following a wall."""
EDGE = 0.7
"""m that a gap must be deeper than the obstacle beside it."""
PROGRESS = 0.3
"""m by which a place must be nearer to the goal than all before to leave a wall for it."""
CLOSE_UP = 1.0
"""m; with no end of the obstacle in reach, the robot moves up to it while that brings as much."""
WALL_WINDOW = math.radians(50)
"""How far the nearest point of a followed wall may move round the robot in a step."""
CROSSING_STEPS = 40
"""Moves after which a place that was headed for is given up."""
SAME_PLACE = 0.1
BREAK_OUT = 2.5
"""m; how places are rounded to notice a circle, and how far the robot then goes into the open."""


@struct.dataclass
class BugMemory:
    """What a robot remembers. Places, [2] m, are in the frame of the start, by dead reckoning."""

    goal_radius: Array
    """m, of the task."""
    turned: Array
    """int32: turns since the start, to the left less those to the right."""
    place: Array
    """Where it is."""
    goal: Array
    """NaN before the first observation."""
    mode: Array
    """int32: `GO`, `FOLLOW` or `CROSS`."""
    hand: Array
    """int32: 1, obstacles are passed on their left, the wall stays at the right; or -1."""
    wall: Array
    """rad, where the nearest point of the wall is seen."""
    nearest: Array
    """m, least distance to the goal of any place reached or in sight."""
    crossing_to: Array
    """The place that a crossing leads to."""
    crossing_left: Array
    """int32: moves after which it is given up."""
    last_heading: Array
    """rad from the first heading: that of the last move."""
    visited: Array
    """[T, 2] int32: poses while following, rounded."""
    num_visited: Array
    """int32: how many of them count."""
    turns_left: Array
    """int32: turns still to make before the next decision, to the left if above 0."""
    then_forward: Array
    """bool: whether a move belongs to them."""


@dataclass(frozen=True)
class Bug:
    """The wall follower for a robot with this body, these beams and these actions."""

    config: EnvConfig

    def __post_init__(self) -> None:
        if self.turn <= 0 or self.stride <= 0:
            raise ValueError(
                "the robot cannot move or turn, expected speeds above 0 (or --no-baselines)"
            )

    @property
    def turn(self) -> float:
        """rad a step."""
        return self.config.turn_rate * self.config.time_step

    @property
    def stride(self) -> float:
        """m, forward in one step."""
        return self.config.forward_speed * self.config.time_step

    def _can_move(self, clear: Array) -> Array:
        """Where so many m are clear for a move."""
        return clear >= self.stride + FRONT_CLEARANCE

    @property
    def num_directions(self) -> int:
        """Directions looked at, D."""
        return max(4, round(2 * math.pi / self.turn)) * FINENESS

    @cached_property
    def beams(self) -> NDArray[np.float64]:
        """[R] rad."""
        return beam_angles(self.config)

    @cached_property
    def directions(self) -> NDArray[np.float32]:
        """[D] rad, from the heading to the left."""
        numbers = np.arange(self.num_directions)
        return (2 * math.pi / self.num_directions * numbers).astype(np.float32)

    def start(self, max_steps: int, goal_radius: Array) -> BugMemory:
        """The memory at the start of an episode of at most so many steps."""
        return BugMemory(
            goal_radius=goal_radius,
            turned=jnp.int32(0),
            place=jnp.zeros(2),
            goal=jnp.full(2, jnp.nan),
            mode=jnp.int32(GO),
            hand=jnp.int32(1),
            wall=jnp.float32(0),
            nearest=jnp.float32(jnp.inf),
            crossing_to=jnp.zeros(2),
            crossing_left=jnp.int32(0),
            last_heading=jnp.float32(math.pi),
            visited=jnp.zeros((max_steps, 2), jnp.int32),
            num_visited=jnp.int32(0),
            turns_left=jnp.int32(0),
            then_forward=jnp.bool_(False),
        )

    def clear_lengths(self, readings: Array, side_clearance: float = SIDE_CLEARANCE) -> Array:
        """How far [D] m the robot could move in each direction by readings [R] m.

        Args:
            readings: what the beams show, m.
            side_clearance: m to keep from obstacles at each side.
        """
        apart = self.beams[None] - self.directions[:, None]
        width = self.config.robot_radius + side_clearance
        away = jnp.asarray(readings, jnp.float32)[None]
        ahead = away * np.cos(apart).astype(np.float32)
        aside = away * np.sin(apart).astype(np.float32)
        # A direction between two beams, and straight behind, is judged by the nearest beam.
        nearest = np.abs(wrap_angle(apart)).min(axis=1)
        gap = np.sin(nearest + 1e-3).astype(np.float32)[:, None]
        hit = (
            (jnp.abs(aside) < larger(away * gap, width))
            & (ahead > GRAZING * away)
            & (away < self.config.max_range * 0.999)
        )
        reach = ahead - jnp.sqrt(larger(width**2 - aside**2, 0.0))
        return jnp.where(hit, larger(reach, 0.0), self.config.max_range).min(axis=1)

    def act(self, memory: BugMemory, obs: Observation) -> tuple[BugMemory, Array]:
        """One action from what is seen."""
        readings = obs.ranges * self.config.max_range
        clear = self.clear_lengths(readings)
        memory, distance, bearing = self._locate_goal(memory, obs.goal)
        is_due = (memory.turns_left == 0) & ~(memory.then_forward & self._can_move(clear[0]))
        decided, direction = self._decide(memory, readings, clear, distance, bearing)
        to_left = direction <= self.num_directions // 2
        signed = jnp.where(to_left, direction, direction - self.num_directions)
        decided = replace(decided, turns_left=jnp.round(signed / FINENESS).astype(jnp.int32))
        memory = _choose(is_due, decided, memory)
        return self._move(memory, clear)

    def _move(self, memory: BugMemory, clear: Array) -> tuple[BugMemory, Array]:
        """Turn, or move where nothing is left to turn; back out if no direction is clear."""
        sign = jnp.sign(memory.turns_left)
        heading = memory.turned * self.turn
        reverse = self.config.backward_speed * self.config.time_step
        can_move = self._can_move(clear[0])
        can_reverse = clear[self.num_directions // 2] >= reverse + FRONT_CLEARANCE
        length = jnp.where(can_move, self.stride, jnp.where(can_reverse, -reverse, 0.0))
        moved = replace(
            memory,
            then_forward=jnp.bool_(False),
            place=memory.place + _vector(length, heading),
            last_heading=jnp.where(can_move, heading, memory.last_heading),
        )
        turned = replace(
            memory,
            # The move belongs to the turn: without it two choices could alternate on the spot.
            then_forward=jnp.bool_(True),
            turns_left=memory.turns_left - sign,
            turned=memory.turned + sign,
            wall=memory.wall - sign * self.turn,
        )
        move = jnp.where(can_move, FORWARD, jnp.where(can_reverse, BACKWARD, STAND))
        action = jnp.where(sign > 0, LEFT, jnp.where(sign < 0, RIGHT, move))
        return _choose(sign != 0, turned, moved), action

    def _locate_goal(self, memory: BugMemory, goal: Array) -> tuple[BugMemory, Array, Array]:
        """Note where the goal is; beyond the largest distance that is shown, by its bearings.

        Returns:
            The memory, and the goal's distance, m, and bearing, rad.
        """
        shown = farthest_shown(self.config)
        distance, bearing = decode_goal(goal, self.config)
        ray = _vector(jnp.float32(1), memory.turned * self.turn + bearing)
        if math.isfinite(shown):
            unknown = jnp.isnan(memory.goal)
            guess = jnp.where(unknown, memory.place + 1.2 * shown * ray, memory.goal)
            far = larger(jnp.dot(guess - memory.place, ray), shown)
            distance = jnp.where(distance >= shown * (1 - 1e-6), far, distance)
        nearest = smaller(memory.nearest, distance)
        place = memory.place + distance * ray
        return replace(memory, goal=place, nearest=nearest), distance, bearing

    def _decide(
        self, memory: BugMemory, readings: Array, clear: Array, distance: Array, bearing: Array
    ) -> tuple[BugMemory, Array]:
        """The number of the direction to move in."""
        apart = self.directions - bearing
        length = jnp.clip(distance * jnp.cos(apart), 0, clear)
        left = jnp.hypot(distance - length * jnp.cos(apart), length * jnp.sin(apart))
        best, least = jnp.argmin(left), left.min()
        ahead = jnp.round(bearing / (2 * jnp.pi) * self.num_directions).astype(jnp.int32)
        ahead = ahead % self.num_directions
        sees_goal = clear[ahead] > distance - memory.goal_radius / 2
        passes = distance * jnp.abs(jnp.sin(bearing)) < memory.goal_radius * 0.7
        straight = sees_goal & passes & (jnp.abs(bearing) < jnp.pi / 4) & self._can_move(clear[0])

        leaves = (memory.mode == FOLLOW) & (least < memory.nearest - PROGRESS)
        memory_on, onward, is_crossing = self._cross(
            _choose(leaves, self._crossing(memory, length[best], best), memory)
        )
        hand, edge, has_edge = self._nearer_edge(memory_on.hand, clear, ahead, distance, bearing)
        goes = memory_on.mode == GO
        by_edge = goes & has_edge & (left[edge] < distance - PROGRESS / 2)
        closes_up = goes & ~by_edge & (least < distance - CLOSE_UP)
        memory_on = replace(memory_on, hand=jnp.where(goes, hand, memory_on.hand))
        begins = replace(
            memory_on,
            mode=jnp.int32(FOLLOW),
            wall=bearing,
            num_visited=jnp.int32(0),
            nearest=smaller(memory.nearest, least),
        )
        follows = ~(is_crossing | by_edge | closes_up)
        memory_on = _choose(goes & follows, begins, memory_on)
        along, by_wall, broken_out, out = self._along_wall(memory_on, readings, clear)
        memory_on = _choose(follows, along, memory_on)

        target = jnp.where(follows, out, jnp.where(by_edge, edge, best))
        aim = jnp.where(is_crossing, onward, jnp.asarray(self.directions)[target])
        toward = self._toward(jnp.where(sees_goal, bearing, aim), clear)
        direction = jnp.where(follows & ~broken_out & ~sees_goal, by_wall, toward)
        memory = _choose(sees_goal, replace(memory, mode=jnp.int32(GO)), memory_on)
        return memory, jnp.where(straight, 0, direction)

    def _crossing(self, memory: BugMemory, length: Array, direction: Array) -> BugMemory:
        """Begin to cross to a place so far away, m, in a direction, by its number."""
        angle = memory.turned * self.turn + jnp.asarray(self.directions)[direction]
        return replace(
            memory,
            mode=jnp.int32(CROSS),
            crossing_to=memory.place + _vector(length, angle),
            crossing_left=jnp.int32(CROSSING_STEPS),
        )

    def _cross(self, memory: BugMemory) -> tuple[BugMemory, Array, Array]:
        """Go on crossing: where it leads, rad, and whether it does; else the robot goes again."""
        offset = memory.crossing_to - memory.place
        is_crossing = memory.mode == CROSS
        left = memory.crossing_left - is_crossing
        goes_on = is_crossing & (jnp.hypot(offset[0], offset[1]) > self.stride) & (left > 0)
        mode = jnp.where(is_crossing & ~goes_on, GO, memory.mode)
        onward = jnp.arctan2(offset[1], offset[0]) - memory.turned * self.turn
        return replace(memory, mode=mode, crossing_left=left), onward, goes_on

    def _nearer_edge(
        self, hand: Array, clear: Array, ahead: Array, distance: Array, bearing: Array
    ) -> tuple[Array, Array, Array]:
        """On which hand the obstacle ahead is passed on the shorter path.

        The path leads beside the obstacle's end and from there straight to the goal; the hand of
        before has an advantage, so that small changes do not reverse it.

        Returns:
            The hand, the number of the direction there, and whether there is any.
        """
        numbers = np.arange(1, self.num_directions // 2)
        costs, edges = [], []
        for side in (1, -1):
            beside = (ahead + side * (numbers - 1)) % self.num_directions
            beyond = (ahead + side * numbers) % self.num_directions
            deeper = clear[beyond] >= smaller(clear[beside] + EDGE, self.config.max_range)
            first = jnp.argmax(deeper)
            to_edge, edge = clear[beside[first]], beyond[first]
            angle = jnp.asarray(self.directions)[edge] - bearing
            rest = jnp.hypot(distance - to_edge * jnp.cos(angle), to_edge * jnp.sin(angle))
            cost = to_edge + rest + jnp.where(hand == side, 0.0, EDGE)
            costs.append(jnp.where(deeper.any(), cost, jnp.inf))
            edges.append(edge)
        first_is_best = costs[0] <= costs[1]
        has_edge = smaller(*costs) < jnp.inf
        edge = jnp.where(first_is_best, edges[0], edges[1])
        return jnp.where(has_edge, jnp.where(first_is_best, 1, -1), hand), edge, has_edge

    def _along_wall(
        self, memory: BugMemory, readings: Array, clear: Array
    ) -> tuple[BugMemory, Array, Array, Array]:
        """Follow the wall, or break out of a circle.

        Returns:
            The memory; the number of the direction nearest to the wall that is clear, counted away
            from it; whether the robot breaks out instead; and then in which direction.
        """
        memory, was_here = self._note_pose(memory)
        heading = memory.turned * self.turn
        onward = jnp.cos(self.directions + heading - memory.last_heading)
        out = jnp.argmax(clear + 0.1 * onward)
        # Out of a circle, mostly a bay too small to turn in, to the open; then the other hand.
        breaks_out = self._crossing(memory, smaller(clear[out], BREAK_OUT), out)
        breaks_out = replace(breaks_out, num_visited=jnp.int32(0), hand=-memory.hand)

        near = jnp.abs(wrap_angle(self.beams.astype(np.float32) - memory.wall)) <= WALL_WINDOW
        nearest = jnp.argmin(jnp.where(near, readings, jnp.inf))
        seen = jnp.asarray(self.beams, jnp.float32)[nearest]
        wall = jnp.where(near.any(), seen, memory.wall)
        first = jnp.round(wall / self.turn).astype(jnp.int32)
        outward = np.arange(self.num_directions // FINENESS)
        headings = (first + memory.hand * outward) * FINENESS % self.num_directions
        is_onward = (onward > math.cos(math.pi - RETURN))[headings]
        # In a notch the nearest wall may be the one left behind: back only if nothing else is.
        roomy = self.clear_lengths(readings, WALL_CLEARANCE)[headings] >= HUG
        narrow, choice = self._can_move(clear[headings]), jnp.argmax(clear[headings])
        for free in (narrow, narrow & is_onward, roomy & is_onward):
            choice = jnp.where(free.any(), jnp.argmax(free), choice)
        memory = _choose(was_here, breaks_out, replace(memory, wall=wall))
        return memory, headings[choice], was_here, out

    def _note_pose(self, memory: BugMemory) -> tuple[BugMemory, Array]:
        """Whether the robot runs in a circle: this pose comes a second time on this wall."""
        x, y = jnp.round(memory.place / SAME_PLACE).astype(jnp.int32)
        heading = memory.turned % (self.num_directions // FINENESS)
        pose = jnp.stack([(x << 16) + y, 2 * heading + (memory.hand > 0)])
        counted = jnp.arange(len(memory.visited)) < memory.num_visited
        known = ((memory.visited == pose[None]).all(axis=1) & counted).any()
        visited = memory.visited.at[memory.num_visited].set(pose)
        return replace(memory, visited=visited, num_visited=memory.num_visited + 1), known

    def _toward(self, direction: Array, clear: Array) -> Array:
        """The number of the heading that is clear and nearest to a direction, the present first."""
        steady = jnp.abs(wrap_angle(direction)) < STEADY * self.turn
        headings = np.arange(0, self.num_directions, FINENESS)
        apart = jnp.abs(wrap_angle(self.directions[headings] - direction))
        apart = apart + jnp.where(self._can_move(clear[headings]), 0.0, 2 * jnp.pi)
        nearest = jnp.argmin(apart) * FINENESS
        return jnp.where(steady & self._can_move(clear[0]), 0, nearest)


def _vector(length: Array, angle: Array) -> Array:
    """[2] of this length, m, in this direction."""
    return length * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _choose(condition: Array, one: BugMemory, other: BugMemory) -> BugMemory:
    """One memory or the other."""
    chosen: BugMemory = jax.tree.map(lambda x, y: jnp.where(condition, x, y), one, other)
    return chosen
