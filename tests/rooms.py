"""Small rooms, and weights that make robots do different things in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sqn_jax.agent import initial_carry
from sqn_jax.agent.networks import QNetwork
from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, make_env
from sqn_jax.maps import OccupancyMap
from sqn_jax.training.rollout import start_actors


def small_room_map(length: int) -> OccupancyMap:
    """3 x 4 m, not square, with a wall in the middle and spawn points in its corners.

    Episodes take `length` steps.
    """
    occupied = np.zeros((30, 40), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[14:16, 12:28] = True
    corners = np.array([[0.65, 0.65], [3.35, 0.65], [0.65, 2.35], [3.35, 2.35]])
    return OccupancyMap("room", occupied, 0.1, corners, corners[:2], max_steps=length)


def small_room(length: int, **changes: Any) -> EnvParams:
    """The world of `small_room_map`; changes are to `EnvConfig`."""
    return make_env(small_room_map(length), EnvConfig(**changes))


def write_empty_room(folder: Path) -> Path:
    """A map file of 5 x 4 m with walls around; returns its name."""
    cells = np.full((40, 50), 254, np.uint8)
    cells[[0, -1]] = cells[:, [0, -1]] = 0
    (folder / "room.pgm").write_bytes(b"P5\n50 40\n255\n" + cells.tobytes())
    path = folder / "room.yaml"
    path.write_text(
        "image: room.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
        "spawn_points: [[0.8, 0.8], [4.2, 3.2], [0.8, 3.2]]\n"
        "evaluation_points: [[0.8, 0.8], [4.2, 3.2]]\n"
    )
    return path


def random_params(network: QNetwork, env_params: EnvParams, seed: int = 0) -> Any:
    """Weights large enough that greedy robots do different things."""

    def initial(key: jax.Array) -> Any:
        obs = jax.tree.map(lambda x: x[None], start_actors(key[None], env_params, network).obs)
        return network.init(key, obs, initial_carry(network.config, 1))

    shapes = jax.eval_shape(initial, jax.random.key(0))
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), shapes)
