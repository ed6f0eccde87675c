"""What a policy would have commanded on a recorded drive: a CSV file and a picture.

    python examples/replay_bag.py BAG --policy best_policy --scan /scan --goal /goal_pose \
        --pose /odom --out replay

BAG is a bag of ROS 1 or ROS 2 (a folder with .db3 or .mcap files, or a .bag file), best_policy a
folder from `sqn export`. The goal must be in the frame of the poses (Odometry, PoseStamped or
PoseWithCovarianceStamped). Needs the extra `bag`: pip install 'sqn_jax[bag]'.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent / "ros2" / "sqn_navigation"))

from sqn_navigation.controller import Controller, Limits, Pose, load_policy
from sqn_navigation.conversions import Mount, Scan, yaw_of

POSE_TYPES = {
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
}


class Row(NamedTuple):
    """One scan, and what the policy made of it."""

    time_s: float
    x_m: float
    y_m: float
    yaw_rad: float
    goal_x_m: float
    goal_y_m: float
    speed_m_s: float
    turn_rate_rad_s: float
    reason: str


class Event(NamedTuple):
    """A message of one of the three topics."""

    time: float
    """s since the first."""
    kind: str
    """scan, goal or pose."""
    frame: str
    value: Any


def read_events(bag: Path, topics: dict[str, str]) -> Iterator[Event]:
    """The messages of the topics in the order of their recording.

    Args:
        bag: the file or folder.
        topics: for scan, goal and pose the name.

    Raises:
        ValueError: the bag cannot be read, lacks a topic, or has another type there.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    kinds = {topic: kind for kind, topic in topics.items()}
    expected = {
        "scan": ["sensor_msgs/msg/LaserScan"],
        "goal": ["geometry_msgs/msg/PoseStamped"],
        "pose": list(POSE_TYPES),
    }
    try:
        store = get_typestore(Stores.ROS2_JAZZY)
        with AnyReader([bag], default_typestore=store) as reader:
            found = {connection.topic: connection.msgtype for connection in reader.connections}
            for kind, topic in topics.items():
                if found.get(topic) not in expected[kind]:
                    what = f"is of {found[topic]}" if topic in found else "is not in the bag"
                    raise ValueError(
                        f"{bag}: topic {topic} {what}, expected {' or '.join(expected[kind])} "
                        f"(--{kind}); it has {', '.join(sorted(found)) or 'none'}"
                    )
            chosen = [one for one in reader.connections if one.topic in kinds]
            first = reader.start_time
            for connection, nanoseconds, data in reader.messages(connections=chosen):
                message: Any = reader.deserialize(data, connection.msgtype)
                value = message
                if kinds[connection.topic] == "pose":
                    value = POSE_TYPES[connection.msgtype](message)
                frame = message.header.frame_id
                time = (nanoseconds - first) * 1e-9
                yield Event(time, kinds[connection.topic], frame, value)
    except ValueError:
        raise
    except Exception as error:  # Its readers raise many kinds on damaged files.
        what = " ".join(str(error).split())
        raise ValueError(f"{bag}: cannot be read as a bag ({what})") from None


