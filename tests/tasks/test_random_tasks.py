"""Random pairs on maps of one's own: where places lie, how long episodes are, what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sqn_jax.cli import main
from sqn_jax.maps import OccupancyMap, load_map
from sqn_jax.tasks import check_tasks, read_suite
from sqn_jax.tasks.pairs import random_tasks

TURNED = (10.0, -4.0, np.pi / 2)


def two_rooms() -> OccupancyMap:
    """Rooms of 6 x 4 m and 1 x 4 m without a door between them; the spawn points are in the first.

    The map's frame is turned by 90 degrees against the grid.
    """
    occupied = np.ones((40, 80), bool)
    occupied[:, 2:62] = False
    occupied[:, 68:78] = False
    occupied[[0, -1]] = True
    points = np.array([[1.05, 1.05], [5.05, 3.05]])
    return OccupancyMap(
        name="two_rooms",
        occupied=occupied,
        resolution=0.1,
        origin=TURNED,
        spawn_points=points,
        evaluation_points=points,
        spawn_radius=0.5,
        max_steps=100,
    )


def in_grid_frame(place: tuple[float, float]) -> tuple[float, float]:
    """By hand: a quarter turn back about the origin."""
    x, y = place[0] - TURNED[0], place[1] - TURNED[1]
    return y, -x


def test_places_lie_where_the_robot_gets_to_and_paths_are_straight_in_an_empty_room() -> None:
    drawn = random_tasks(two_rooms(), 40, robot_radius=0.2, limit=3.0)
    assert len(drawn.tasks) == 40
    ends = np.array([[in_grid_frame(task.start), in_grid_frame(task.goal)] for task in drawn.tasks])
    x, y = np.moveaxis(ends, -1, 0)
    # The walls of the first room are at x = 0.2 and 6.2 m, y = 0.1 and 3.9 m; 0.2 m from them.
    assert x.min() > 0.4
    assert x.max() < 6.0
    assert y.min() > 0.3
    assert y.max() < 3.7
    assert np.ptp(x) > 4.0
    assert np.ptp(y) > 2.5
    straight = np.hypot(*(ends[:, 0] - ends[:, 1]).T)
    lengths = np.array([task.shortest_path for task in drawn.tasks])
    # Paths of 32 directions are at most 1.4 % longer than the straight line.
    assert (lengths >= straight - 1e-3).all()
    assert (lengths <= 1.02 * straight + 0.01).all()
    assert (lengths >= 1.0).all()
    # 2.5 m/s for 0.1 s are 0.25 m a step.
    assert [task.max_steps for task in drawn.tasks] == [int(np.ceil(12 * n)) for n in lengths]


def test_the_same_seed_gives_the_same_tasks_and_another_others() -> None:
    first, again, other = (random_tasks(two_rooms(), 5, seed).tasks for seed in (0, 0, 1))
    assert first == again
    assert first != other


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"count": 0}, "count: 0, expected 1"),
        ({"seed": -1}, "seed: -1"),
        ({"limit": 0.5}, "limit: 0.5"),
        ({"limit": float("nan")}, "limit: nan"),
        ({"limit": 50_000.0}, "steps, expected at most"),
    ],
)
def test_numbers_out_of_range(options: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        random_tasks(two_rooms(), **options)  # type: ignore[arg-type]


def test_a_closet_has_no_room_for_a_task() -> None:
    closet = dataclasses.replace(two_rooms(), spawn_points=np.array([[7.15, 1.05], [7.25, 1.05]]))
    occupied = closet.occupied.copy()
    occupied[15:, 68:78] = True
    closet = dataclasses.replace(closet, occupied=occupied)
    with pytest.raises(ValueError, match=r"^map two_rooms: .* cells, expected room for"):
        random_tasks(closet, 3, robot_radius=0.35)


def test_from_a_map_file_to_a_suite_that_can_be_moved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pixels = np.where(two_rooms().occupied[::-1], 0, 254).astype(np.uint8)
    source = tmp_path / "source"
    source.mkdir()
    Image.fromarray(pixels).save(source / "home.png")
    (source / "home.yaml").write_text(
        "image: home.png\nresolution: 0.1\norigin: [10.0, -4.0, 1.5707963]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    out = tmp_path / "suite" / "mine.json"
    out.parent.mkdir()
    arguments = ["tasks", "pairs", str(source / "home.yaml"), "maze:3", "--count", "4"]
    assert main([*arguments, "--robot-radius", "0.2", "--out", str(out)]) == 0
    assert "8 tasks on 2 maps" in capsys.readouterr().out
    moved = tmp_path / "moved"
    out.parent.rename(moved)
    suite = read_suite(moved / "mine.json")
    assert dict(suite.robot) == {"robot_radius": 0.2}
    assert [Path(task.map_file).name for task in suite.tasks[3:5]] == ["home.yaml", "maze_3.yaml"]
    check_tasks(suite, load_map)


def test_several_maps_in_one_are_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "mine.json")
    assert main(["tasks", "pairs", "maze:0-1", "--out", out]) == 2
    assert "maze:0-1: several maps, expected one" in capsys.readouterr().err
    assert main(["tasks", "pairs", "maze:0", "--robot-radius", "-1", "--out", out]) == 2
    assert "robot_radius" in capsys.readouterr().err
