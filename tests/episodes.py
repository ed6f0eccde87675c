"""Episodes made by hand, for pictures of them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from sqn_jax.agent import QOutput, Trajectory
from sqn_jax.env import Observation
from sqn_jax.env.coverage import Lattice
from sqn_jax.evaluation.recording import Episode
from sqn_jax.maps import OccupancyMap

HEIGHT_M, WIDTH_M = 4.0, 6.0
LATTICE = Lattice.over(HEIGHT_M, WIDTH_M, 0.25, 5.0)


def walled_room(name: str = "room") -> OccupancyMap:
    """4 x 6 m of 0.1 m cells with a closed border and a wall from (2, 1) to (2.1, 3.4) m."""
    occupied = np.zeros((40, 60), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[10:34, 20] = True
    points = np.array([[0.5, 0.5], [5.5, 3.5]])
    return OccupancyMap(name, occupied, 0.1, points, points)


def covered_up_to(x: np.ndarray) -> np.ndarray:
    """[T + 1, ...] with the points of the map left of x [T + 1] m seen."""
    places = LATTICE.points()
    on_map = ((places >= 0) & (places < (WIDTH_M, HEIGHT_M))).all(axis=-1)
    seen = on_map & (places[..., 0] < x[:, None, None, None, None])
    return np.bitwise_or.reduce(np.uint32(seen) << np.arange(32, dtype=np.uint32), axis=-1)


def episode_of(values: dict[str, Any]) -> Episode:
    """An `Episode` whose properties have these values.

    The navigation part of the reward is made to fit `reachable`, which is read off it.
    """
    values = dict(values)
    parts = np.array(values["reward_parts"], float)
    parts[:, 0] = np.where(values["reachable"], np.abs(parts[:, 0]) + 1e-3, 0.0)
    parts = np.concatenate([parts, np.zeros((len(parts), 4 - parts.shape[1]))], axis=1)
    config = SimpleNamespace(
        max_range=values["max_range"],
        field_of_view_deg=math.degrees(values["field_of_view"]),
        num_beams=values["ranges"].shape[1],
        robot_radius=values["robot_radius"],
    )
    env_params = SimpleNamespace(
        config=config,
        goal_radius=values["goal_radius"],
        time_step=values["time_step"],
        lattice=values["lattice"],
        reward_weights=np.array([1.0, 1.0, 1.0, 0.0]),
    )
    names = ("navigation", "exploration", "time", "collision")
    info = {f"reward_{name}": part for name, part in zip(names, parts.T, strict=True)}
    info |= {"goal_distance": values["goal_distances"], "collision": values["collisions"]}
    output = (values[name] for name in ("q_values", "skill_weights", "skill_q_values"))
    trajectory = Trajectory(
        obs=Observation(ranges=values["ranges"] / values["max_range"], goal=cast(Any, None)),
        actions=values["actions"],
        rewards=parts.sum(axis=1),
        poses=values["poses"],
        goals=values["goal"],
        info=info,
        output=QOutput(*output),
        covered=values["covered"],
    )
    return Episode(values["agent"], values["occupancy_map"], cast(Any, env_params), trajectory)


def changed(one: Episode, **changes: Any) -> Episode:
    """The same episode with other values of some properties."""
    names = ("agent", "occupancy_map", "poses", "goal", "ranges", "actions", "reward_parts")
    names += ("goal_distances", "reachable", "collisions", "skill_weights", "skill_q_values")
    names += ("q_values", "field_of_view", "max_range", "goal_radius", "robot_radius")
    names += ("time_step", "lattice")
    values = {name: getattr(one, name) for name in names}
    return episode_of(values | {"covered": one.trajectory.covered} | changes)


def episode(length: int = 30, *, arrival: int = 12, skills: int = 2, **changes: Any) -> Episode:
    """An episode of T = `length` steps of 0.1 s from (0.5, 0.6) m to the right, 0.1 m a step.

    The goal radius is entered in step `arrival`; 0 for never. What is covered grows by 0.1 m a
    step from x = 1 m. Everything else is random, and may be changed.
    """
    rng = np.random.default_rng(3)
    steps = np.arange(length + 1)
    x = 0.5 + 0.1 * steps
    poses = np.stack([x, np.full(length + 1, 0.6), 0.02 * steps], axis=-1)
    distances = np.where(steps[1:] >= arrival, 0.2, 3.0) if arrival else np.full(length, 3.0)
    weights = rng.dirichlet(np.ones(skills), length) if skills > 1 else np.ones((length, 1))
    skill_q_values = rng.normal(size=(length, skills, 5))
    parts = rng.normal(size=(length, 3))
    values: dict[str, Any] = {
        "agent": "sqn" if skills > 1 else "r2d2",
        "occupancy_map": walled_room(),
        "poses": poses,
        "goal": np.array([3.5, 0.6]),
        "ranges": rng.uniform(0.5, 4.5, size=(length + 1, 8)),
        "covered": covered_up_to(1.0 + 0.1 * steps),
        "actions": rng.integers(0, 5, length),
        "reward_parts": parts,
        "goal_distances": distances,
        "reachable": distances < 1.0,
        "collisions": np.zeros(length, dtype=bool),
        "skill_weights": weights,
        "skill_q_values": skill_q_values,
        "q_values": (weights[..., None] * skill_q_values).sum(axis=1),
        "field_of_view": math.radians(350.0),
        "max_range": 5.0,
        "goal_radius": 0.3,
        "robot_radius": 0.1,
        "time_step": 0.1,
        "lattice": LATTICE,
    }
    return episode_of(values | changes)