def replay(events: Iterator[Event], controller: Controller, mount: Mount) -> list[Row]:
    """Hand a recording to a controller; asked at each scan, it decides as often as on a robot.

    A scan counts as new when it was recorded, and a pose until the next one: old ones are not
    noticed here, as they are by the node.

    Raises:
        ValueError: there is no scan, or a goal is in another frame than the poses.
    """
    rows: list[Row] = []
    pose, goal, frames = None, (math.nan, math.nan), {"goal": "", "pose": ""}

    def where() -> Pose:
        if pose is None:
            raise ValueError("there is no pose yet")
        return pose

    for event in events:
        if event.kind == "scan":
            controller.set_scan(_scan_of(event.value), mount, event.time)
            command = controller.tick(where, event.time)
            place = pose or (math.nan, math.nan, math.nan)
            rows.append(
                Row(event.time, *place, *goal, command.speed, command.turn_rate, command.reason)
            )
            continue
        frames[event.kind] = event.frame
        if frames["goal"] and frames["pose"] and frames["goal"] != frames["pose"]:
            raise ValueError(
                f"the goal is in the frame {frames['goal']!r}, expected {frames['pose']!r}, that "
                "of the poses"
            )
        if event.kind == "goal":
            goal = (event.value.pose.position.x, event.value.pose.position.y)
            controller.set_goal(goal)
        else:
            turn, position = event.value.orientation, event.value.position
            pose = (position.x, position.y, yaw_of(turn.x, turn.y, turn.z, turn.w))
    if not rows:
        raise ValueError("the bag holds no scan, expected at least one")
    return rows


def _scan_of(message: Any) -> Scan:
    return Scan(
        message.ranges,
        message.angle_min,
        message.angle_increment,
        message.range_min,
        message.range_max,
    )


def write(out: Path, rows: Sequence[Row]) -> None:
    """OUT.csv, one line a scan, and OUT.png."""
    from sqn_jax import figures

    write_csv(out.with_name(f"{out.name}.csv"), rows)
    columns = [[row[index] for row in rows] for index in range(8)]
    figures.save(figures.commands(*columns), out.with_name(f"{out.name}.png"))


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line a scan."""
    from sqn_jax.storage.files import written_whole

    with written_whole(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows(rows)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("bag", type=Path)
    add("--policy", type=Path, required=True, help="a folder from sqn export")
    add("--scan", default="/scan", help="topic (default /scan)")
    add("--goal", default="/goal_pose", help="topic (default /goal_pose)")
    add("--pose", default="/odom", help="topic (default /odom)")
    add("--out", type=Path, required=True, help="OUT.csv and OUT.png are written")
    add("--slowdown", type=float, default=5.0, help="as the node's (default 5)")
    add("--max-speed", type=float, default=0.5, help="m/s, cap (default 0.5)")
    add("--max-turn-rate", type=float, default=1.0, help="rad/s, cap (default 1)")
    add("--goal-radius", type=float, default=0.3, help="m (default 0.3)")
    add("--robot-radius", type=float, default=0.0, help="m (default 0: as trained)")
    add("--bumper", type=float, default=0.05, help="m, as the node's (default 0.05; 0: none)")
    add(
        "--mount",
        nargs=3,
        type=float,
        default=[0.0, 0.0, 0.0],
        metavar=("X", "Y", "YAW"),
        help="where the sensor sits, m and rad (default 0 0 0)",
    )
    add("--upside-down", action="store_true", help="the sensor hangs")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Replay a bag; returns the exit code."""
    options = parse(arguments)
    try:
        limits = Limits(
            max_speed=options.max_speed,
            max_turn_rate=options.max_turn_rate,
            slowdown=options.slowdown,
            goal_radius=options.goal_radius,
            robot_radius=options.robot_radius,
            bumper=options.bumper,
        )
        controller = Controller(load_policy(options.policy), limits, obeyed=False)
        topics = {kind: getattr(options, kind) for kind in ("scan", "goal", "pose")}
        mount = Mount(*options.mount, upside_down=options.upside_down)
        rows = replay(read_events(options.bag, topics), controller, mount)
        write(options.out, rows)
    except ImportError as error:
        print(f"{error.name} is not installed (pip install 'sqn_jax[bag]')", file=sys.stderr)
        return 2
    except ValueError as error:
        print(f"replay_bag: {error}", file=sys.stderr)
        return 2
    driving = sum(not row.reason for row in rows)
    print(f"{len(rows)} scans, a command at {driving}; wrote {options.out}.csv and .png")
    for reason in dict.fromkeys(row.reason for row in rows if row.reason):
        print(f"stands at {sum(row.reason == reason for row in rows)}: {reason}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
