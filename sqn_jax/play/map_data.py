"""A map as data for the page."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from sqn_jax.maps import OccupancyMap


def map_data(occupancy_map: OccupancyMap) -> dict[str, Any]:
    """What `unpackMap` in `web/grid.js` takes.

    Args:
        occupancy_map: a map alone.

    Returns:
        As JSON takes it: `name`, `width` and `height` in cells, `resolution` m, `origin` (x m, y m,
        yaw rad), `cells`, base64 of one bit a cell from the lower left corner row by row, 1 where
        it is occupied; `spawn_points` and `evaluation_points` (x m, y m in the grid's frame),
        `max_steps`.

    Raises:
        ValueError: these are several maps side by side.
    """
    if occupancy_map.parts:
        raise ValueError(
            f"map {occupancy_map.name}: {len(occupancy_map.parts)} maps side by side, expected one"
        )
    rows, columns = occupancy_map.shape
    return {
        "name": occupancy_map.name,
        "width": columns,
        "height": rows,
        "resolution": occupancy_map.resolution,
        "origin": list(occupancy_map.origin),
        "cells": base64.b64encode(np.packbits(occupancy_map.occupied).tobytes()).decode(),
        "spawn_points": occupancy_map.spawn_points.tolist(),
        "evaluation_points": occupancy_map.evaluation_points.tolist(),
        "max_steps": occupancy_map.max_steps,
    }
