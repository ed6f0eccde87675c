"""The node, driven by a stand-in for rclpy, and the controller behind it, with a made-up policy."""

from __future__ import annotations

import hashlib
import importlib
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sqn_navigation import controller as controllers
from sqn_navigation.controller import Command, Controller, Limits, load_policy
from sqn_navigation.conversions import Mount, Scan

from sqn_jax.export import sqn_policy

BEAMS = np.radians(np.linspace(-175, 175, 71))
STOPPED = Command(reason="the bumper stops the move")


class MadeUpPolicy:
    """Drives forward while nothing is near ahead, else turns left; counts its steps."""

    beam_angles = BEAMS
    time_step = 0.1
    env = {"max_range": 5.0, "robot_radius": 0.1}  # noqa: RUF012

    def __init__(self) -> None:
        self.seen: list[tuple[Any, float, float, Any]] = []

    def act(self, ranges: Any, distance: float, heading: float, hidden: Any) -> tuple[Any, int]:
        self.seen.append((ranges, distance, heading, hidden))
        return ((2.5, 0.0) if ranges[35] > 1 else (0.0, math.pi)), (hidden or 0) + 1


def scan(ahead: float = 3.0) -> Scan:
    ranges = np.full(360, 4.0)
    ranges[:3] = ahead
    return Scan(ranges, 0.0, math.radians(1), 0.1, 12.0)


def here() -> tuple[float, float, float]:
    return 0.0, 0.0, 0.0


def driving(**limits: float) -> tuple[Controller, MadeUpPolicy]:
    """On its way to a goal 3 m to the left, at time 0."""
    policy = MadeUpPolicy()
    controller = Controller(policy, Limits(**limits))
    controller.set_goal((0.0, 3.0))
    controller.set_scan(scan(), Mount(), 0.0)
    return controller, policy


def test_the_policy_decides_once_in_a_slowed_step_and_its_command_holds() -> None:
    controller, policy = driving()
    commands = [controller.tick(here, now) for now in (0.0, 0.1, 0.25)]
    assert commands == [Command(0.5, 0.0)] * 3
    assert len(policy.seen) == 1
    ranges, distance, heading, hidden = policy.seen[0]
    assert (ranges[35], ranges[0], hidden) == (3.0, 4.0, None)
    assert (distance, heading) == pytest.approx((3, math.pi / 2))
    controller.set_scan(scan(ahead=0.5), Mount(), 0.5)
    assert controller.tick(here, 0.49) == Command(0.5, 0.0)
    assert controller.tick(here, 0.5) == Command(0.0, pytest.approx(math.pi / 5))
    assert policy.seen[1][3] == 1


def test_caps_hold() -> None:
    controller, _ = driving(max_speed=0.2)
    assert controller.tick(here, 0.0) == Command(0.2, 0.0)


def test_a_new_goal_begins_without_memory_and_at_once() -> None:
    controller, policy = driving()
    controller.tick(here, 0.0)
    controller.set_goal((5.0, 0.0))
    controller.tick(here, 0.1)
    assert [seen[3] for seen in policy.seen] == [None, None]
    assert policy.seen[1][1:3] == pytest.approx((5, 0))


def lost() -> tuple[float, float, float]:
    raise ValueError("TF does not know the robot")


@pytest.mark.parametrize(
    ("change", "pose", "now", "reason"),
    [
        (lambda c: None, here, 0.31, "the scan is old"),
        (lambda c: None, lost, 0.0, "TF does not know the robot"),
        (lambda c: None, lambda: (math.nan, 0, 0), 0.0, "the goal or the pose is not finite"),
        (lambda c: c.set_goal((math.nan, 0)), here, 0.0, "the goal or the pose is not finite"),
        (lambda c: c.set_scan(scan(), Mount(), math.nan), here, 0.0, "the scan is old"),
        (lambda c: None, here, -9.0, "the scan is from the future: the clock went back"),
        (lambda c: c.set_goal(None), here, 0.0, "there is no goal"),
        (lambda c: c.set_goal((0.2, 0.2)), here, 0.0, "the goal is reached"),
        (
            lambda c: c.set_scan(Scan(np.full(9, np.inf), 0, 0.1, 0.1, 5), Mount(), 0.0),
            here,
            0.0,
            "none of the 9 beams of the scan returned anything",
        ),
    ],
)
def test_it_stops_and_says_why(
    change: Callable[[Controller], None], pose: Any, now: float, reason: str
) -> None:
    controller, _ = driving()
    change(controller)
    assert controller.tick(pose, now) == Command(0.0, 0.0, reason)


