"""From what ROS says to what a policy sees, and back: pure functions, without ROS.

Meters and radians, x forward, y to the left, angles counterclockwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Scan:
    """What counts of a sensor_msgs/LaserScan."""

    ranges: Floats
    """[N] m."""
    angle_min: float
    """Direction of the first beam in the sensor's frame, rad."""
    angle_increment: float
    """rad; negative for a sensor that turns clockwise."""
    range_min: float
    """m; less is no reading."""
    range_max: float
    """m; more is no reading."""


@dataclass(frozen=True)
class Mount:
    """Where the sensor sits on the robot."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    upside_down: bool = False
    """Its z axis points to the ground, which exchanges left and right."""


LEAST_COVERED = 0.25
"""Share of the directions of a policy that a scan must cover: about 90 degrees."""


def scan_to_sectors(
    scan: Scan, beam_angles: Floats, max_range: float, *, mount: Mount, unseen: float
) -> Floats:
    """The nearest return in each of the directions of a policy.

    Each beam covers half the gap to its neighbors at both sides, or half of that between the
    policy's directions if that is more; so no return is lost, and none lies between two sectors.

    Args:
        scan: of any number of beams in any order. Infinite, NaN, below `range_min` and beyond
            `range_max` is "nothing there", but for minus infinity, "too close to measure"
            (REP 117), which is read as `range_min`.
        beam_angles: [R] directions of the policy, evenly spaced, rad from the robot's heading.
        max_range: reading where nothing is hit, m.
        mount: where the sensor sits.
        unseen: reading of directions that no beam of the scan covers, m.

    Returns:
        [R] ranges from the center of the robot, m.

    Raises:
        ValueError: no beam returned anything: the sensor is covered, blind or off; or where its
            beams point is unknown, or they cover less than `LEAST_COVERED` of the directions.
    """
    readings = np.asarray(scan.ranges, np.float64)
    readings = np.where(np.isneginf(readings), scan.range_min, readings)
    places = (scan.angle_min, scan.angle_increment, mount.x, mount.y, mount.yaw)
    if not all(map(math.isfinite, places)):
        raise ValueError("the angles of the scan or the place of its sensor are not finite")
    if scan.angle_increment == 0 and len(readings) > 1:
        raise ValueError(f"all {len(readings)} beams of the scan point the same way")
    directions = scan.angle_min + scan.angle_increment * np.arange(len(readings))
    directions = mount.yaw + (-directions if mount.upside_down else directions)
    # NaN is neither; an infinite `range_max` makes no infinite reading a return.
    hit = (readings >= scan.range_min) & (readings <= scan.range_max) & np.isfinite(readings)
    if not hit.any():
        raise ValueError(f"none of the {len(readings)} beams of the scan returned anything")
    half = max(abs(scan.angle_increment), abs(beam_angles[1] - beam_angles[0])) / 2
    covered = _within(directions, beam_angles, half).any(axis=0)
    if covered.mean() < LEAST_COVERED:
        raise ValueError(f"the scan covers {covered.sum()} of the {covered.size} directions only")
    x = mount.x + readings[hit] * np.cos(directions[hit])
    y = mount.y + readings[hit] * np.sin(directions[hit])
    inside = _within(np.arctan2(y, x), beam_angles, half)
    nearest = np.where(inside, np.hypot(x, y)[:, None], np.inf).min(axis=0)
    nothing = np.where(covered, max_range, unseen)
    return np.minimum(np.where(np.isfinite(nearest), nearest, nothing), max_range)


def _within(angles: Floats, centers: Floats, half: float) -> NDArray[np.bool_]:
    """[N, R] whether each angle lies within `half` of each center, around the circle."""
    return np.abs(wrap_angle(angles[:, None] - centers[None])) <= half + 1e-6


def wrap_angle(angle: Floats) -> Floats:
    """Folded into [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def thickened(ranges: Floats, beam_angles: Floats, margin: float, max_range: float) -> Floats:
    """Ranges as if everything that was hit were thicker by a margin.

    So a wide robot shows a policy what the slim one of its training would see. `sqn_jax.env` has
    the same in `scan_margin.py`.

    Args:
        ranges: [R] m, `max_range` where nothing is hit.
        beam_angles: [R] rad.
        margin: m, by which the body is wider.
        max_range: m.

    Returns:
        [R] m, 0 where a hit in that direction is nearer than the margin.
    """
    turns = beam_angles[:, None] - beam_angles[None]
    ahead, aside = ranges * np.cos(turns), ranges * np.sin(turns)
    meets = (np.abs(aside) < margin) & (ahead > 1e-6) & (ranges < max_range)
    entries = ahead - np.sqrt(np.maximum(margin**2 - aside**2, 0.0))
    nearest = np.where(meets, np.maximum(entries, 0.0), max_range).min(axis=1)
    return np.minimum(nearest, ranges)


def is_blocked(
    ranges: Floats,
    beam_angles: Floats,
    travel: float,
    *,
    radius: float,
    reach: float,
    max_range: float,
) -> bool:
    """Whether a straight move would bring the robot's center within reach of what was hit.

    As `bumper.py` of `sqn_jax.env`: along a wall that is nearer already, but beside the robot, it
    may go on, and from what is nearer than its body it may drive away.

    Args:
        ranges: [R] m, `max_range` where nothing is hit.
        beam_angles: [R] rad.
        travel: m, negative for a move backward.
        radius: m, of the body; nearer readings are no place that it goes along.
        reach: m, from the center, the radius included.
        max_range: m.
    """
    ahead, aside = ranges * np.cos(beam_angles), ranges * np.sin(beam_angles)
    beyond = ahead - np.clip(ahead, min(travel, 0.0), max(travel, 0.0))
    nearest, is_hit = np.hypot(beyond, aside), ranges < max_range
    is_approached = is_hit & (nearest < ranges - 1e-3)
    is_beside = is_hit & (ranges >= radius) & (np.abs(aside) > 0.9 * np.abs(ahead))
    for is_there in (aside > -0.02, aside < 0.02):
        then = nearest[is_approached & is_there].min(initial=np.inf)
        now = ranges[is_beside & is_there].min(initial=np.inf)
        if then < reach and then < now - 1e-3:
            return True
    return False


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Heading of a quaternion, rad."""
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def is_upside_down(x: float, y: float, z: float, w: float) -> bool:
    """Whether a quaternion turns the z axis to the ground."""
    return 1 - 2 * (x * x + y * y) < 0


def goal_in_robot_frame(
    pose: tuple[float, float, float], goal: tuple[float, float]
) -> tuple[float, float]:
    """Distance m and heading rad in [-pi, pi) of a goal [x, y] from a pose [x, y, yaw]."""
    away_x, away_y = goal[0] - pose[0], goal[1] - pose[1]
    heading = (math.atan2(away_y, away_x) - pose[2] + math.pi) % (2 * math.pi) - math.pi
    return math.hypot(away_x, away_y), heading


def limited(
    command: tuple[float, float], max_speed: float, max_turn_rate: float
) -> tuple[float, float]:
    """A command [m/s, rad/s] within the caps; both parts shrink alike, so its arc stays.

    Raises:
        ValueError: the command is not finite.
    """
    if not all(map(math.isfinite, command)):
        raise ValueError(f"the command is {command}, expected finite numbers")
    excess = max(abs(command[0]) / max_speed, abs(command[1]) / max_turn_rate, 1.0)
    return command[0] / excess, command[1] / excess
