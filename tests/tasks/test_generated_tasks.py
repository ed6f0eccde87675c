"""Generated suites: which pair is the hardest, and that a task is the same each time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sqn_jax.cli import main
from sqn_jax.config.map_names import ProceduralMap
from sqn_jax.maps import load_map, traversable
from sqn_jax.maps.distance import goal_distance
from sqn_jax.maps.occupancy import points_to_cells
from sqn_jax.tasks import check_tasks, read_suite
from sqn_jax.tasks.generate import generate_tasks, hardest_pair, hardest_task


@pytest.mark.parametrize(
    ("paths", "straight", "expected"),
    [
        # 12 m with a detour of 1.5, 9 m of 3, 20 m of 1.25: the longest that winds.
        ([[20.0, 9.0], [12.0, 5.0]], [[16.0, 3.0], [8.0, 4.0]], (1, 0)),
        # None winds: the largest detour, 1.4.
        ([[20.0, 9.0], [7.0, 5.0]], [[16.0, 9.0], [5.0, 4.0]], (1, 0)),
        # Around a wall, but 0.5 m apart; and a place that cannot be reached.
        ([[9.0, np.inf], [6.0, 5.0]], [[0.5, 3.0], [5.0, 3.0]], (1, 1)),
    ],
)
def test_the_hardest_pair(
    paths: list[list[float]], straight: list[list[float]], expected: tuple[int, int]
) -> None:
    assert hardest_pair(np.array(paths), np.array(straight)) == expected


def test_a_task_of_a_maze_winds_and_its_path_is_the_shortest(tmp_path: Path) -> None:
    out = tmp_path / "fresh.json"
    arguments = ["tasks", "generate", "--kinds", "maze", "--count", "2", "--seed", "5000"]
    assert main([*arguments, "--num-processes", "1", "--out", str(out)]) == 0
    suite = read_suite(out)
    assert [task.map_file for task in suite.tasks] == ["maze:5000", "maze:5001"]
    check_tasks(suite, load_map)
    assert hardest_task(ProceduralMap("maze", 5001)) == suite.tasks[1]
    for task in suite.tasks:
        occupancy_map = load_map(task.map_file)
        free = traversable(occupancy_map.occupied, 0.05, 0.1)
        # From the other end: as long there as back, up to the straight pieces at the ends.
        field = goal_distance(free, 0.05, np.array(task.start))
        row, column = points_to_cells(task.goal, 0.05)
        assert task.shortest_path == pytest.approx(field[row, column], rel=0.01)
        assert task.shortest_path is not None
        straight = float(np.hypot(*np.subtract(task.goal, task.start)))
        assert task.shortest_path >= 1.5 * straight
        # 0.25 m a step, four times as many as needed, and 400 at least.
        assert task.max_steps == max(400, int(np.ceil(task.shortest_path * 16 - 1e-3)))


@pytest.mark.parametrize(
    ("kinds", "count", "seed", "words"),
    [
        (["maze", "maze"], 1, 5000, "kinds"),
        (["house"], 1, 5000, "kinds"),
        (["maze"], 0, 5000, "count"),
        (["maze", "cave"], 50_001, 5000, "count"),
        (["maze"], 1, 999, "trained"),
        (["maze"], 2, 999_999_999, "seed"),
    ],
)
def test_numbers_out_of_range(kinds: list[str], count: int, seed: int, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        generate_tasks(kinds, count, seed)
