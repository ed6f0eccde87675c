"""Suites on fresh procedural maps: one task each, the hardest of some pairs of places.

Maps are named by kind and seed ("maze:1000000"), which is all that a file needs to say.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

from sqn_jax.config.groups import EnvConfig
from sqn_jax.config.map_names import KINDS, MAX_SEED, ProceduralMap
from sqn_jax.maps.distance import goal_distance
from sqn_jax.maps.load import load_map
from sqn_jax.maps.occupancy import (
    OccupancyMap,
    cells_to_points,
    connected_components,
    points_to_cells,
    traversable,
)
from sqn_jax.tasks.suite import DEFAULT_GOAL_RADIUS, MAX_TASKS, Task, steps_along

FIRST_SEED = 1000
"""Maps of smaller seeds are those that policies are trained on and that pictures show."""
DEFAULT_SEED = 1_000_000
DETOUR = 1.5
"""A task should be so many times as long as the straight line."""
_NUM_GOALS, _NUM_STARTS = 4, 16  # of the pairs of a map: each goal with each start
_SHORTEST = 1.0  # m; a straight line is at least so long
_LIMIT_FACTOR = 4
_STREAM = 20_231  # Tasks are drawn by other numbers than their map, which has the same seed.


def generate_tasks(
    kinds: Sequence[str],
    count: int,
    seed: int = DEFAULT_SEED,
    *,
    num_processes: int = 1,
) -> Iterator[Task]:
    """A task on each of `count` fresh maps of each kind, the same for the same arguments.

    The maps of a kind are those of the seeds `seed` to `seed + count - 1`. See `hardest_task`.

    Args:
        kinds: of maps, each once.
        count: maps of each kind.
        seed: the first of the maps' seeds, at least `FIRST_SEED`.
        num_processes: how many make maps at a time.

    Raises:
        ValueError: one line: an unknown kind, or a number out of range.
    """
    for kind in kinds:
        if kind not in KINDS or list(kinds).count(kind) > 1:
            raise ValueError(f"kinds: {kind!r}, expected each once of {', '.join(KINDS)}")
    if not kinds or not 1 <= count <= MAX_TASKS // len(kinds):
        raise ValueError(f"count: {count}, expected 1 to {MAX_TASKS // max(1, len(kinds)):,}")
    if not FIRST_SEED <= seed <= MAX_SEED - count + 1:
        raise ValueError(
            f"seed: {seed}, expected {FIRST_SEED} to {MAX_SEED - count + 1} for {count} maps; "
            f"policies are trained on maps of seeds below {FIRST_SEED}"
        )
    names = [ProceduralMap(kind, seed + index) for kind in kinds for index in range(count)]
    return _tasks(names, num_processes)


def _tasks(names: Sequence[ProceduralMap], num_processes: int) -> Iterator[Task]:
    if num_processes == 1 or len(names) == 1:
        yield from map(hardest_task, names)
        return
    # Fresh processes: a fork would carry along the threads of JAX where that is loaded.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        min(num_processes, len(names)), mp_context=context, initializer=_end_with_parent
    ) as pool:
        yield from pool.map(hardest_task, names, chunksize=4)


def _end_with_parent() -> None:
    """Let signals end this process at once, and end it when the process that started it is gone."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def hardest_task(name: ProceduralMap) -> Task:
    """The hardest task among 64 candidates on a procedural map, the same each time.

    Candidates are all pairs of 4 goals and 16 starts, places drawn near spawn points as in
    training. Of those whose shortest path is at least `DETOUR` times the straight line the one
    with the longest path is the hardest; where there is none, that with the largest detour. An
    episode is as long as the map's, or four times the steps of the shortest path if that is more.
    """
    occupancy_map = load_map(name)
    radius = EnvConfig.robot_radius
    free = traversable(occupancy_map.occupied, occupancy_map.resolution, radius)
    numbers = np.random.PCG64([_STREAM, KINDS.index(name.kind), name.seed])
    places = _draw_places(occupancy_map, free, np.random.Generator(numbers))
    goals, starts = places[:_NUM_GOALS], places[_NUM_GOALS:]
    paths = np.stack(
        [
            field[tuple(points_to_cells(starts, occupancy_map.resolution).T)]
            for field in goal_distance(free, occupancy_map.resolution, goals)
        ]
    ).astype(np.float64)
    straight = np.linalg.norm(goals[:, None] - starts[None], axis=-1)
    goal, start = hardest_pair(paths, straight)
    shortest_path = float(paths[goal, start])
    (x, y), (goal_x, goal_y) = occupancy_map.to_map_frame([starts[start], goals[goal]]).round(6)
    return Task(
        map_file=str(name),
        start=(float(x), float(y)),
        heading=None,
        goal=(float(goal_x), float(goal_y)),
        max_steps=max(occupancy_map.max_steps, steps_along(_LIMIT_FACTOR * shortest_path)),
        goal_radius=DEFAULT_GOAL_RADIUS,
        shortest_path=round(shortest_path, 4),
    )


def hardest_pair(paths: NDArray[np.float64], straight: NDArray[np.float64]) -> tuple[int, int]:
    """Which pair is the hardest, see `hardest_task`: index of the goal and of the start.

    Args:
        paths: length of the shortest path of each pair [goals, starts], m; inf where none is.
        straight: of the straight line, m.
    """
    paths = np.where(np.isfinite(paths), paths, 0.0)
    detour = paths / np.maximum(straight, 1e-9)
    detour[straight < _SHORTEST] = 0.0
    winding = detour >= DETOUR
    hardest = np.where(winding, paths, 0.0) if winding.any() else detour
    goal, start = np.unravel_index(int(hardest.argmax()), hardest.shape)
    return int(goal), int(start)


def _draw_places(
    occupancy_map: OccupancyMap, free: NDArray[np.bool_], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Centers of cells near different spawn points, [goals + starts, 2]: first those of goals."""
    resolution, radius = occupancy_map.resolution, occupancy_map.spawn_radius
    points = occupancy_map.spawn_points
    labels, _ = connected_components(free)
    centers = cells_to_points(np.argwhere(free), resolution)
    own = labels[free]
    places = []
    for index in np.argsort(rng.random(len(points)), kind="stable")[: _NUM_GOALS + _NUM_STARTS]:
        row, column = points_to_cells(points[index], resolution)
        near = np.hypot(*(centers - points[index]).T) <= radius
        around = centers[near & (own == labels[row, column])]
        places.append(around[int(rng.random() * len(around))])
    return np.array(places)
