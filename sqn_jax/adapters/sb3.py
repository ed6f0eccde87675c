"""A vectorized environment of Stable-Baselines3, which takes none of Gymnasium.

from sb3_contrib import RecurrentPPO
envs = NavigationVecEnv("maze", 64)
RecurrentPPO("MlpLstmPolicy", envs).learn(1_000_000)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sqn_jax.adapters.gym import refuse_options
from sqn_jax.adapters.gym_vector import NavigationVectorEnv
from sqn_jax.maps import OccupancyMap


class NavigationVecEnv(VecEnv):
    """N robots of one world in one compiled program; see `gym.NavigationEnv`.

    An episode that ends is followed by the next at once. The info of its last step has
    `terminal_observation`, `TimeLimit.truncated` (True: trainers bootstrap) and `is_success`,
    whether the goal was reached at any time.
    """

    def __init__(self, map: str | Path | OccupancyMap, num_envs: int = 1, **arguments: Any) -> None:
        """Load the map.

        Args:
            map: see `maps.load_map`; or a map.
            num_envs: N, robots.
            arguments: `spawn`, `render_mode` and fields of `EnvConfig`, as for
                `gym_vector.NavigationVectorEnv`.

        Raises:
            ValueError: the map is unusable, or an argument is unknown or out of its range.
        """
        for name in ("autoreset_mode", "arrays"):
            if name in arguments:
                raise ValueError(f"unknown option {name!r}: Stable-Baselines3 sets it")
        self.envs = NavigationVectorEnv(
            map, num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **arguments
        )
        self._reached = np.zeros(num_envs, bool)
        self._actions: NDArray[np.integer[Any]]
        super().__init__(
            num_envs, self.envs.single_observation_space, self.envs.single_action_space
        )

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in all envs, with the seeds of `seed` if it was called."""
        for options in self._options:
            refuse_options(options)
        obs, _ = self.envs.reset(seed=None if self._seeds[0] is None else self._seeds)
        self._reached[:] = False
        self._reset_seeds()
        self._reset_options()
        return np.asarray(obs)

    def step_async(self, actions: NDArray[np.integer[Any]]) -> None:
        """Take note of the actions [N] of the next step."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Observations [N, R + G], rewards [N], dones [N] and N infos of the step."""
        obs, rewards, terminated, truncated, vector_info = self.envs.step(self._actions)
        dones = terminated | truncated
        # Those of the step, also where the episode has ended.
        names = [name for name in vector_info if f"_{name}" in vector_info]
        names = [name for name in names if not name.startswith("final_")]
        columns = [vector_info[name].tolist() for name in names]
        infos = [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
        self._reached |= vector_info["reached"]
        for index in np.flatnonzero(dones):
            infos[index] |= {
                "terminal_observation": vector_info["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                "is_success": bool(self._reached[index]),
            }
        self._reached &= ~dones
        return obs, rewards, dones, infos

    def close(self) -> None:
        """Nothing is left open."""
        self.envs.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A picture [h, w, 3] of each env."""
        return self.envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute, which all envs share, for each of some envs."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: the envs are one program.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"set_attr {attr_name!r:.80}: the envs share their attributes")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **_: Any
    ) -> list[Any]:
        """Refused: the envs are one program.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"env_method {method_name!r:.80}: the envs are one program")

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """False for each of some envs."""
        return [False for _ in self._get_indices(indices)]
