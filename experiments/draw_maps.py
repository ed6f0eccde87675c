"""Draw the project's own maps into maps/, as ROS map_server YAML and PNG. Deterministic.

    python experiments/draw_maps.py [--out FOLDER] [NAME ...]

A map is a function that returns an `OccupancyMap`; `MAPS` lists them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sqn_jax.maps import OccupancyMap, cells_to_points, save_map, validate

ROBOT_RADIUS = 0.1  # m
RESOLUTION = 0.05  # m per cell
WALL = 3  # cells, 0.15 m

# North is up; a cell is two characters wide and one high, `*` marks an evaluation point. Loops, so
# that there is more than one way; dead ends, so that walking towards the goal is not enough.
MAZE_SIZE = 340  # cells, 17 m
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
      marked, all_cells: the centres (x, y) [.., 2] in m of the plan's cells marked `*`, and of all.
    """
    lines = plan.strip("\n").splitlines()[::-1]
    count = len(lines) // 2
    edges = [k * (size - WALL) // count for k in range(count + 1)]
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
    occupied, (marked, middles) = parse_plan(MAZE, MAZE_SIZE)
    return OccupancyMap(
        name="maze",
        occupied=occupied,
        resolution=RESOLUTION,
        spawn_points=middles.round(3),
        evaluation_points=marked.round(3),
        spawn_radius=0.5,
        max_steps=400,
    )


MAPS: dict[str, Callable[[], OccupancyMap]] = {"maze": draw_maze}


def main() -> None:
    """Draw the named maps, or all of them."""
    parser = argparse.ArgumentParser(description="Draw the project's own maps.")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", choices=[*MAPS, []], help=f"{', '.join(MAPS)}; all"
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "maps")
    arguments = parser.parse_args()
    for name in arguments.names or MAPS:
        drawn = MAPS[name]()
        validate(drawn, ROBOT_RADIUS)
        save_map(drawn, arguments.out / f"{name}.yaml")
        print(arguments.out / f"{name}.yaml")


if __name__ == "__main__":
    main()
