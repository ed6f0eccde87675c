"""The node, driven by a stand-in for rclpy, with a made-up policy."""

from __future__ import annotations

import importlib
import math
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from made_up_policy import MadeUpPolicy, scan
from sqn_navigation import controller as controllers

# A stand-in for ROS: as much of it as the node uses.


class Clock:
    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> Any:
        nanoseconds = round(self.time * 1e9)
        stamp = SimpleNamespace(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return SimpleNamespace(nanoseconds=nanoseconds, to_msg=lambda: stamp)


class FakeNode:
    """Remembers what it was asked for; `overrides` are the parameters given from outside."""

    overrides: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.name, self.clock = name, Clock()
        self.subscriptions_of: dict[str, tuple[Any, Any, Any]] = {}
        self.published: list[Any] = []
        self.lines: list[str] = []
        self.destroyed = False

    def declare_parameter(self, name: str, default: Any, descriptor: Any = None) -> Any:
        """As in rclpy, what is given has the type of the default, or its type is dynamic."""
        value = self.overrides.get(name, default)
        if not (descriptor and descriptor.dynamic_typing) and type(value) is not type(default):
            raise TypeError(f"InvalidParameterTypeException: {name}")
        return SimpleNamespace(value=value)

    def create_subscription(self, kind: Any, topic: str, callback: Any, qos: Any) -> None:
        self.subscriptions_of[topic] = (kind, callback, qos)

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        return SimpleNamespace(publish=self.published.append)

    def create_timer(self, period: float, callback: Any) -> None:
        self.timer = (period, callback)

    def get_clock(self) -> Clock:
        return self.clock

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=lambda text, once=False: self.lines.append(text))

    def destroy_node(self) -> None:
        self.destroyed = True


class TransformException(Exception):
    """As in tf2_ros."""


class Buffer:
    """Transforms by their frames."""

    def __init__(self) -> None:
        self.known: dict[tuple[str, str], Any] = {}

    def lookup_transform(self, target: str, source: str, time: Any) -> Any:
        assert target != source
        if (target, source) not in self.known:
            raise TransformException(f"{target} {source} at {time}")
        return self.known[target, source]

    def clear(self) -> None:
        """As in tf2, what is fixed stays."""
        del self.known["map", "base_link"]


def transform(x: float, y: float, yaw: float, stamp: float = 0.0) -> Any:
    rotation = SimpleNamespace(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    translation = SimpleNamespace(x=x, y=y, z=0.0)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=int(stamp), nanosec=round(stamp % 1 * 1e9)))
    return SimpleNamespace(
        header=header, transform=SimpleNamespace(rotation=rotation, translation=translation)
    )


class Twist:
    def __init__(self) -> None:
        self.linear, self.angular = SimpleNamespace(x=0.0), SimpleNamespace(z=0.0)


