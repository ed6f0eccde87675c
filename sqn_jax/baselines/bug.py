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
Angles are relative to the robot's heading, positive to the left, unless said otherwise.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
from numpy.typing import NDArray

from sqn_jax.config import EnvConfig
from sqn_jax.env.geometry import beam_angles, decode_distance, farthest_shown, wrap_angle
from sqn_jax.env.navigation import BACKWARD, FORWARD, LEFT, RIGHT, STAND

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

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class BugNavigator:
    """Chooses actions for E robots, each with its own memory."""

    def __init__(self, config: EnvConfig, num_robots: int) -> None:
        """Start E episodes of a robot with this body, these beams and these actions."""
        self.config = config
        self.beams = beam_angles(config)
        turn = config.turn_rate * config.time_step
        if turn <= 0 or config.forward_speed * config.time_step <= 0:
            raise ValueError("the robot cannot move or turn, expected speeds above 0")
        count = max(4, round(2 * math.pi / turn)) * FINENESS
        self.directions = 2 * math.pi / count * np.arange(count)
        apart = self.beams[None] - self.directions[:, None]
        self._ahead = np.cos(apart).astype(np.float32)
        self._aside = np.sin(apart).astype(np.float32)
        # A direction between two beams, and straight behind, is judged by the nearest beam.
        nearest = np.abs(wrap_angle(apart)).min(axis=1)
        self._gap = np.sin(nearest + 1e-3).astype(np.float32)[:, None]
        self.robots = [_Robot(self) for _ in range(num_robots)]

    def choose(self, ranges: Floats, goal: Floats) -> Ints:
        """Actions [E] from the observed ranges [E, R] and goals [E, 2 or 3], all in 0..1."""
        readings = ranges * self.config.max_range
        clear = self.clear_lengths(readings)
        distance = decode_distance(goal[:, 0], self.config)
        if self.config.heading_encoding == "linear":
            heading = goal[:, 1] * 2 * np.pi - np.pi
        else:
            heading = np.arctan2(goal[:, 1] * 2 - 1, goal[:, 2] * 2 - 1)
        seen = zip(self.robots, readings, clear, distance, heading, strict=True)
        return np.array([robot.choose(*what) for robot, *what in seen])

    def clear_lengths(self, readings: Floats, side_clearance: float = SIDE_CLEARANCE) -> Floats:
        """How far [E, D] m robots could move in each direction by readings [E, R] m.

        Args:
            readings: what the beams show, m.
            side_clearance: m to keep from obstacles at each side.
        """
        width = self.config.robot_radius + side_clearance
        away = readings.astype(np.float32)[:, None]
        ahead, aside = away * self._ahead, away * self._aside
        hit = (
            (np.abs(aside) < np.maximum(width, away * self._gap))
            & (ahead > GRAZING * away)
            & (away < self.config.max_range * 0.999)
        )
        reach = ahead - np.sqrt(np.maximum(width**2 - aside**2, 0))
        return np.where(hit, np.maximum(reach, 0), self.config.max_range).min(axis=-1)


