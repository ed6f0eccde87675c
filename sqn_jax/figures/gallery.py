"""The maps side by side."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from sqn_jax.figures.style import COLOURS, DPI, OBSTACLE, WIDTH_IN
from sqn_jax.maps import OccupancyMap


def map_gallery(maps: Sequence[OccupancyMap]) -> Figure:
    """One panel a map, axes in m, its evaluation points numbered.

    Raises:
        ValueError: there are no maps.
    """
    if not maps:
        raise ValueError("no maps, expected at least one")
    height = WIDTH_IN / len(maps) + 0.45
    figure = Figure(figsize=(WIDTH_IN, height), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, occupancy_map in zip(panels, maps, strict=True):
        width_m, height_m = occupancy_map.size_m
        axes.imshow(
            occupancy_map.occupied,
            origin="lower",
            extent=(0, width_m, 0, height_m),
            cmap=ListedColormap(["#f7f7f4", OBSTACLE]),
            interpolation="nearest",
        )
        for number, (x, y) in enumerate(occupancy_map.evaluation_points, start=1):
            axes.plot(x, y, marker="o", ms=11, color=COLOURS[1], mec="white")
            style = {"color": "white", "fontsize": 7, "fontweight": "bold"}
            axes.annotate(str(number), (x, y), ha="center", va="center", **style)
        axes.set_title(f"{occupancy_map.name}, {width_m:g} x {height_m:g} m", fontsize=10)
        axes.tick_params(labelsize=7)
        axes.set_xlabel("x [m]", fontsize=8)
    panels[0].set_ylabel("y [m]", fontsize=8)
    return figure