def test_a_goal_that_is_not_reached_is_given_up() -> None:
    controller, _ = driving(time_limit=20.0)
    controller.set_scan(scan(), Mount(), 100.0)
    assert controller.tick(here, 100.0) == Command(0.5, 0.0)
    controller.set_scan(scan(), Mount(), 120.1)
    assert controller.tick(here, 120.1).reason == "the goal is given up after 20 s"
    assert controller.tick(here, 120.2).reason == "there is no goal"
    controller.set_goal((0.0, 3.0))
    assert controller.tick(here, 120.3) == Command(0.5, 0.0)


def test_a_sensor_that_goes_blind_ends_a_command_that_is_held() -> None:
    controller, _ = driving()
    controller.tick(here, 0.0)
    controller.set_scan(Scan(np.full(9, np.nan), 0, 0.1, 0.1, 5), Mount(), 0.1)
    reason = "none of the 9 beams of the scan returned anything"
    assert [controller.tick(here, now) for now in (0.1, 0.2)] == [Command(reason=reason)] * 2
    controller.set_scan(scan(), Mount(), 0.25)
    assert controller.tick(here, 0.25) == Command(0.5, 0.0)


def test_a_clock_that_went_back_holds_no_command() -> None:
    controller, policy = driving()
    controller.set_scan(scan(), Mount(), 100.0)
    assert controller.tick(here, 100.0) == Command(0.5, 0.0)
    controller.set_scan(scan(ahead=0.5), Mount(), 3.0)
    assert controller.tick(here, 3.0) == Command(0.0, pytest.approx(math.pi / 5))
    assert len(policy.seen) == 2


def test_a_policy_that_is_not_finite_stops_the_robot_and_a_later_scan_starts_it() -> None:
    controller, policy = driving()
    policy.act = lambda *_: ((math.nan, 0.0), 0)  # type: ignore[method-assign]
    assert "expected finite numbers" in controller.tick(here, 0.0).reason
    del policy.act
    assert controller.tick(here, 0.05) == Command(0.5, 0.0)


class MotionPolicy(MadeUpPolicy):
    """One that was trained with motion inputs."""

    motion_size = 5

    def act(self, *args: Any, refused: bool) -> Any:  # type: ignore[override]
        command, hidden = super().act(*args)
        self.seen[-1] = (*self.seen[-1], refused)  # type: ignore[assignment]
        return command, hidden


def test_a_policy_with_motion_inputs_hears_of_moves_that_moved_nothing() -> None:
    policy = MotionPolicy()
    controller = Controller(policy, Limits())
    controller.set_goal((0.0, 30.0))
    x = 0.0
    # m since the decision before, the reading ahead, and what is heard at this decision of 0.5 s.
    for step, (moved, ahead, refused) in enumerate(
        [
            (0.0, 3.0, False),  # Nothing was commanded before the first.
            (0.25, 3.0, False),
            (0.02, 3.0, True),  # 0.25 m were commanded.
            (0.03, 0.5, False),
            (0.0, 0.5, False),  # A turn is no move.
            (0.0, 3.0, False),
        ]
    ):
        x += moved
        controller.set_scan(scan(ahead), Mount(), step / 2)
        controller.tick(lambda x=x: (x, 0.0, 0.0), step / 2)  # type: ignore[misc]
        assert policy.seen[step][4] is refused, step  # type: ignore[misc]
    assert controller.tick(lost, 2.7).reason
    controller.tick(lambda: (x, 0.0, 0.0), 2.75)
    assert policy.seen[-1][4] is False, "after a stop nothing is known"  # type: ignore[misc]
    controller.set_scan(scan(), Mount(), 3.25)
    controller.tick(lambda: (x, 0.0, 0.0), 3.25)
    assert policy.seen[-1][4] is True  # type: ignore[misc]
    controller.set_scan(scan(), Mount(), 3.2)
    controller.tick(lambda: (x, 0.0, 0.0), 3.2)
    assert policy.seen[-1][4] is False, "the clock went back"  # type: ignore[misc]
    controller.set_goal((9.0, 0.0))
    controller.tick(lambda: (x, 0.0, 0.0), 3.3)
    assert policy.seen[-1][4] is False  # type: ignore[misc]