class _Robot:
    """The memory and the decisions of one robot."""

    def __init__(self, bug: BugNavigator) -> None:
        config = bug.config
        self.bug = bug
        self.count = len(bug.directions)
        self.spacing = 2 * math.pi / self.count
        self.turn = config.turn_rate * config.time_step
        self.stride = config.forward_speed * config.time_step
        self.reverse = config.backward_speed * config.time_step
        self.needed = self.stride + FRONT_CLEARANCE
        # Dead reckoning from commands; complex numbers are places, in the frame of the start.
        self.heading, self.place = 0.0, 0j
        self.goal: complex | None = None
        self.mode = "go"
        self.hand = 1  # +1: obstacles are passed on their left, the wall stays at the right
        self.wall = 0.0  # where the nearest point of the wall is seen
        self.nearest = math.inf  # least distance to the goal of any place reached or in sight
        self.crossing_to, self.crossing_left = 0j, 0
        self.last_heading = math.pi  # heading of the last move
        self.visited: set[tuple[int, ...]] = set()  # poses while following, rounded
        self.turns_left, self.then_forward = 0, False

    def choose(self, readings: Floats, clear: Floats, distance: float, heading: float) -> int:
        """One action from readings [R] m, clear lengths [D] m and where the goal is, m and rad."""
        self._locate_goal(distance, heading)
        if not self.turns_left and not (self.then_forward and clear[0] >= self.needed):
            direction = self._decide(readings, clear)
            self.turns_left = round(math.remainder(direction, 2 * math.pi) / self.turn)
        if self.turns_left:
            # The move belongs to the turn: without it two choices could alternate on the spot.
            self.then_forward = True
            sign = 1 if self.turns_left > 0 else -1
            self.turns_left -= sign
            self.heading += sign * self.turn
            self.wall -= sign * self.turn
            return LEFT if sign > 0 else RIGHT
        self.then_forward = False
        if clear[0] < self.needed:
            return self._escape(clear)
        self.place += cmath.rect(self.stride, self.heading)
        self.last_heading = self.heading
        return FORWARD

    def _escape(self, clear: Floats) -> int:
        """What is left when no direction is clear enough to move."""
        if clear[self.count // 2] >= self.reverse + FRONT_CLEARANCE:
            self.place -= cmath.rect(self.reverse, self.heading)
            return BACKWARD
        return STAND

    def _locate_goal(self, distance: float, heading: float) -> None:
        """Note where the goal is; beyond the largest distance that is shown, by its bearings."""
        ray = cmath.rect(1.0, self.heading + heading)
        shown = farthest_shown(self.bug.config)
        if distance >= shown * (1 - 1e-6):
            guess = self.place + 1.2 * shown * ray if self.goal is None else self.goal
            distance = max(shown, ((guess - self.place) * ray.conjugate()).real)
        self.goal = self.place + distance * ray
        self.distance, self.bearing = distance, heading
        self.nearest = min(self.nearest, distance)

    def _decide(self, readings: Floats, clear: Floats) -> float:
        """The direction to move in."""
        onward = np.cos(self.bug.directions - self.bearing)
        length = np.clip(self.distance * onward, 0, clear)
        left = np.sqrt(self.distance**2 - 2 * self.distance * length * onward + length**2)
        ahead = self._index(self.bearing)
        if clear[ahead] > self.distance - self.bug.config.goal_radius / 2:
            self.mode = "go"
            passes = self.distance * abs(math.sin(self.bearing)) < self.bug.config.goal_radius * 0.7
            straight = passes and abs(self.bearing) < math.pi / 4 and clear[0] >= self.needed
            return 0.0 if straight else self._toward(self.bearing, clear)
        if self.mode == "follow" and left.min() < self.nearest - PROGRESS:
            best = int(left.argmin())
            direction = self.heading + float(self.bug.directions[best])
            self.crossing_to = self.place + cmath.rect(float(length[best]), direction)
            self.crossing_left, self.mode = CROSSING_STEPS, "cross"
        if self.mode == "cross":
            offset = self.crossing_to - self.place
            self.crossing_left -= 1
            if abs(offset) > self.stride and self.crossing_left > 0:
                return self._toward(cmath.phase(offset) - self.heading, clear)
            self.mode = "go"
        if self.mode == "go":
            hand, edge = self._nearer_edge(clear, ahead)
            self.hand = hand
            if edge is not None and left[edge] < self.distance - PROGRESS / 2:
                return self._toward(float(self.bug.directions[edge]), clear)
            best = int(left.argmin())
            if left[best] < self.distance - CLOSE_UP:
                return self._toward(float(self.bug.directions[best]), clear)
            self.mode, self.wall = "follow", self.bearing
            self.visited.clear()
            self.nearest = min(self.nearest, float(left.min()))
        return self._along_wall(readings, clear)

    def _nearer_edge(self, clear: Floats, ahead: int) -> tuple[int, int | None]:
        """On which hand the obstacle ahead is passed on the shorter path, and the direction there.

        The path leads beside the obstacle's end and from there straight to the goal; the hand of
        before has an advantage, so that small changes do not reverse it.
        """
        best = math.inf
        choice: tuple[int, int | None] = (self.hand, None)
        for hand in (1, -1):
            for k in range(1, self.count // 2):
                beside, beyond = (ahead + hand * (k - 1)) % self.count, (ahead + hand * k)
                beyond %= self.count
                if clear[beyond] < min(clear[beside] + EDGE, self.bug.config.max_range):
                    continue
                to_edge = float(clear[beside])
                angle = float(self.bug.directions[beyond]) - self.bearing
                rest = abs(self.distance - cmath.rect(to_edge, angle))
                cost = to_edge + rest + (EDGE if hand != self.hand else 0.0)
                if cost < best:
                    best, choice = cost, (hand, beyond)
                break
        return choice

    def _along_wall(self, readings: Floats, clear: Floats) -> float:
        """The direction nearest to the followed wall that is clear, counted away from it."""
        if self._was_here():
            return self._break_out(clear)
        apart = wrap_angle(self.bug.beams - self.wall)
        near = np.flatnonzero(np.abs(apart) <= WALL_WINDOW)
        if near.size:
            self.wall = float(self.bug.beams[near[readings[near].argmin()]])
        first = round(self.wall / self.turn)
        headings = (first + self.hand * np.arange(self.count // FINENESS)) * FINENESS % self.count
        wide = self.bug.clear_lengths(readings[None], WALL_CLEARANCE)[0]
        turned = self.bug.directions[headings] + self.heading - self.last_heading
        onward = np.cos(turned) > math.cos(math.pi - RETURN)
        # In a notch the nearest wall may be the one left behind: back only if nothing else is.
        roomy, narrow = wide[headings] >= HUG, clear[headings] >= self.needed
        for free in (roomy & onward, narrow & onward, narrow):
            if free.any():
                return float(self.bug.directions[headings[free.argmax()]])
        return float(self.bug.directions[headings[clear[headings].argmax()]])

    def _was_here(self) -> bool:
        """Whether the robot runs in a circle: this pose comes a second time on this wall."""
        turns = round(self.heading / self.turn) % (self.count // FINENESS)
        x, y = round(self.place.real / SAME_PLACE), round(self.place.imag / SAME_PLACE)
        pose = (x, y, turns, self.hand)
        known = pose in self.visited
        self.visited.add(pose)
        return known

    def _break_out(self, clear: Floats) -> float:
        """Leave a circle, mostly a bay too small to turn in, to the open; then the other hand."""
        self.visited.clear()
        self.hand, self.mode, self.crossing_left = -self.hand, "cross", CROSSING_STEPS
        onward = np.cos(self.bug.directions + self.heading - self.last_heading)
        best = int((clear + 0.1 * onward).argmax())
        direction = float(self.bug.directions[best])
        length = min(float(clear[best]), BREAK_OUT)
        self.crossing_to = self.place + cmath.rect(length, self.heading + direction)
        return self._toward(direction, clear)

    def _toward(self, direction: float, clear: Floats) -> float:
        """The heading that is clear and nearest to a direction, the present one preferred."""
        if abs(wrap_angle(direction)) < STEADY * self.turn and clear[0] >= self.needed:
            return 0.0
        headings = np.arange(0, self.count, FINENESS)
        apart = np.abs(wrap_angle(self.bug.directions[headings] - direction))
        apart = apart + np.where(clear[headings] >= self.needed, 0.0, 2 * np.pi)
        return float(self.bug.directions[headings[apart.argmin()]])

    def _index(self, angle: float) -> int:
        return round(angle / self.spacing) % self.count
