"""Which episodes a report shows, and what it says of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from report_parts import batch_of, hall, line, world_of

from sqn_jax.report.episodes import Place, densest_place, worst_episodes
from sqn_jax.report.page import describe_episode


def test_the_densest_place_is_the_one_that_counting_every_pair_finds() -> None:
    rng = np.random.default_rng(0)
    for length in (1, 2, 7, 60):
        points = np.cumsum(rng.normal(0, 0.5, (length, 2)), axis=0)
        counts = [
            sum(
                (x - other_x) ** 2 + (y - other_y) ** 2 <= 1.0
                for other_x, other_y in points.tolist()
            )
            for x, y in points.tolist()
        ]
        place = densest_place(points)
        assert (place.steps, place.of) == (max(counts), length)
        (index,) = np.flatnonzero((points == [place.x, place.y]).all(axis=1))
        assert counts[index] == max(counts)


def test_among_equally_dense_places_the_middle_one_is_named() -> None:
    # All within 1 m of each other; the sums of distances are 0.9, 0.6 and 0.9 + 0.0.
    place = densest_place(np.array([[0.0, 0.0], [0.3, 0.0], [0.6, 0.0], [9.0, 9.0]]))
    assert place == Place(0.3, 0.0, 3, 4)


def test_failures_are_ranked_by_the_way_around_the_wall_not_through_it() -> None:
    world = world_of(hall())
    goal = (1.05, 3.05)
    behind_the_wall = line((5.05, 3.05), (1.05, 1.05), 8)  # 2 m off, more than 15 m to go.
    far_but_open = line((5.05, 1.05), (7.05, 3.05), 8)  # 6 m to go.
    at_hand = line((9.05, 3.05), (2.05, 3.05), 8)  # 1 m to go.
    arrived = line((9.05, 3.05), goal, 8)
    batches = [
        batch_of(world, [arrived, at_hand], [goal] * 2, [8, 0]),
        batch_of(world, [far_but_open, behind_the_wall], [goal] * 2, [0, 0]),
    ]
    found = worst_episodes(batches)
    assert [(hard.batch is batches[1], hard.episode) for hard in found] == [
        (True, 1),
        (True, 0),
        (False, 1),
    ]
    assert found[0].remaining_path > 15
    assert [hard.remaining_path for hard in found[1:]] == pytest.approx([6.0, 1.0], abs=0.1)
    assert [hard.shortest_path for hard in found] == pytest.approx(
        [4.0, found[1].shortest_path, 8.0], abs=0.1
    )


def test_too_few_failures_are_followed_by_the_slowest_beside_their_way() -> None:
    world = world_of(hall())
    goal = (1.05, 3.05)
    # 2.5 m a second and 0.1 s: 0.25 m a step. 5 m are 20 steps, 2 m are 8.
    paths = [line((6.05, 3.05), goal, 60), line((3.05, 3.05), goal, 60)]
    batch = batch_of(world, [*paths, paths[0], paths[1]], [goal] * 4, [40, 32, 0, 12])
    found = worst_episodes([batch])
    assert [hard.episode for hard in found] == [2, 1, 0]
    assert [hard.success for hard in found] == [False, True, True]
    assert found[1].slowness == pytest.approx(32 / 8, rel=0.02)
    assert found[2].slowness == pytest.approx(40 / 20, rel=0.02)
    assert len(worst_episodes([batch], count=9)) == 4
    assert [hard.remaining_path for hard in found] == pytest.approx([0.0, 0.0, 0.0], abs=0.1)


def test_the_words_say_where_a_robot_was_stuck_for_how_long_and_how_far_off() -> None:
    world = world_of(hall())
    # 12 steps, the last six of which: four at (8, 1), then away by 2 m. Before, all at (2, 1).
    path = [(2.04, 1.04)] * 7 + [(8.04, 1.04)] * 4 + [(6.04, 1.04)] * 2
    (hard,) = worst_episodes([batch_of(world, [path], [(9.04, 1.04)], [0])])
    description = describe_episode(hard)
    assert "not reached within 12 steps" in description
    assert "stuck: it spent 4 of the last 6 steps within 1 m of (8.0, 1.0) m" in description
    assert (
        "shortest path to the goal was 7.0 m from the start and 3.0 m from the end" in description
    )
    assert "from (2.0, 1.0) m to the goal at (9.0, 1.0) m" in description
    assert "There were 4 collisions." in description
    assert "sqn, training seed 4, in hall (evaluation points, episode 0" in description


def test_a_robot_that_was_nowhere_for_long_is_not_called_stuck() -> None:
    world = world_of(hall())
    path = line((1.05, 1.05), (8.65, 1.05), 8)
    (hard,) = worst_episodes([batch_of(world, [path], [(1.05, 3.05)], [0])])
    # The last four lie 0.95 m apart: the two in the middle have one neighbour on each side.
    assert "stuck: it spent 3 of the last 4 steps" in describe_episode(hard)
    swift = dataclasses.replace(hard, place=Place(6.0, 1.0, 1, 4))
    assert "stuck nowhere for long: at most it spent 1 of the last 4" in describe_episode(swift)


def test_of_a_success_only_the_way_to_the_goal_counts() -> None:
    world = world_of(hall())
    path = [(2.05, 1.05)] * 4 + [(8.05, 1.05)] * 9  # Reached at step 4, where it stays.
    (hard,) = worst_episodes([batch_of(world, [path], [(8.05, 1.05)], [4])])
    assert (hard.place.steps, hard.place.of) == (3, 4)
    assert hard.place.x == pytest.approx(2.05)
    assert hard.collisions == 1  # The third move; the others came after the arrival.
