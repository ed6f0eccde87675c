"""The node: messages in, messages out. What it decides stands in `controller`."""

from __future__ import annotations

import dataclasses
import math
import signal
import sys
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from tf2_ros import Buffer, TransformException, TransformListener

from sqn_navigation.controller import Command, Controller, Limits, Pose, load_policy
from sqn_navigation.conversions import Mount, Scan, is_upside_down, yaw_of

LATEST = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)
"""Of scans only the newest counts, and drivers publish them so."""

PARAMETERS: dict[str, Any] = {
    "policy": "",
    "base_frame": "base_link",
    "stamped": True,
    "rate": 20.0,
    "max_speed": 0.5,
    "max_turn_rate": 1.0,
    "slowdown": 5.0,
    "goal_radius": 0.3,
    "stale_after": 0.3,
    "unseen": math.inf,
    "time_limit": 600.0,
    "robot_radius": 0.0,
    "bumper": 0.05,
}
"""See config/sqn_navigation.yaml."""


class Navigator(Node):
    """Subscribes `scan` and `goal_pose`, looks the robot up in TF, publishes `cmd_vel`."""

    def __init__(self) -> None:
        super().__init__("sqn_navigation")
        # Of any type, since ROS takes no 5 for 5.0; `as_declared` refuses the rest in a line.
        anything = ParameterDescriptor(dynamic_typing=True)
        values = {
            name: as_declared(name, self.declare_parameter(name, default, anything).value)
            for name, default in PARAMETERS.items()
        }
        names = {limit.name for limit in dataclasses.fields(Limits)}
        limits = Limits(**{name: values[name] for name in names})
        if not 1 <= values["rate"] * limits.stale_after < math.inf:
            raise ValueError(
                f"rate is {values['rate']}, expected at least one command in stale_after, "
                f"{limits.stale_after} s"
            )
        self._controller = Controller(load_policy(Path(values["policy"])), limits)
        self._base_frame = values["base_frame"]
        self._stamped = values["stamped"]
        self._goal_frame = ""
        self._mounts: dict[str, Mount] = {}
        self._last = Command(reason="waiting")
        self._time = -math.inf
        self._transforms = Buffer()
        self._listener = TransformListener(self._transforms, self)
        self._publisher = self.create_publisher(
            TwistStamped if self._stamped else Twist, "cmd_vel", 1
        )
        self.create_subscription(LaserScan, "scan", self.on_scan, LATEST)
        self.create_subscription(PoseStamped, "goal_pose", self.on_goal, 1)
        self.create_timer(1 / values["rate"], self.on_timer)

    def on_scan(self, message: LaserScan) -> None:
        """Hand a scan on, with where its sensor sits."""
        scan = Scan(
            message.ranges,
            message.angle_min,
            message.angle_increment,
            message.range_min,
            message.range_max,
        )
        frame = message.header.frame_id
        if frame not in self._mounts:
            try:
                transform = self._transforms.lookup_transform(self._base_frame, frame, Time())
            except TransformException:
                self.get_logger().warning(
                    f"no transform from {frame} to {self._base_frame}: its scans are not used",
                    once=True,
                )
                return
            self._mounts[frame] = mount_of(transform.transform)
        # A stamp from the future must not hide that the sensor has gone silent.
        measured = min(seconds(message.header.stamp), self._now())
        self._controller.set_scan(scan, self._mounts[frame], measured)

    def on_goal(self, message: PoseStamped) -> None:
        """Begin anew."""
        self._goal_frame = message.header.frame_id
        self._controller.set_goal((message.pose.position.x, message.pose.position.y))

    def on_timer(self) -> None:
        """Publish a command; while there is no goal, the stop only once. Say each reason once."""
        now = self._now()
        if now < self._time - self._controller.limits.stale_after:
            self._transforms.clear()  # Simulated time began anew: TF ignores what comes as old.
        self._time = now
        command = self._controller.tick(self._pose, now)
        if command.reason != self._last.reason and command.reason:
            self.get_logger().warning(f"the robot stands: {command.reason}")
        if self._controller.has_goal or command != self._last:
            self._publish(command)
        self._last = command

    def stop(self) -> None:
        """Publish a stop; the last thing that the node does."""
        self._publish(Command(reason="the node ends"))

    def _publish(self, command: Command) -> None:
        message = TwistStamped() if self._stamped else Twist()
        twist = message.twist if self._stamped else message
        twist.linear.x, twist.angular.z = command.speed, command.turn_rate
        if self._stamped:
            message.header.stamp = self.get_clock().now().to_msg()
            message.header.frame_id = self._base_frame
        self._publisher.publish(message)

    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds) * 1e-9

    def _pose(self) -> Pose:
        """The pose in the frame of the goal; raises ValueError where TF does not know it."""
        if self._goal_frame == self._base_frame:
            raise ValueError(
                f"the goal is in the frame {self._goal_frame!r}, which moves with the robot"
            )
        try:
            found = self._transforms.lookup_transform(self._goal_frame, self._base_frame, Time())
        except TransformException:
            raise ValueError(
                f"the goal is in the frame {self._goal_frame!r}, in which TF does not know "
                f"{self._base_frame}"
            ) from None
        if self._now() - seconds(found.header.stamp) > self._controller.limits.stale_after:
            raise ValueError(f"the transform to {self._goal_frame!r} is old")
        turn, where = found.transform.rotation, found.transform.translation
        return where.x, where.y, yaw_of(turn.x, turn.y, turn.z, turn.w)


def seconds(stamp: Any) -> float:
    """A builtin_interfaces/Time as s."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def mount_of(transform: Any) -> Mount:
    """Where a sensor sits, from its geometry_msgs/Transform to the robot."""
    turn, where = transform.rotation, transform.translation
    parts = (turn.x, turn.y, turn.z, turn.w)
    return Mount(where.x, where.y, yaw_of(*parts), is_upside_down(*parts))


def as_declared(name: str, value: Any) -> Any:
    """A parameter as what `PARAMETERS` has under this name; a whole number is a number, too.

    Raises:
        ValueError: it is something else.
    """
    kind = type(PARAMETERS[name])
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        words = {float: "a number", bool: "true or false", str: "a text"}
        raise ValueError(f"{name} is {value!r}, expected {words[kind]}")
    return value


def main() -> None:
    """Run the node until it is stopped, and stop the robot then."""
    # The context must outlive the signal, or the last message would not leave.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    for ending in (signal.SIGTERM, signal.SIGHUP):  # The latter where a remote login breaks off.
        signal.signal(ending, signal.default_int_handler)
    try:
        node = Navigator()
    except ValueError as error:
        print(f"sqn_navigation: {error}", file=sys.stderr)
        rclpy.shutdown()
        sys.exit(2)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.stop()
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
