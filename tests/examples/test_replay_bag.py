"""Bags that the library writes, read back and handed to a made-up policy."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import replay_bag

rosbags = pytest.importorskip("rosbags", reason="the extra `bag` is not installed")

from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES: Any = STORE.types


def header(frame: str, seconds: float = 0.0) -> Any:
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=int(seconds), nanosec=0)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def pose(x: float, y: float, yaw: float) -> Any:
    turn = TYPES["geometry_msgs/msg/Quaternion"](
        x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)
    )
    place = TYPES["geometry_msgs/msg/Point"](x=x, y=y, z=0.0)
    return TYPES["geometry_msgs/msg/Pose"](position=place, orientation=turn)


def stamped_pose(frame: str, x: float, y: float, yaw: float = 0.0) -> Any:
    kind = TYPES["geometry_msgs/msg/PoseStamped"]
    return kind(header=header(frame), pose=pose(x, y, yaw))


def odometry(x: float, y: float, yaw: float) -> Any:
    zero = TYPES["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = TYPES["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    return TYPES["nav_msgs/msg/Odometry"](
        header=header("odom"),
        child_frame_id="base_link",
        pose=TYPES["geometry_msgs/msg/PoseWithCovariance"](
            pose=pose(x, y, yaw), covariance=np.zeros(36)
        ),
        twist=TYPES["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )


def laser_scan(ahead: float) -> Any:
    ranges = np.full(360, 4.0, np.float32)
    ranges[:3] = ahead
    return TYPES["sensor_msgs/msg/LaserScan"](
        header=header("laser"),
        angle_min=0.0,
        angle_max=math.radians(359),
        angle_increment=math.radians(1),
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.1,
        range_max=12.0,
        ranges=ranges,
        intensities=np.zeros(0, np.float32),
    )


def write_bag(folder: Path, plugin: StoragePlugin, goal_frame: str = "odom") -> Path:
    """A second of a drive along x, past a wall ahead in its second half, to a goal at the left."""
    path = folder / "bag"
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        topics = {
            "/odom": "nav_msgs/msg/Odometry",
            "/scan": "sensor_msgs/msg/LaserScan",
            "/goal_pose": "geometry_msgs/msg/PoseStamped",
        }
        open_topics = {
            name: writer.add_connection(name, kind, typestore=STORE)
            for name, kind in topics.items()
        }

        def write(topic: str, seconds: float, message: Any) -> None:
            data = STORE.serialize_cdr(message, topics[topic])
            writer.write(open_topics[topic], round(seconds * 1e9) + 5 * 10**9, data)

        write("/scan", 0.0, laser_scan(3.0))
        write("/odom", 0.05, odometry(0.0, 0.0, 0.0))
        write("/goal_pose", 0.06, stamped_pose(goal_frame, 0.0, 3.0))
        for step in range(1, 11):
            write("/odom", step / 10, odometry(step / 20, 0.0, 0.0))
            write("/scan", step / 10 + 0.01, laser_scan(3.0 if step < 6 else 0.5))
    return path


class MadeUpPolicy:
    """Drives forward while nothing is near ahead, else turns left."""

    beam_angles = np.radians(np.linspace(-175, 175, 71))
    time_step = 0.1
    env = {"max_range": 5.0, "robot_radius": 0.1}  # noqa: RUF012
    seen: list[tuple[float, float]] = []  # noqa: RUF012

    def act(self, ranges: Any, distance: float, heading: float, hidden: Any) -> Any:
        self.seen.append((distance, heading))
        return ((2.5, 0.0) if ranges[35] > 1 else (0.0, math.pi)), hidden


@pytest.fixture(autouse=True)
def _made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_bag, "load_policy", lambda folder: MadeUpPolicy())
    monkeypatch.setattr(MadeUpPolicy, "seen", [])


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_recorded_drive_gives_commands(
    tmp_path: Path, plugin: StoragePlugin, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, out = write_bag(tmp_path, plugin), tmp_path / "re.play"
    arguments = [str(bag), "--policy", "made up", "--out", str(out), "--slowdown", "2"]
    assert replay_bag.main([*arguments, "--max-speed", "9", "--max-turn-rate", "9"]) == 0
    printed = capsys.readouterr().out
    assert "11 scans, a command at 10" in printed
    assert "stands at 1: there is no goal" in printed
    with (tmp_path / "re.play.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # Decisions 0.2 s apart, at 0.11 s, 0.31 s, ...: the wall of 0.61 s is met at 0.71 s.
    assert [float(row["speed_m_s"]) for row in rows] == [0.0] + [1.25] * 6 + [0.0] * 4
    turns = [float(row["turn_rate_rad_s"]) for row in rows]
    assert turns == pytest.approx([0.0] * 7 + [math.pi / 2] * 4)
    assert float(rows[4]["x_m"]) == pytest.approx(0.2)
    assert float(rows[4]["time_s"]) == pytest.approx(0.41)
    assert MadeUpPolicy.seen[0] == pytest.approx(
        (math.hypot(0.05, 3), math.pi / 2 + math.atan2(0.05, 3))
    )
    assert (tmp_path / "re.play.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("more", "part"),
    [
        (
            ["--scan", "/lidar"],
            "topic /lidar is not in the bag, expected sensor_msgs/msg/LaserScan",
        ),
        (["--pose", "/scan"], "topic /scan is of sensor_msgs/msg/LaserScan, expected nav_msgs"),
        (["--max-speed", "0"], "max_speed is 0.0, expected a positive number"),
    ],
)
def test_what_the_bag_lacks_is_named(
    tmp_path: Path, more: list[str], part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path, StoragePlugin.MCAP)
    arguments = [str(bag), "--policy", "made up", "--out", str(tmp_path / "out"), *more]
    assert replay_bag.main(arguments) == 2
    assert part in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


def test_a_goal_in_another_frame_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path, StoragePlugin.MCAP, goal_frame="map")
    assert replay_bag.main([str(bag), "--policy", "x", "--out", str(tmp_path / "out")]) == 2
    assert "the goal is in the frame 'map', expected 'odom'" in capsys.readouterr().err


def test_a_file_that_is_no_bag_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bag.mcap").write_bytes(b"x" * 100)
    for name in ("bag.mcap", "none"):
        bag = tmp_path / name
        assert replay_bag.main([str(bag), "--policy", "x", "--out", str(tmp_path / "out")]) == 2
        assert "cannot be read as a bag" in capsys.readouterr().err


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_a_damaged_bag_is_refused_in_a_line(tmp_path: Path, plugin: StoragePlugin) -> None:
    folder = write_bag(tmp_path, plugin)
    (path,) = (file for file in folder.iterdir() if file.suffix != ".yaml")
    whole = path.read_bytes()
    topics = {"scan": "/scan", "goal": "/goal_pose", "pose": "/odom"}
    messages = []
    for begin in range(0, len(whole), len(whole) // 12):
        path.write_bytes(whole[:begin] + b"\xff" * 40 + whole[begin + 40 :])
        try:
            list(replay_bag.read_events(folder, topics))
        except ValueError as error:
            messages.append(str(error))
    assert messages
    assert all(len(message.splitlines()) == 1 for message in messages)
