"""Draw the project's own maps into maps/, as ROS map_server YAML and PNG. Deterministic.

    python experiments/draw_maps.py [--out FOLDER] [NAME ...]
    python experiments/draw_maps.py --generate KIND --seeds SEED ... [--out FOLDER]

A map is a function that returns an `OccupancyMap`; `MAPS` lists them. With --generate the script
writes procedural maps of the same kinds instead, as KIND-SEED.yaml.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sqn_jax.config.map_names import KINDS
from sqn_jax.maps import OccupancyMap, cells_to_points, save_map, validate
from sqn_jax.maps.generate import generate
from sqn_jax.maps.terrain import (
    CAVE_SIZE,
    RESOLUTION,
    ROBOT_RADIUS,
    SMALL_SIZE,
    WALL,
    asterisk,
    carve_tunnels,
    disc,
    finish_map,
    round_crooks,
    wall_edges,
    walled_square,
)

# North is up; a cell is two characters wide and one high, `*` marks an evaluation point. Loops, so
# that there is more than one way; dead ends, so that walking towards the goal is not enough.
MAZE = """
+--+--+--+--+--+--+--+--+
|  |              | *   |
+  +  +  +  +--+--+--+  +
|     |  |           |  |
+  +--+  +--+  +  +  +  +
| *|     |     |  |     |
+--+  +  +  +--+--+--+  +
|     |                 |
+  +--+  +  +--+--+--+  +
|     |  |           |  |
+  +  +--+  +--+--+  +  +
|  |  |        | *   |  |
+  +  +--+  +  +  +--+  +
|  |     |  |     |     |
+  +--+  +--+  +  +--+  +
|    *|        |        |
+--+--+--+--+--+--+--+--+
"""


def parse_plan(plan: str, size: int) -> tuple[NDArray[np.bool_], list[NDArray[np.float64]]]:
    """Rasterise a plan of `+--+` walls.

    Returns:
      occupied: bool [size, size], row 0 at the bottom.
      marked, all_cells: the centers (x, y) [.., 2] in m of the plan's cells marked `*`, and of all.
    """
    lines = plan.strip("\n").splitlines()[::-1]
    count = len(lines) // 2
    edges = wall_edges(count, size)
    occupied = np.zeros((size, size), dtype=bool)
    marked, all_cells = [], []
    for i, line in enumerate(lines):
        for j in range(2 * count + 1):
            row, col = edges[i // 2], edges[j // 2]
            # Even lines and characters are walls and posts, odd ones the spans between them.
            text = line[3 * (j // 2) + (j % 2) :][: 1 + j % 2]
            rows = slice(row, edges[i // 2 + i % 2] + WALL)
            cols = slice(col, edges[j // 2 + j % 2] + WALL)
            if i % 2 and j % 2:
                middle = (np.array([rows.start + rows.stop, cols.start + cols.stop]) - 1) / 2
                all_cells.append(middle)
                if "*" in text:
                    marked.append(middle)
            elif text.strip():
                occupied[rows, cols] = True
    # What is left over by the division makes the last wall thicker.
    occupied[:, edges[-1] :] = occupied[edges[-1] :, :] = True
    return occupied, [cells_to_points(np.array(group), RESOLUTION) for group in (marked, all_cells)]


def draw_maze() -> OccupancyMap:
    """The Maze: 17 x 17 m of corridors about 2 m wide; spawn points in the middle of every cell."""
    occupied, (marked, middles) = parse_plan(MAZE, SMALL_SIZE)
    return OccupancyMap(
        name="maze",
        occupied=occupied,
        resolution=RESOLUTION,
        spawn_points=middles.round(3),
        evaluation_points=marked.round(3),
        spawn_radius=0.5,
        max_steps=400,
    )


# Pillars: x m, y m, radius m. The middle of the map stays open.
COLUMN = (
    *((3.9, 14.6, 0.55), (6.9, 15.1, 0.35), (9.6, 14.2, 0.9), (12.6, 14.9, 0.45)),
    *((15.0, 13.4, 0.7), (1.9, 12.3, 0.7), (4.6, 12.2, 0.4), (6.6, 12.9, 0.3)),
    *((12.4, 12.3, 0.6), (14.0, 10.6, 0.35), (3.6, 9.9, 0.85), (1.5, 8.9, 0.3)),
    *((15.3, 8.6, 0.8), (13.2, 8.2, 0.4), (2.4, 6.9, 0.5), (4.4, 6.1, 0.35)),
    *((14.0, 5.9, 0.5), (12.2, 4.8, 0.9), (2.0, 4.2, 0.9), (5.0, 3.7, 0.75)),
    *((7.6, 4.1, 0.3), (9.2, 2.7, 0.8), (3.6, 1.6, 0.35), (6.6, 1.5, 0.5)),
    *((12.0, 1.7, 0.4), (14.7, 3.5, 0.4)),
)

# Asterisks: x m, y m, the arms as (direction in degrees, length m).
FOREST = (
    (3.9, 3.8, ((5, 0.9), (62, 1.2), (140, 1.5), (196, 1.2), (274, 1.5), (320, 1.0))),
    (8.4, 2.5, ((20, 1.5), (88, 1.1), (150, 1.3), (215, 1.5), (300, 1.2))),
    (13.2, 2.9, ((0, 1.5), (58, 1.2), (118, 1.6), (182, 1.2), (240, 1.5), (305, 1.1))),
    (1.9, 7.5, ((12, 1.2), (95, 1.4), (170, 0.9), (250, 1.3), (318, 1.5))),
    (6.6, 6.5, ((30, 1.3), (92, 1.5), (148, 1.4), (205, 1.0), (262, 1.2), (335, 1.6))),
    (11.0, 6.2, ((15, 1.3), (75, 1.1), (150, 1.4), (222, 1.1), (290, 1.6))),
    (15.0, 6.9, ((35, 1.1), (110, 1.5), (175, 1.3), (245, 1.2), (310, 1.3))),
    (4.6, 10.4, ((10, 1.6), (70, 1.0), (128, 1.5), (188, 1.4), (245, 1.0), (300, 1.5))),
    (9.0, 9.6, ((0, 1.4), (48, 1.1), (112, 1.6), (170, 1.2), (265, 1.5), (318, 1.3))),
    (13.1, 10.3, ((22, 1.5), (85, 1.1), (140, 1.6), (200, 1.3), (282, 1.6))),
    (2.0, 13.6, ((40, 1.4), (100, 1.6), (165, 1.0), (230, 1.2), (340, 1.5))),
    (6.5, 14.3, ((15, 1.3), (80, 1.5), (145, 1.6), (210, 1.4), (275, 1.5), (330, 1.2))),
    (10.6, 13.6, ((28, 1.2), (90, 1.7), (160, 1.4), (222, 1.2), (285, 1.2), (345, 1.1))),
    (14.0, 13.9, ((8, 1.5), (60, 0.9), (125, 1.5), (185, 1.1), (258, 1.5), (310, 1.2))),
)
FOREST_ARM = 0.11  # m, half the width of an arm

# Tunnels: the course as (x m, y m, half the width m). The first runs from the start in the lower
# left past four forks to the goal in the upper right; the fork named in the paper is at (35, 31).
CAVE_FORK = (35.0, 31.0, 2.0)
CAVE = (
    (
        *((5.0, 6.0, 1.7), (9.0, 3.5, 1.2), (14.0, 5.0, 1.5), (17.5, 9.0, 1.9)),
        *((22.0, 12.5, 1.2), (19.5, 17.5, 1.4), (14.5, 18.5, 1.9)),
    ),
    (
        *((14.5, 18.5, 1.9), (10.5, 16.0, 1.2), (6.0, 18.5, 1.5), (5.0, 23.5, 1.2)),
        *((9.0, 26.0, 1.4), (6.0, 30.0, 1.1), (10.0, 33.0, 2.0)),
    ),
    ((10.0, 33.0, 2.0), (15.5, 34.0, 1.2), (18.5, 28.0, 1.4), (24.0, 28.5, 2.0)),
    ((24.0, 28.5, 2.0), (27.5, 24.5, 1.2), (31.0, 28.5, 1.4), CAVE_FORK),
    # From the fork on to the goal: first away from it, then up along the right side.
    (
        *(CAVE_FORK, (38.0, 30.0, 1.4), (40.5, 25.0, 1.3), (45.0, 25.5, 1.4), (47.0, 29.5, 1.3)),
        *((44.0, 33.5, 1.5), (48.0, 38.0, 1.2), (44.5, 41.5, 1.3), (46.0, 46.0, 1.9)),
    ),
    # From the fork straight towards the goal, and to an end.
    (
        *(CAVE_FORK, (36.5, 34.5, 1.5), (40.0, 36.5, 1.3), (36.0, 41.5, 1.4)),
        *((37.5, 46.5, 1.7), (41.0, 46.0, 1.3)),
    ),
    # The lower right: two more dead ends.
    (
        *((17.5, 9.0, 1.9), (22.5, 4.5, 1.3), (28.0, 8.5, 1.4), (32.0, 6.5, 1.9)),
        *((38.0, 3.5, 1.2), (42.5, 9.0, 1.5), (47.5, 12.0, 1.3), (44.0, 18.0, 1.7)),
    ),
    ((32.0, 6.5, 1.9), (34.5, 12.0, 1.3), (29.5, 15.5, 1.2), (36.0, 19.5, 1.6)),
    # Towards the goal from the second fork, and to an end.
    ((14.5, 18.5, 1.9), (17.5, 23.5, 1.2), (22.5, 19.0, 1.4), (27.0, 20.0, 1.6)),
    # A loop in the upper left, with an end of its own.
    (
        *((10.0, 33.0, 2.0), (5.0, 37.0, 1.3), (8.5, 41.0, 1.2), (6.5, 46.0, 1.6)),
        *((13.0, 46.5, 1.4), (16.5, 42.0, 1.3), (21.5, 41.5, 1.9)),
    ),
    ((21.5, 41.5, 1.9), (24.5, 36.5, 1.2), (20.5, 33.0, 1.1), (24.0, 28.5, 2.0)),
    ((21.5, 41.5, 1.9), (26.0, 39.5, 1.3), (27.5, 46.0, 1.4), (32.0, 45.5, 1.7)),
)
CAVE_ROUGHNESS = 6  # seed of the walls' roughness


def draw_column() -> OccupancyMap:
    """Column: round pillars about an open middle; start in the upper left, goal in the lower right.

    The oracle needs 82 steps or more, by the heading at the start.
    """
    occupied = walled_square(SMALL_SIZE)
    for x, y, radius in COLUMN:
        where, cells = disc(SMALL_SIZE, (x, y), radius)
        occupied[where] |= cells
    return finish_map("column", occupied, [(1.5, 15.5), (15.5, 1.5)], spawn_count=40, clearance=0.6)


def draw_forest() -> OccupancyMap:
    """Forest: asterisks that trap; start in the lower left, goal in the upper right.

    The oracle needs 92 steps or more, by the heading at the start.
    """
    occupied = walled_square(SMALL_SIZE)
    for x, y, arms in FOREST:
        angles = [math.radians(direction) for direction, _ in arms]
        lengths = [length for _, length in arms]
        where, cells = asterisk(SMALL_SIZE, (x, y), angles, lengths, FOREST_ARM)
        occupied[where] |= cells
    occupied = round_crooks(occupied)
    return finish_map("forest", occupied, [(1.5, 1.5), (15.5, 15.5)], spawn_count=40, clearance=0.5)


def draw_cave() -> OccupancyMap:
    """Cave: 51 x 51 m of rough tunnels; start in the lower left, goal in the upper right.

    The oracle needs 485 steps or more, by the heading at the start.
    """
    rng = np.random.Generator(np.random.PCG64(CAVE_ROUGHNESS))
    return finish_map(
        "cave",
        carve_tunnels(CAVE_SIZE, CAVE, rng),
        [(5.0, 6.0), (46.0, 46.0)],
        spawn_count=100,
        clearance=0.7,
        max_steps=1200,
    )


MAPS: dict[str, Callable[[], OccupancyMap]] = {
    "maze": draw_maze,
    "column": draw_column,
    "forest": draw_forest,
    "cave": draw_cave,
}


def main() -> None:
    """Draw the named maps, or all of them; or generate further ones."""
    parser = argparse.ArgumentParser(description="Draw the project's own maps, or generate others.")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", choices=[*MAPS, []], help=f"{', '.join(MAPS)}; all"
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "maps")
    parser.add_argument("--generate", choices=KINDS, help="write procedural maps of this kind")
    parser.add_argument("--seeds", type=int, nargs="+", help="one map each", metavar="SEED")
    arguments = parser.parse_args()
    if bool(arguments.generate) != bool(arguments.seeds) or (arguments.seeds and arguments.names):
        parser.error("--generate and --seeds belong together, and take no NAME")
    if arguments.seeds and min(arguments.seeds) < 0:
        parser.error("--seeds takes whole numbers >= 0")
    makers: Sequence[Callable[[], OccupancyMap]]
    if arguments.generate:
        makers = [partial(generate, arguments.generate, seed) for seed in arguments.seeds]
    else:
        makers = [MAPS[name] for name in arguments.names or MAPS]
    for make in makers:
        drawn = make()
        validate(drawn, ROBOT_RADIUS)
        path = arguments.out / f"{drawn.name}.yaml"
        try:
            arguments.out.mkdir(parents=True, exist_ok=True)
            save_map(drawn, path)
        except (OSError, ValueError) as error:
            parser.error(str(error))
        print(path)


if __name__ == "__main__":
    main()
