"""Films of hand-made episodes, read back from their pixels and from the decoded files."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import changed, episode_of
from numpy.typing import NDArray
from PIL import Image

from sqn_jax.env.coverage import Lattice
from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures import animation
from sqn_jax.figures.animation import frames, gif, mp4, shown_steps
from sqn_jax.figures.screen import Screen
from sqn_jax.maps import OccupancyMap

STEPS = 60
# What the colours of the film mean, as they are seen.
ROBOT, SEEN, WALL, STAR = (0xE6, 0x9F, 0), (0xCF, 0xE3, 0xC8), (0x33, 0x3A, 0x42), (255, 217, 47)
BLUE, VERMILLION, GREEN, RED = (0, 0x72, 0xB2), (0xD5, 0x5E, 0), (0, 0x70, 0x4F), (0xB0, 0, 0x20)
# Of a frame of 800 x 580: the room of 6 x 4 m in a box of 496 pixels at (12, 44), centred in it.
PER_METRE = 496 / 6
LEFT, TOP, ROWS = 12, 44 + (496 - 331) // 2, 331
VIEW_CENTRE, VIEW_PER_METRE = (534 + 127, 62 + 127), 254 / 10.4
SKILL_ROW = 346 + 8


def seen_within(lattice: Lattice, x: float, y: float, radius: float) -> NDArray[np.uint32]:
    """A `covered` array with the points within a distance of a place."""
    points = lattice.points()
    near = np.hypot(points[..., 0] - x, points[..., 1] - y) < radius
    return np.bitwise_or.reduce(near.astype(np.uint32) << np.arange(32, dtype=np.uint32), axis=-1)


def film_episode(*, arrival: int = 0, skills: int = 2, **changes: Any) -> Episode:
    """From (1, 2) m along y = 2 m, 0.05 m a step, in a room of 6 x 4 m with a wall at x = 5 m.

    The robot sees 0.2 m far; the goal at (4, 1) m is reached at step `arrival`, or not at all.
    """
    occupied = np.zeros((40, 60), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[5:25, 50:53] = True
    places = np.array([[1.0, 2.0], [4.0, 1.0]])
    lattice = Lattice.over(4.0, 6.0, 0.1, 5.0)
    x = 1.0 + 0.05 * np.arange(STEPS + 1)
    distances = np.full(STEPS, 2.0)
    if arrival:
        distances[arrival - 1 :] = 0.1
    seen = [seen_within(lattice, 2.5, 2.0, 0.2 + 0.02 * t) for t in range(STEPS + 1)]
    values: dict[str, Any] = {
        "agent": "tester",
        "occupancy_map": OccupancyMap("room", occupied, 0.1, places, places),
        "poses": np.stack([x, np.full_like(x, 2.0), np.zeros_like(x)], axis=-1),
        "goal": places[1],
        "ranges": np.full((STEPS + 1, 11), 0.2),
        "covered": np.stack(seen),
        "actions": np.zeros(STEPS, np.int32),
        "reward_parts": np.tile([0.0, 0.5, -0.25], (STEPS, 1)),
        "goal_distances": distances,
        "reachable": np.zeros(STEPS, bool),
        "collisions": np.zeros(STEPS, bool),
        "skill_weights": np.tile([0.75, 0.25] if skills == 2 else [1.0], (STEPS, 1)),
        "skill_q_values": np.zeros((STEPS, skills, 5)),
        "q_values": np.zeros((STEPS, 5)),
        "field_of_view": np.deg2rad(350),
        "max_range": 5.0,
        "goal_radius": 0.3,
        "robot_radius": 0.1,
        "time_step": 0.1,
        "lattice": lattice,
    }
    return episode_of(values | changes)


def drawn(episode: Episode, index: int) -> NDArray[np.uint8]:
    return Screen(episode, 800, 580).draw(index)[..., :3]


def places_of(frame: NDArray[np.uint8], colour: Sequence[int], *, map_only: bool = True) -> Any:
    """Columns and rows [2, P] of the pixels of a colour, on the map or right of it."""
    rows, columns = np.nonzero((frame == colour).all(axis=-1))
    inside = (columns < 508) & (rows >= TOP) & (rows < TOP + ROWS)
    chosen = inside if map_only else columns >= 520
    return np.stack([columns[chosen], rows[chosen]])


def pixel(x: float, y: float) -> tuple[int, int]:
    """Row and column of a place on the map."""
    return int(TOP + ROWS - y * PER_METRE), int(LEFT + x * PER_METRE)


def decoded(film: bytes) -> tuple[list[NDArray[np.uint8]], list[int]]:
    """The pictures of a GIF as a viewer shows them, and how many ms each."""
    pictures, durations = [], []
    with Image.open(io.BytesIO(film)) as image:
        for number in range(image.n_frames):
            image.seek(number)
            pictures.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
        assert image.info["loop"] == 0
    return pictures, durations


# ------------------------------------------------------------------------------------ which steps


def test_all_steps_are_shown_until_two_seconds_after_the_arrival() -> None:
    """Arrival at step 20 of 0.1 s."""
    np.testing.assert_array_equal(shown_steps(film_episode(arrival=20)), np.arange(41))
    np.testing.assert_array_equal(shown_steps(film_episode(arrival=55)), np.arange(61))


def test_an_episode_without_success_is_shown_whole_in_even_steps() -> None:
    np.testing.assert_array_equal(shown_steps(film_episode(), 5), [0, 15, 30, 45, 60])
    np.testing.assert_array_equal(shown_steps(film_episode(), 61), np.arange(61))


# --------------------------------------------------------------------------------------- the files


def test_a_gif_has_the_frames_the_size_and_the_durations_asked_for() -> None:
    film = gif(film_episode(), count=9, frames_per_second=10, width_px=401)
    pictures, durations = decoded(film)
    assert [picture.shape for picture in pictures] == [(290, 400, 3)] * 9
    assert durations == [100] * 8 + [1000]


def test_a_decoded_gif_shows_the_frames_that_were_drawn() -> None:
    """Up to the palette; what a frame leaves out is what did not change."""
    episode = film_episode(arrival=20)
    pictures, _ = decoded(gif(episode, count=6))
    for ours, theirs in zip(frames(episode, count=6), pictures, strict=True):
        apart = np.abs(ours.astype(int) - theirs).max(axis=-1)
        assert apart.mean() < 0.5
        assert np.quantile(apart, 0.999) < 40
        for colour in (ROBOT, SEEN, STAR, WALL, (255, 255, 255)):
            assert (theirs[(ours == colour).all(axis=-1)] == colour).all()


def test_what_does_not_change_takes_hardly_any_room_in_a_gif() -> None:
    """A robot that stands still: 20 more frames of little but the words and the reward lines."""
    still = film_episode()
    poses, covered = still.poses[[0] * (STEPS + 1)], still.trajectory.covered[[0] * (STEPS + 1)]
    still = changed(still, poses=poses, covered=covered)
    assert len(gif(still, count=22)) - len(gif(still, count=2)) < 20 * 4_000


def test_rare_colours_that_mean_something_keep_their_place_in_a_palette() -> None:
    """Against a picture of nothing but noise, which fills any palette."""
    noise = np.random.default_rng(0).integers(0, 256, (100, 100, 4), np.uint8)
    palette = animation._Palette([noise])
    for colour in (ROBOT, SEEN, WALL, STAR, BLUE, VERMILLION, GREEN, RED, (255, 255, 255)):
        (index,) = palette.indices(np.array([[(*colour, 255)]], np.uint8))[0]
        assert tuple(palette.table[index]) == colour
    nearest = palette.indices(noise)
    apart = np.abs(noise[:, :, None, :3].astype(int) - palette.table[None, None, :255]).sum(axis=-1)
    chosen = np.take_along_axis(apart, nearest[..., None].astype(int), axis=2)[..., 0]
    assert (chosen <= 2 * apart.min(axis=-1)).all()
    assert nearest.max() < 255


def test_an_mp4_has_the_frames_asked_for_and_a_second_at_its_end(tmp_path: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "film.mp4"
    mp4(path, film_episode(), count=9, frames_per_second=10, width_px=400)
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert (count, seconds) == (9 + 9, pytest.approx(1.8))
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]


def test_without_imageio_ffmpeg_an_mp4_is_refused_by_the_name_of_the_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ValueError, match=r"sqn_jax\[video\]"):
        mp4(tmp_path / "film.mp4", film_episode())


def test_a_complaint_of_the_encoder_is_one_line_and_leaves_no_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program = tmp_path / "encoder"
    half_done = 'for last in "$@"; do :; done; echo half > "$last"'
    program.write_text(f"#!/bin/sh\n{half_done}\necho 'no such codec' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(animation, "require_mp4", lambda: str(program))
    with pytest.raises(ValueError, match=r"film.mp4: cannot be written \(ffmpeg: no such codec\)"):
        mp4(tmp_path / "film.mp4", film_episode(), count=3, width_px=320)
    assert [file.name for file in tmp_path.iterdir()] == ["encoder"]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"count": 1}, "count is 1, expected 2"),
        ({"width_px": 100}, "width_px is 100, expected 320"),
        ({"frames_per_second": 60}, "frames_per_second is 60, expected 1 to 50"),
    ],
)
def test_options_out_of_range_are_named(options: dict[str, int], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        gif(film_episode(), **options)


# ------------------------------------------------------------------------------------------ the map


@pytest.mark.parametrize("heading", [0.0, np.pi / 2, -2.0])
def test_the_robot_stands_where_its_pose_says_and_points_along_its_heading(heading: float) -> None:
    poses = film_episode().poses.copy()
    poses[:, 2] = heading
    frame = drawn(film_episode(poses=poses), 40)  # At (3, 2) m.
    row, column = pixel(3.0, 2.0)
    columns, rows = places_of(frame, ROBOT)
    assert len(rows) > 40
    assert abs(rows.mean() - row) < 4
    assert abs(columns.mean() - column) < 4
    ahead = np.rint(7 * np.array([-np.sin(heading), np.cos(heading)])).astype(int)
    assert tuple(frame[row + ahead[0], column + ahead[1]]) == ROBOT
    assert tuple(frame[row - ahead[0], column - ahead[1]]) != ROBOT


def test_the_tinted_area_grows_as_the_seen_points_do() -> None:
    episode = film_episode()
    for index in (20, 40, 60):
        tinted = places_of(drawn(episode, index), SEEN).shape[1] / PER_METRE**2
        radius = 0.2 + 0.02 * index
        # The robot, its path and the marks lie on top of some of it.
        assert 0.8 * np.pi * radius**2 < tinted < 1.05 * np.pi * radius**2


def test_the_tint_lies_where_the_points_were_seen() -> None:
    lattice = film_episode().lattice
    covered = np.stack([seen_within(lattice, 2.0, 3.2, 0.4)] * (STEPS + 1))
    columns, rows = places_of(drawn(film_episode(covered=covered), 0), SEEN)
    row, column = pixel(2.0, 3.2)
    assert abs(rows.mean() - row) < 3
    assert abs(columns.mean() - column) < 3


def test_a_wall_is_never_tinted() -> None:
    lattice = film_episode().lattice
    everything = np.stack([np.zeros(lattice.shape, np.uint32), lattice.on_map()])
    covered = everything[[0] + [1] * STEPS]
    before, after = (drawn(film_episode(covered=covered), index) for index in (0, 1))
    for x, y in [(5.15, 2.0), (5.1, 1.2), (0.05, 2.0), (3.0, 0.05), (3.0, 3.95), (5.95, 1.0)]:
        assert tuple(before[pixel(x, y)]) == tuple(after[pixel(x, y)]) == WALL, (x, y)
    for x, y in [(4.9, 2.0), (5.4, 2.0), (0.2, 0.2), (5.15, 3.2)]:
        assert tuple(before[pixel(x, y)]) != SEEN, (x, y)
        assert tuple(after[pixel(x, y)]) == SEEN, (x, y)


def test_the_path_has_the_colours_of_the_skill_weights_up_to_now() -> None:
    weights = np.repeat([[1.0, 0.0], [0.0, 1.0]], STEPS // 2, axis=0)
    frame = drawn(film_episode(skill_weights=weights), 50)
    assert tuple(frame[pixel(1.8, 2.0)]) == BLUE  # Step 16.
    assert tuple(frame[pixel(2.8, 2.0)]) == VERMILLION  # Step 36.
    assert tuple(frame[pixel(3.9, 2.0)]) not in (BLUE, VERMILLION)  # Step 58 is yet to come.


# -------------------------------------------------------------------------- the panels at the right


@pytest.mark.parametrize(
    ("heading", "goal", "expected"),
    [
        (np.pi / 2, (1.0, 3.5), (0.0, 1.5)),  # Ahead.
        (0.0, (1.0, 3.5), (-1.5, 0.0)),  # To the left.
        (0.0, (3.0, 0.5), (1.5, 2.0)),  # Ahead on the right.
        (0.0, (1.0, -8.0), (5.0, 0.0)),  # Out of range, to the right: on the rim.
    ],
)
def test_the_goal_stands_in_the_robots_view_where_it_would_see_it(
    heading: float, goal: tuple[float, float], expected: tuple[float, float]
) -> None:
    poses = film_episode().poses.copy()
    poses[:, 2] = heading
    frame = drawn(film_episode(poses=poses, goal=np.array(goal)), 0)
    columns, rows = places_of(frame, STAR, map_only=False)
    right = (columns.mean() - VIEW_CENTRE[0]) / VIEW_PER_METRE
    ahead = (VIEW_CENTRE[1] - rows.mean()) / VIEW_PER_METRE
    assert (right, ahead) == pytest.approx(expected, abs=0.12)


def test_beams_of_the_left_lie_on_the_left_of_the_robots_view() -> None:
    """Of 11 beams over 350 degrees, 35 degrees apart, the one 70 degrees to the left sees 4 m."""
    ranges = np.full((STEPS + 1, 11), 0.2)
    ranges[:, 7] = 4.0
    screen = Screen(film_episode(ranges=ranges), 800, 580)
    screen.draw(0)
    (hits,) = [line for axes in screen.figure.axes for line in axes.lines if line.get_ms() == 3]
    x, y = np.asarray(hits.get_data())[:, 7]
    assert (x, y) == pytest.approx((-4 * np.sin(np.deg2rad(70)), 4 * np.cos(np.deg2rad(70))))


def test_the_skill_bar_is_divided_as_the_weights_are() -> None:
    frame = drawn(film_episode(), 10)
    blue = (frame[SKILL_ROW] == BLUE).all(axis=-1).sum()
    vermillion = (frame[SKILL_ROW] == VERMILLION).all(axis=-1).sum()
    assert blue == pytest.approx(0.75 * 254, abs=3)
    assert vermillion == pytest.approx(0.25 * 254, abs=3)


def test_one_skill_has_no_bar() -> None:
    frame = drawn(film_episode(skills=1), 10)
    assert (frame[SKILL_ROW, 520:] == 255).all()


def test_the_reward_lines_are_the_sums_up_to_now() -> None:
    screen = Screen(film_episode(), 800, 580)
    screen.draw(10)
    lines = {line.get_label(): line for axes in screen.figure.axes for line in axes.lines}
    for name, a_step in (("navigation", 0.0), ("exploration", 0.5), ("time", -0.25)):
        seconds, sums = lines[name].get_data()
        np.testing.assert_allclose(seconds, 0.1 * np.arange(11))
        np.testing.assert_allclose(sums, a_step * np.arange(11))


# ---------------------------------------------------------------------------------------- the words


def test_the_last_frame_says_that_the_goal_was_reached_and_the_first_does_not() -> None:
    episode = film_episode(arrival=20)
    screen = Screen(episode, 800, 580)
    first, last = screen.draw(0)[..., :3], screen.draw(40)[..., :3]
    words = [text.get_text() for text in screen.figure.texts]
    # At (3, 2) m, 1.4 m from the goal at (4, 1) m.
    assert "step 40 of 60   4.0 s   1.4 m to the goal   reached at step 20" in words
    assert "tester, room" in words
    assert (last[:40] == GREEN).all(axis=-1).any()
    assert not (first[:40] == GREEN).all(axis=-1).any()
    assert tuple(screen.draw(0)[22, 700, :3]) == tuple(first[22, 700])


def test_the_last_frame_of_a_failure_says_so() -> None:
    *_, before, last = frames(film_episode(), count=5)
    assert (last[:40] == RED).all(axis=-1).any()
    assert not (before[:40] == RED).all(axis=-1).any()


def test_a_frame_does_not_depend_on_the_frames_before_it() -> None:
    screen = Screen(film_episode(), 800, 580)
    once = screen.draw(30)
    screen.draw(60)
    np.testing.assert_array_equal(screen.draw(30), once)
    np.testing.assert_array_equal(drawn(film_episode(), 30), once[..., :3])


@pytest.mark.parametrize("arrival", [0, 55])
def test_a_long_name_is_cut_where_the_words_beside_it_begin(arrival: int) -> None:
    """And is no formula, whatever is in it."""
    episode = changed(film_episode(arrival=arrival), agent="$x_{$" + 80 * "y")
    screen = Screen(episode, 400, 290)
    screen.draw(60)
    boxes = {
        text.get_text(): text.get_window_extent()
        for text in screen.figure.texts
        if ", room" in text.get_text() or "step 60" in text.get_text()
    }
    words, name = sorted(boxes)[1], sorted(boxes)[0]
    assert name.startswith("$x_{$yyy")
    assert name.endswith("y\N{HORIZONTAL ELLIPSIS}, room")
    assert 4 < boxes[words].x0 - boxes[name].x1 < 20
