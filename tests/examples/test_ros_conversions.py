"""Scans of odd sensors, goals and commands, against a world whose distances are a formula."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqn_navigation.conversions import (
    Mount,
    Scan,
    goal_in_robot_frame,
    is_blocked,
    is_upside_down,
    limited,
    scan_to_sectors,
    thickened,
    yaw_of,
)

from sqn_jax.env.bumper import is_blocked as env_is_blocked
from sqn_jax.env.scan_margin import thickened as env_thickened

SECTORS = np.radians(np.linspace(-175, 175, 71))
FAR = 5.0
DENSE = np.linspace(-np.pi, np.pi, 20_001)


def wall(angle: Any) -> Any:
    """Distance of the wall from the center of the robot: near at the right and behind."""
    return 2 + 0.5 * np.sin(angle) + 0.4 * np.cos(angle)


def scan_of(
    count: int,
    first: float,
    step: float,
    mount: Mount = Mount(),  # noqa: B008
    **limits: float,
) -> Scan:
    """What a sensor sees of the wall; `first` and `step` in degrees."""
    x, y = wall(DENSE) * np.cos(DENSE) - mount.x, wall(DENSE) * np.sin(DENSE) - mount.y
    bearings = np.arctan2(y, x)
    order = np.argsort(bearings)
    directions = np.radians(first) + np.radians(step) * np.arange(count)
    on_robot = mount.yaw + (-directions if mount.upside_down else directions)
    ranges = np.interp(on_robot, bearings[order], np.hypot(x, y)[order], period=2 * np.pi)
    limits = {"range_min": 0.1, "range_max": 12.0} | limits
    return Scan(ranges, np.radians(first), np.radians(step), **limits)


MOUNTS = {
    "turned": Mount(yaw=2.0),
    "upside down": Mount(upside_down=True),
    "in front, turned, upside down": Mount(0.4, -0.2, -1.0, upside_down=True),
}
SENSORS: dict[str, tuple[tuple[int, float, float], Mount]] = {
    "1440 beams from -180": ((1440, -180, 0.25), Mount()),
    "720 beams from 0": ((720, 0, 0.5), Mount()),
    "clockwise": ((720, 180, -0.5), Mount()),
    "270 degrees, 1081 beams": ((1081, -135, 0.25), Mount()),
    "180 degrees": ((181, -90, 1), Mount()),
    "fewer beams than sectors": ((36, 0, 10), Mount()),
    "both ends of the circle": ((361, -180, 1), Mount()),
    **{name: ((720, -180, 0.5), mount) for name, mount in MOUNTS.items()},
}


@pytest.mark.parametrize(("beams", "mount"), SENSORS.values(), ids=SENSORS)
def test_each_sector_has_its_nearest_return(beams: tuple[int, float, float], mount: Mount) -> None:
    count, first, step = beams
    found = scan_to_sectors(scan_of(*beams, mount), SECTORS, FAR, mount=mount, unseen=4.5)
    # By brute force: the least of the wall within a sector, give or take a beam.
    half = max(abs(step), 5) / 2
    gaps = np.degrees(np.abs(np.angle(np.exp(1j * (DENSE[:, None] - SECTORS[None])))))
    distances = np.broadcast_to(wall(DENSE)[:, None], gaps.shape)
    least = np.where(gaps <= half + abs(step) / 2, distances, np.inf).min(axis=0)
    ends = sorted((first, first + step * (count - 1)))
    is_whole = ends[1] - ends[0] >= 350
    in_view = is_whole | ((np.degrees(DENSE) >= ends[0]) & (np.degrees(DENSE) <= ends[1]))
    certain = in_view[:, None] & (gaps <= max(half - abs(step), 0.1))
    most = np.where(certain, distances, np.inf).min(axis=0)
    seen = is_whole | ((np.degrees(SECTORS) >= ends[0] - 1) & (np.degrees(SECTORS) <= ends[1] + 1))
    slack = 0.06 if step == 10 else 0.012
    assert (found[seen] >= least[seen] - 1e-2).all()
    assert (found[seen] <= most[seen] + slack).all()
    assert (found[~seen & (np.abs(SECTORS) > np.radians(ends[1] + 3))] == 4.5).all()
    assert seen.sum() == {270: 55, 180: 37}.get(round(ends[1] - ends[0]), 71)


def single(count: int = 360, **readings: float) -> np.ndarray:
    """71 sectors of a scan of 1 degree a beam whose other beams return nothing."""
    ranges = np.full(count, np.inf)
    for degrees, reading in readings.items():
        ranges[int(degrees.removeprefix("at_")) % 360] = reading
    scan = Scan(ranges, 0.0, math.radians(1), 0.1, 12.0)
    # All of the circle is covered: nothing may read as unseen.
    return scan_to_sectors(scan, SECTORS, FAR, mount=Mount(), unseen=0.5)


def test_a_thin_post_is_seen_in_its_sector_alone() -> None:
    found = single(at_90=1.5)
    assert found[53] == 1.5  # -175 + 53 x 5 = 90 degrees, to the left.
    assert (np.delete(found, 53) == FAR).all()
    assert single(at_2=1.5)[35] == 1.5  # Within 2.5 degrees of straight ahead.
    assert single(at_3=1.5)[[35, 36]].tolist() == [FAR, 1.5]
    assert (single(at_180=1.5) == FAR).all()  # Behind it sees nothing.
    assert single(at_90=2.0, at_91=1.0, at_89=3.0)[53] == 1.0


@pytest.mark.parametrize(
    ("reading", "expected"),
    [
        (math.nan, FAR),
        (math.inf, FAR),
        (0.0, FAR),
        (0.05, FAR),
        (-math.inf, 0.1),
        (13.0, FAR),
        (7.0, FAR),
        (0.1, 0.1),
    ],
)
def test_what_is_no_reading_is_nothing_there(reading: float, expected: float) -> None:
    found = single(at_0=2.0, at_90=reading)
    assert found[53] == pytest.approx(expected)
    assert found[35] == 2.0


@pytest.mark.parametrize("reading", [math.nan, math.inf, 0.0, 99.0])
def test_a_scan_without_returns_is_no_open_space(reading: float) -> None:
    scan = Scan(np.full(360, reading), 0.0, math.radians(1), 0.1, 12.0)
    with pytest.raises(ValueError, match="none of the 360 beams"):
        scan_to_sectors(scan, SECTORS, FAR, mount=Mount(), unseen=FAR)


@pytest.mark.parametrize(
    ("angles", "mount", "reason"),
    [
        ((0.0, 0.0), Mount(), "all 9 beams of the scan point the same way"),
        ((math.nan, 0.1), Mount(), "not finite"),
        ((0.0, math.inf), Mount(), "not finite"),
        ((0.0, 0.1), Mount(yaw=math.nan), "not finite"),
        ((0.0, 0.1), Mount(x=math.nan), "not finite"),
    ],
)
def test_beams_that_point_nowhere_are_no_open_space(
    angles: tuple[float, float], mount: Mount, reason: str
) -> None:
    scan = Scan(np.full(9, 1.0), *angles, 0.1, 12.0)
    with pytest.raises(ValueError, match=reason):
        scan_to_sectors(scan, SECTORS, FAR, mount=mount, unseen=FAR)


@pytest.mark.parametrize(
    ("count", "increment"), [(1, 0.1), (2, 1e-12), (400, 1e-12), (80, math.radians(1))]
)
def test_a_scan_of_a_few_directions_is_no_open_space(count: int, increment: float) -> None:
    scan = Scan(np.full(count, 1.0), 0.0, increment, 0.1, 12.0)
    with pytest.raises(ValueError, match="of the 71 directions only"):
        scan_to_sectors(scan, SECTORS, FAR, mount=Mount(), unseen=FAR)


def test_a_scan_of_a_quarter_of_the_directions_will_do() -> None:
    scan = Scan(np.full(96, 1.0), math.radians(-48), math.radians(1), 0.1, 12.0)
    # Every 5 degrees from -50 to 45: 50 degrees is 3 degrees from the last beam, more than a half.
    sectors = scan_to_sectors(scan, SECTORS, FAR, mount=Mount(), unseen=FAR)
    np.testing.assert_allclose(np.sort(sectors), [1.0] * 20 + [FAR] * 51)


@pytest.mark.parametrize(("reading", "limit"), [(math.inf, math.inf), (1.0, 0.0), (1.0, math.nan)])
def test_a_limit_makes_nothing_a_return(reading: float, limit: float) -> None:
    scan = Scan(np.full(360, reading), 0.0, math.radians(1), 0.1, limit)
    with pytest.raises(ValueError, match="none of the 360 beams"):
        scan_to_sectors(scan, SECTORS, FAR, mount=Mount(), unseen=FAR)


@given(st.integers(12, 800), st.integers(0, 359), st.booleans(), st.integers(0, 799))
def test_no_return_in_view_is_lost(count: int, first: int, clockwise: bool, index: int) -> None:
    step = (-1 if clockwise else 1) * 360 / count
    ranges = np.full(count, np.inf)
    ranges[index % count] = 1.0
    direction = math.radians(first + step * (index % count))
    scan = Scan(ranges, math.radians(first), math.radians(step), 0.1, 12.0)
    found = scan_to_sectors(scan, SECTORS, FAR, mount=Mount(), unseen=FAR)
    gaps = np.abs(np.angle(np.exp(1j * (SECTORS - direction))))
    assert np.isclose(found, 1).any() == (
        gaps.min() <= max(abs(math.radians(step)), math.radians(5)) / 2
    )
    if gaps.min() <= math.radians(2.4):
        assert found[gaps.argmin()] == pytest.approx(1)


def test_the_goal_is_seen_from_the_robot() -> None:
    for pose, goal, distance, degrees in (
        ((1, 1, 0), (1, 3), 2, 90),
        ((0, 0, math.pi / 2), (0, 3), 3, 0),
        ((0, 0, -3), (-1, 0.0), 1, math.degrees(3) - 180),
        ((2, 2, math.pi), (3, 2), 1, -180),
    ):
        found = goal_in_robot_frame(pose, goal)
        assert found == pytest.approx((distance, math.radians(degrees)))


def test_commands_keep_their_arc_within_the_caps() -> None:
    assert limited((2.5, 0.0), 0.5, 1.0) == (0.5, 0.0)
    assert limited((-1.25, 0.0), 0.5, 1.0) == (-0.5, 0.0)
    assert limited((0.0, -3.0), 0.5, 1.0) == (0.0, -1.0)
    assert limited((1.0, 1.0), 0.5, 1.0) == (0.5, 0.5)
    assert limited((0.2, 0.3), 0.5, 1.0) == (0.2, 0.3)
    with pytest.raises(ValueError, match="finite"):
        limited((math.nan, 0.0), 0.5, 1.0)


def test_quaternions_give_yaw_and_what_is_upside_down() -> None:
    half = math.radians(30)
    assert yaw_of(0, 0, math.sin(half), math.cos(half)) == pytest.approx(math.radians(60))
    assert not is_upside_down(0, 0, math.sin(half), math.cos(half))
    assert is_upside_down(1, 0, 0, 0)
    assert is_upside_down(math.cos(half), math.sin(half), 0, 0)


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.5))
def test_body_and_bumper_are_those_of_the_simulator(seed: int, width: float) -> None:
    rng = np.random.default_rng(seed)
    ranges = np.where(rng.random(71) < 0.3, FAR, rng.uniform(0.05, FAR, 71))
    theirs = env_thickened(ranges, SECTORS, margin=width, max_range=FAR)
    ours = thickened(ranges, SECTORS, width, FAR)
    # A beam that grazes a disc meets it in one precision and not in the other.
    assert (np.abs(ours - theirs) < 5e-3).sum() >= 69
    near = np.where(ranges < FAR, ranges / 6, FAR)
    for travel in (0.25, -0.125, 0.0):
        body: Any = {"radius": width / 2, "max_range": FAR}
        clearly = (
            is_blocked(near, SECTORS, travel, reach=width + shift, **body)
            for shift in (-1e-4, 1e-4)
        )
        expected = env_is_blocked(near, SECTORS, jnp.float32(travel), reach=width, **body)
        assert bool(expected) in clearly
