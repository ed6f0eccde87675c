"""Plans of the oracle and shortest paths, searched once for all commands that need them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sqn_jax.baselines import beam, oracle, shortest_paths
from sqn_jax.baselines.oracle import Oracle
from sqn_jax.env import EnvParams, geometry, navigation
from sqn_jax.maps import OccupancyMap, distance, occupancy
from sqn_jax.storage.array_cache import cached_arrays, code_of

_PATHS_CODE = code_of(shortest_paths, distance, occupancy, geometry)
_PLANS_CODE = _PATHS_CODE + code_of(oracle, beam, navigation)

Floats = NDArray[np.floating]


def prepared_oracle(
    occupancy_map: OccupancyMap, env_params: EnvParams, goals: Floats, poses: Floats
) -> Oracle:
    """An oracle that has planned from the first poses [E, 3] to goals [E, 2]."""
    planner = Oracle(occupancy_map, env_params, goals.astype(np.float64))
    config = env_params.config
    robot = [
        *(config.forward_speed, config.backward_speed, config.turn_rate, config.time_step),
        *(config.robot_radius, float(env_params.goal_radius), env_params.max_steps),
    ]
    depends_on = [_PLANS_CODE, *_contents(occupancy_map), repr(robot).encode()]
    depends_on += [goals.tobytes(), poses.tobytes()]
    plans = cached_arrays("plans", depends_on, lambda: planner.plans(poses.astype(np.float64)))
    planner.follow(**plans)
    return planner


def path_lengths(
    occupancy_map: OccupancyMap, starts: Floats, goals: Floats, *, robot_radius: float
) -> NDArray[np.float64]:
    """See `shortest_paths.shortest_path_lengths`."""

    def searched() -> dict[str, NDArray[np.float64]]:
        lengths = shortest_paths.shortest_path_lengths(
            occupancy_map, starts, goals, robot_radius=robot_radius
        )
        return {"lengths": lengths}

    depends_on = [_PATHS_CODE, *_contents(occupancy_map), repr(robot_radius).encode()]
    depends_on += [starts.tobytes(), goals.tobytes()]
    return cached_arrays("paths", depends_on, searched)["lengths"]


def _contents(occupancy_map: OccupancyMap) -> list[bytes]:
    """What paths depend on in a map."""
    grid = occupancy_map.occupied
    return [repr((occupancy_map.resolution, grid.shape)).encode(), grid.tobytes()]