def test_a_move_is_refused_by_what_was_commanded_and_in_a_recording_never() -> None:
    for obeyed, speed, expected in ((True, 0.5, True), (True, 0.1, False), (False, 0.5, False)):
        policy = MotionPolicy()
        controller = Controller(policy, Limits(max_speed=speed), obeyed=obeyed)
        controller.set_goal((0.0, 30.0))
        for time, x in ((0.0, 0.0), (0.5, 0.02)):  # 0.25 m were commanded, or 0.05 m.
            controller.set_scan(scan(), Mount(), time)
            controller.tick(lambda x=x: (x, 0.0, 0.0), time)  # type: ignore[misc]
        assert [seen[4] for seen in policy.seen] == [False, expected]  # type: ignore[misc]


def test_the_bumper_stops_a_move_and_says_so_to_the_policy() -> None:
    class Slim(MotionPolicy):
        """It drives forward whatever it sees."""

        def act(self, *args: Any, refused: bool) -> Any:  # type: ignore[override]
            return (2.5, 0.0), super().act(*args, refused=refused)[1]

    for obeyed in (True, False):
        policy = Slim()
        controller = Controller(policy, Limits(bumper=0.05), obeyed=obeyed)
        controller.set_goal((0.0, 30.0))
        commands = []
        for time, ahead in ((0.0, 0.41), (0.5, 0.39), (1.0, 0.41)):
            # 0.25 m on, with a body of 0.1 m, 0.06 m are left to what is ahead, or 0.04 m.
            controller.set_scan(scan(ahead), Mount(), time)
            commands.append(controller.tick(lambda time=time: (time, 0.0, 0.0), time))
        assert commands == [Command(0.5), STOPPED, Command(0.5)]
        assert [seen[4] for seen in policy.seen] == [False, False, True]  # type: ignore[misc]
        controller.set_goal((9.0, 0.0))
        controller.tick(here, 1.1)
        assert policy.seen[-1][4] is False  # type: ignore[misc]


def test_a_wide_robot_shows_its_policy_thicker_obstacles_and_stops_sooner() -> None:
    controller, policy = driving(robot_radius=0.4, bumper=0.05)
    assert controller.tick(here, 0.0) == Command(0.5, 0.0)
    ranges = policy.seen[0][0]
    assert ranges[35] == pytest.approx(2.7)  # 3 m ahead, 0.3 m wider than in the training.
    controller.set_scan(scan(ahead=1.29), Mount(), 0.5)
    assert controller.tick(here, 0.5).speed == 0.0  # It sees 0.99 m, and turns.
    controller, policy = driving(robot_radius=1.0, bumper=0.05)
    controller.set_scan(scan(ahead=1.29), Mount(), 0.0)
    policy.act = lambda *_: ((2.5, 0.0), 0)  # type: ignore[method-assign]
    assert controller.tick(here, 0.0) == STOPPED
    controller, _ = driving(bumper=0.0)
    controller.set_scan(scan(ahead=1.01), Mount(), 0.0)
    assert controller.tick(here, 0.0) == Command(0.5, 0.0)


def test_limits_are_checked() -> None:
    for name, value in (
        *(("slowdown", 0.0), ("max_speed", math.inf), ("unseen", math.nan)),
        *(("robot_radius", -0.1), ("bumper", math.nan), ("max_speed", "fast"), ("bumper", True)),
    ):
        with pytest.raises(ValueError, match=f"{name} is"):
            Limits(**{name: value})


def test_a_folder_that_has_changed_is_not_run(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="SHA256SUMS: No such file"):
        load_policy(tmp_path)
    names = ("sqn_policy.py", "params.safetensors", "config.json")
    for name in names:
        (tmp_path / name).write_text("raise SystemExit('executed')\n")
    digests = [hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() for name in names]
    sums = "".join(f"{digest}  {name}\n" for digest, name in zip(digests, names, strict=True))
    (tmp_path / "SHA256SUMS").write_text(sums)
    with pytest.raises(SystemExit, match="executed"):
        load_policy(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match=r"config\.json: has changed"):
        load_policy(tmp_path)
    assert hasattr(sqn_policy, "Policy")


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

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.overrides.get(name, default))

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


def test_what_cannot_be_loaded_is_a_line(ros: Any, capsys: pytest.CaptureFixture[str]) -> None:
    FakeNode.overrides = {"slowdown": -1.0}
    ros.rclpy.init = lambda **_: None
    ros.rclpy.shutdown = lambda: None
    ros.signal = SimpleNamespace(
        signal=lambda *_: None, SIGTERM=15, SIGHUP=1, default_int_handler=None
    )
    with pytest.raises(SystemExit) as stop:
        ros.main()
    assert stop.value.code == 2
    assert capsys.readouterr().err == (
        "sqn_navigation: slowdown is -1.0, expected a positive number\n"
    )