class TwistStamped:
    def __init__(self) -> None:
        self.twist, self.header = Twist(), SimpleNamespace(stamp=None, frame_id="")


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module `node`, loaded on the stand-in, with a made-up policy in every folder."""
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {"calls": [], "context": True},
        "rclpy.node": {"Node": FakeNode},
        "rclpy.qos": {
            "HistoryPolicy": SimpleNamespace(KEEP_LAST="keep last"),
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT="best effort"),
            "QoSProfile": lambda **settings: settings,
        },
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO="none")},
        "rclpy.time": {"Time": lambda: "latest"},
        "rcl_interfaces": {},
        "rcl_interfaces.msg": {"ParameterDescriptor": lambda **given: SimpleNamespace(**given)},
        "geometry_msgs": {},
        "geometry_msgs.msg": {
            "PoseStamped": SimpleNamespace,
            "Twist": Twist,
            "TwistStamped": TwistStamped,
        },
        "sensor_msgs": {},
        "sensor_msgs.msg": {"LaserScan": SimpleNamespace},
        "tf2_ros": {
            "Buffer": Buffer,
            "TransformException": TransformException,
            "TransformListener": lambda buffer, node: None,
        },
    }
    for name, values in contents.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "sqn_navigation.node", raising=False)
    monkeypatch.setattr(controllers, "load_policy", lambda folder: MadeUpPolicy())
    monkeypatch.setattr(FakeNode, "overrides", {})
    yield importlib.import_module("sqn_navigation.node")
    sys.modules.pop("sqn_navigation.node", None)


def message(stamp: float, ahead: float = 3.0) -> Any:
    seen = scan(ahead)
    header = SimpleNamespace(
        frame_id="laser", stamp=SimpleNamespace(sec=int(stamp), nanosec=round(stamp % 1 * 1e9))
    )
    return SimpleNamespace(header=header, **vars(seen))


def goal(frame: str, x: float, y: float) -> Any:
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=y))
    return SimpleNamespace(header=SimpleNamespace(frame_id=frame), pose=pose)


def commands(node: Any) -> list[tuple[float, float]]:
    twists = [getattr(sent, "twist", sent) for sent in node.published]
    return [(twist.linear.x, twist.angular.z) for twist in twists]


def started(ros: Any, **parameters: Any) -> Any:
    FakeNode.overrides = parameters
    node = ros.Navigator()
    node._transforms.known["base_link", "laser"] = transform(0.0, 0.0, 0.0)
    node._transforms.known["map", "base_link"] = transform(1.0, 1.0, 0.0)
    return node


def test_a_scan_and_a_goal_give_stamped_velocities(ros: Any) -> None:
    node = started(ros)
    assert node.subscriptions_of["scan"][2]["depth"] == 1
    assert node.subscriptions_of["scan"][2]["reliability"] == "best effort"
    assert node.timer[0] == pytest.approx(0.05)
    node.subscriptions_of["scan"][1](message(0.0))
    node.subscriptions_of["goal_pose"][1](goal("map", 1.0, 4.0))
    node.timer[1]()
    assert commands(node) == [(0.5, 0.0)]
    assert isinstance(node.published[0], TwistStamped)
    assert node.published[0].header.frame_id == "base_link"
    (seen,) = node._controller.policy.seen
    assert seen[1:3] == pytest.approx((3, math.pi / 2))
    plain = started(ros, stamped=False)
    plain.on_scan(message(0.0))
    plain.on_goal(goal("map", 1.0, 4.0))
    plain.on_timer()
    assert isinstance(plain.published[0], Twist)


def test_a_sensor_turned_to_the_left_sees_what_is_left(ros: Any) -> None:
    node = started(ros)
    node._transforms.known["base_link", "laser"] = transform(0.0, 0.0, math.pi / 2)
    node.on_scan(message(0.0, ahead=2.0))
    node.on_goal(goal("map", 1.0, 4.0))
    node.on_timer()
    assert node._controller.policy.seen[0][0][[35, 53]].tolist() == pytest.approx([4, 2])


def test_each_reason_is_said_once_and_the_robot_stands(ros: Any) -> None:
    node = started(ros)
    node.on_timer()
    node.on_timer()
    assert node.lines == ["the robot stands: there is no goal"]
    assert commands(node) == [(0.0, 0.0)]  # Others may drive it meanwhile.
    node.on_scan(message(0.0))
    node.on_goal(goal("odom", 1.0, 4.0))
    for _ in range(3):
        node.on_timer()
    assert node.lines[1:] == [
        "the robot stands: the goal is in the frame 'odom', in which TF does not know base_link"
    ]
    assert commands(node)[1:] == [(0.0, 0.0)] * 3
    node._transforms.known["odom", "base_link"] = transform(0.0, 0.0, 0.0)
    node.on_timer()
    assert commands(node)[-1] == (0.5, 0.0)
    node.clock.time = 0.31  # No scan came, nor a transform.
    node.on_timer()
    assert commands(node)[-1] == (0.0, 0.0)
    assert node.lines[-1] == "the robot stands: the scan is old"
    node.on_scan(message(0.31))
    node.on_timer()
    assert node.lines[-1] == "the robot stands: the transform to 'odom' is old"
    assert commands(node)[-1] == (0.0, 0.0)


def test_a_stamp_from_the_future_does_not_hide_a_silent_sensor(ros: Any) -> None:
    node = started(ros)
    node.on_scan(message(1000.0))
    node.on_goal(goal("map", 1.0, 4.0))
    node.on_timer()
    assert commands(node) == [(0.5, 0.0)]
    node.clock.time = 0.31
    node.on_timer()
    assert node.lines == ["the robot stands: the scan is old"]


def test_simulated_time_that_begins_anew_stops_the_robot(ros: Any) -> None:
    node = started(ros)
    node.clock.time = 100.0
    node._transforms.known["map", "base_link"] = transform(1.0, 1.0, 0.0, 100.0)
    node.on_scan(message(100.0))
    node.on_goal(goal("map", 1.0, 4.0))
    node.on_timer()
    node.clock.time = 1.0
    node.on_timer()
    node.on_scan(message(1.0))
    node.on_timer()
    node._transforms.known["map", "base_link"] = transform(1.0, 1.0, 0.0, 1.0)
    node.on_timer()
    assert commands(node) == [(0.5, 0.0), (0.0, 0.0), (0.0, 0.0), (0.5, 0.0)]
    assert [line.split(" stands: ")[1] for line in node.lines] == [
        "the scan is from the future: the clock went back",
        "the goal is in the frame 'map', in which TF does not know base_link",
    ]


def test_a_goal_that_moves_along_is_refused(ros: Any) -> None:
    node = started(ros)
    node.on_scan(message(0.0))
    node.on_goal(goal("base_link", 1.0, 4.0))
    node.on_timer()
    assert commands(node) == [(0.0, 0.0)]
    assert node.lines[-1].endswith("the frame 'base_link', which moves with the robot")


@pytest.mark.parametrize("rate", [0.0, 2.0, math.nan, math.inf])
def test_a_rate_at_which_what_is_old_goes_unnoticed_is_refused(ros: Any, rate: float) -> None:
    with pytest.raises(ValueError, match="rate is"):
        started(ros, rate=rate)


def test_a_scan_of_an_unknown_frame_is_not_used(ros: Any) -> None:
    node = started(ros)
    del node._transforms.known["base_link", "laser"]
    node.on_scan(message(0.0))
    node.on_goal(goal("map", 1.0, 4.0))
    node.on_timer()
    assert node.lines[0] == "no transform from laser to base_link: its scans are not used"
    assert node.lines[1] == "the robot stands: there is no scan"
    assert commands(node) == [(0.0, 0.0)]


@pytest.mark.parametrize("end", [KeyboardInterrupt, RuntimeError])
def test_the_last_message_is_a_stop(ros: Any, end: type[BaseException]) -> None:
    FakeNode.overrides = {}
    order: list[Any] = []

    def spin(node: Any) -> None:
        order.append(node)
        raise end

    ros.rclpy.init = lambda **options: order.append(options)
    ros.rclpy.spin = spin
    ros.rclpy.shutdown = lambda: order.append((commands(order[1]), order[1].destroyed))
    ros.signal = SimpleNamespace(
        signal=lambda *_: None, SIGTERM=15, SIGHUP=1, default_int_handler=None
    )  # The process's own stays.
    if end is KeyboardInterrupt:
        ros.main()
    else:
        with pytest.raises(end):
            ros.main()
    assert order[0] == {"signal_handler_options": "none"}
    assert order[2] == ([(0.0, 0.0)], True)


def test_whole_numbers_are_numbers(ros: Any) -> None:
    FakeNode.overrides = {"slowdown": 2, "bumper": 0, "rate": 10}
    node = ros.Navigator()
    assert node.timer[0] == pytest.approx(0.1)
    assert node._controller.limits.slowdown == 2.0
    assert node._controller.limits.bumper == 0.0


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"slowdown": -1.0}, "slowdown is -1.0, expected a positive number"),
        ({"slowdown": "5"}, "slowdown is '5', expected a number"),
        ({"bumper": True}, "bumper is True, expected a number"),
        ({"rate": None}, "rate is None, expected a number"),
        ({"stamped": 1}, "stamped is 1, expected true or false"),
        ({"policy": 3}, "policy is 3, expected a text"),
    ],
)
def test_what_cannot_be_loaded_is_a_line(
    ros: Any, capsys: pytest.CaptureFixture[str], parameters: dict[str, Any], line: str
) -> None:
    FakeNode.overrides = parameters
    ros.rclpy.init = lambda **_: None
    ros.rclpy.shutdown = lambda: None
    ros.signal = SimpleNamespace(
        signal=lambda *_: None, SIGTERM=15, SIGHUP=1, default_int_handler=None
    )
    with pytest.raises(SystemExit) as stop:
        ros.main()
    assert stop.value.code == 2
    assert capsys.readouterr().err == f"sqn_navigation: {line}\n"
