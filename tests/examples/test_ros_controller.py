"""The controller behind the node, with a made-up policy."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_policy import MadeUpPolicy, scan
from sqn_navigation.controller import Command, Controller, Limits, load_policy
from sqn_navigation.conversions import Mount, Scan

from sqn_jax.export import sqn_policy

STOPPED = Command(reason="the bumper stops the move")


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


def test_the_bumper_looks_at_every_scan_while_a_command_holds() -> None:
    def stepping(ahead: float, time: float) -> tuple[list[Command], MotionPolicy]:
        """Something is there at once, while 0.25 m in 0.5 s are commanded."""
        policy = MotionPolicy()
        controller = Controller(policy, Limits(bumper=0.05))
        controller.set_goal((0.0, 30.0))
        commands = []
        for now, distance in ((0.0, 3.0), (time, ahead), (0.45, 3.0), (0.5, 3.0)):
            controller.set_scan(scan(distance), Mount(), now)
            commands.append(controller.tick(here, now))
        return commands, policy

    # 0.15 m or 0.05 m are left of the move, and 0.15 m must stay: body and bumper.
    for ahead, time, second in (
        *((0.31, 0.2, Command(0.5)), (0.29, 0.2, STOPPED)),
        *((0.21, 0.4, Command(0.5)), (0.19, 0.4, STOPPED)),
    ):
        commands, policy = stepping(ahead, time)
        assert commands == [Command(0.5), second, second, Command(0.5)]
        assert len(policy.seen) == 2
    controller, _ = driving()
    controller.tick(here, 0.0)
    controller.set_scan(scan(0.29), Mount(), 0.2)
    # An old scan, of 0.2 s: what was left of the move then.
    assert controller.tick(here, 0.4) == STOPPED


def test_a_move_that_the_bumper_broke_off_was_refused() -> None:
    policy = MotionPolicy()
    controller = Controller(policy, Limits())
    controller.set_goal((0.0, 30.0))
    for now, ahead in ((0.0, 3.0), (0.2, 0.2), (0.5, 3.0), (1.0, 3.0)):
        controller.set_scan(scan(ahead), Mount(), now)
        controller.tick(lambda now=now: (now, 0.0, 0.0), now)  # type: ignore[misc]
    assert [seen[4] for seen in policy.seen] == [False, True, False]  # type: ignore[misc]


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
