"""When a policy may move the robot, and what it says: a state machine without ROS.

`tick` is called often. It asks the policy once a time step, repeats the command in between, and
returns a stop with the reason whenever anything that the policy needs is missing, old or odd.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqn_navigation.conversions import (
    Mount,
    Scan,
    goal_in_robot_frame,
    is_blocked,
    limited,
    scan_to_sectors,
    thickened,
)

Pose = tuple[float, float, float]
"""x m, y m, yaw rad."""


@dataclass(frozen=True)
class Limits:
    """What the robot allows."""

    max_speed: float = 0.5
    """m/s, hard cap."""
    max_turn_rate: float = 1.0
    """rad/s, hard cap."""
    slowdown: float = 5.0
    """Speeds are divided by this, and each command holds that much longer: the same path."""
    goal_radius: float = 0.3
    """m."""
    stale_after: float = 0.3
    """s without a scan or a pose after which the robot stops."""
    unseen: float = math.inf
    """m, reading of directions that the sensor does not cover."""
    time_limit: float = 600.0
    """s, a goal that is not reached by then is given up."""
    robot_radius: float = 0.0
    """m, of a circle around the body; where it is wider than that of the training, the policy sees
    obstacles thicker by the difference. 0: as wide as in the training."""
    bumper: float = 0.05
    """m from the body; a move that would bring what the scan shows nearer is not made. 0: none."""

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ValueError(f"{name} is {value!r}, expected a number")
            if name in ("unseen", "robot_radius", "bumper"):
                if not value >= 0 or (math.isinf(value) and name != "unseen"):
                    raise ValueError(f"{name} is {value}, expected 0 or more m")
            elif not 0 < value < math.inf:
                raise ValueError(f"{name} is {value}, expected a positive number")


@dataclass(frozen=True)
class Command:
    """What the robot is to do now, and why it stands if it does."""

    speed: float = 0.0
    """m/s."""
    turn_rate: float = 0.0
    """rad/s."""
    reason: str = ""
    """Empty while it drives."""


def load_policy(folder: Path) -> Any:
    """The `Policy` of an exported folder, whose files are those that were exported.

    Raises:
        ValueError: one line naming the file that is missing or has changed.
    """
    try:
        lines = (folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines()
        digests = {line[66:]: line[:64] for line in lines}
        for name in ("sqn_policy.py", "params.safetensors", "config.json"):
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != digests.get(name):
                raise ValueError(f"{folder / name}: has changed since it was exported")
    except OSError as error:
        raise ValueError(
            f"{error.filename}: {error.strerror}, expected a folder from sqn export"
        ) from None
    spec = importlib.util.spec_from_file_location("sqn_policy", folder / "sqn_policy.py")
    if spec is None or spec.loader is None:
        raise ValueError(f"{folder}: sqn_policy.py cannot be loaded")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Policy(folder / "params.safetensors")


class Controller:
    """Drives one robot from goal to goal."""

    def __init__(self, policy: Any, limits: Limits, *, obeyed: bool = True) -> None:
        """Nothing moves before there is a goal.

        Args:
            policy: from `load_policy`.
            limits: what the robot allows.
            obeyed: whether the robot drives as it is told. In a recording it does not: a robot that
                stood then says nothing of a move that would be commanded now.
        """
        self.policy = policy
        self.obeyed = obeyed
        self.limits = limits
        self._goal: tuple[float, float] | None = None
        self._scan: Scan | None = None
        self._mount = Mount()
        self._scan_time = -math.inf
        self._ranges: Any = None
        self._hidden: Any = None
        self._decided = -math.inf
        self._began = math.inf
        self._command = Command()
        self._decided_at: Pose | None = None
        self._stopped = False
        trained = float(policy.env["robot_radius"])
        self._radius = limits.robot_radius or trained
        self._margin = max(0.0, self._radius - trained)

    @property
    def has_goal(self) -> bool:
        """Whether it is on its way."""
        return self._goal is not None

    def set_goal(self, goal: tuple[float, float] | None) -> None:
        """A new goal [x, y] m, or none: the policy forgets what it saw on the way to the last."""
        self._goal, self._hidden = goal, None
        self._decided, self._began, self._command = -math.inf, math.inf, Command()
        self._decided_at, self._stopped = None, False

    def set_scan(self, scan: Scan, mount: Mount, time: float) -> None:
        """A scan, measured at `time` s."""
        self._scan, self._mount, self._scan_time = scan, mount, time
        self._ranges = None

    def tick(self, pose: Callable[[], Pose], now: float) -> Command:
        """What the robot is to do at `now` s.

        Args:
            pose: of the robot in the frame of the goal; raises ValueError where it is unknown.
            now: s, of the same clock as the scans.
        """
        try:
            return self._drive(pose, now)
        except ValueError as error:  # What is odd is a reason to stop, and no reason to end.
            self._decided, self._decided_at = -math.inf, None
            return Command(reason=str(error))

    def _drive(self, pose: Callable[[], Pose], now: float) -> Command:
        if self._goal is None:
            return Command(reason="there is no goal")
        self._began = min(self._began, now)
        if now - self._began > self.limits.time_limit:
            self.set_goal(None)
            return Command(reason=f"the goal is given up after {self.limits.time_limit:g} s")
        age = now - self._scan_time
        if self._scan is None or not age <= self.limits.stale_after:
            raise ValueError("there is no scan" if self._scan is None else "the scan is old")
        if age < -self.limits.stale_after:  # Simulated time or a bag began anew.
            raise ValueError("the scan is from the future: the clock went back")
        here = pose()
        distance, heading = goal_in_robot_frame(here, self._goal)
        if not math.isfinite(distance + heading):
            raise ValueError("the goal or the pose is not finite")
        if distance < self.limits.goal_radius:
            self.set_goal(None)
            return Command(reason="the goal is reached")
        if self._ranges is None:  # A sensor that went blind stops a command that is held, too.
            self._ranges = self._seen(self._scan)
        if now < self._decided:  # The clock went back a little.
            self._decided_at = None
        if not 0 <= now - self._decided < self._hold:
            self._command = self._decide(distance, heading, self._is_refused(here))
            self._decided, self._decided_at = now, here
        if self._is_blocked():
            self._stopped = True
            self._command = Command(reason="the bumper stops the move")
        return self._command

    @property
    def _hold(self) -> float:
        """s that a command holds."""
        return float(self.policy.time_step) * self.limits.slowdown

    def _seen(self, scan: Scan) -> Any:
        max_range = self.policy.env["max_range"]
        return scan_to_sectors(
            scan,
            self.policy.beam_angles,
            max_range,
            mount=self._mount,
            unseen=min(self.limits.unseen, max_range),
        )

    def _is_refused(self, here: Pose) -> bool:
        """Whether the last move was stopped, or the robot made less than a tenth of it.

        A command must hold for longer than poses are late, else each move seems to be refused.
        """
        if self._decided_at is None:
            return False
        if self._stopped or not self.obeyed:
            return self._stopped
        commanded = abs(self._command.speed) * self._hold
        return math.dist(here[:2], self._decided_at[:2]) < commanded / 10

    def _is_blocked(self) -> bool:
        """Whether the scan shows what is left of the move, since it was measured, to be blocked."""
        left = max(0.0, self._hold - max(0.0, self._scan_time - self._decided))
        return self.limits.bumper > 0 and is_blocked(
            self._ranges,
            self.policy.beam_angles,
            self._command.speed * left,
            radius=self._radius,
            reach=self._radius + self.limits.bumper,
            max_range=self.policy.env["max_range"],
        )

    def _decide(self, distance: float, heading: float, refused: bool) -> Command:
        angles, ranges = self.policy.beam_angles, self._ranges
        if self._margin > 0:
            ranges = thickened(ranges, angles, self._margin, self.policy.env["max_range"])
        # Only a policy that was trained with motion inputs looks at its last move.
        more = {"refused": refused} if getattr(self.policy, "motion_size", 0) else {}
        velocity, self._hidden = self.policy.act(ranges, distance, heading, self._hidden, **more)
        self._stopped = False
        slow = (velocity[0] / self.limits.slowdown, velocity[1] / self.limits.slowdown)
        speed, turn_rate = limited(slow, self.limits.max_speed, self.limits.max_turn_rate)
        return Command(float(speed), float(turn_rate))
