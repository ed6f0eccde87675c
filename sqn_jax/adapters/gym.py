"""A Gymnasium environment: one robot, an episode at a time.

Importing this module registers `sqn_jax/Maze-v0`, `Column`, `Forest`, `Cave` and `Map`, whose map
is an argument. Gymnasium 1.x loads no plugins by itself.

import gymnasium, sqn_jax.adapters.gym
env = gymnasium.make("sqn_jax/Maze-v0", range_noise=0.1)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import error, spaces
from numpy.typing import NDArray

from sqn_jax.adapters import programs
from sqn_jax.adapters.options import Spawn, make_world, observation_size
from sqn_jax.adapters.render import Renderer, Window
from sqn_jax.env import NUM_ACTIONS, EnvParams
from sqn_jax.maps import OccupancyMap

RENDER_MODES = ("human", "rgb_array")


class NavigationEnv(gymnasium.Env[NDArray[np.float32], np.int64]):
    """A robot with range beams that looks for its goal without a map.

    Observation: `Box(0, 1, (R + G,), float32)`, ranges from right to left, then the goal.
    Action: `Discrete(5)`, see `env.ACTION_NAMES`.
    End: never terminated; truncated after the map's step limit, or `max_steps`.
    `info`: see `sqn_jax.step`; empty after a reset.

    A reset with a seed starts the sequence of episodes that belongs to it, one without goes on
    with the next. The vector environment has the same episodes, but for rounding.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        map: str | Path | OccupancyMap,
        *,
        render_mode: str | None = None,
        spawn: Spawn = "training",
        **settings: Any,
    ) -> None:
        """Load the map.

        Args:
            map: see `maps.load_map`; or a map.
            render_mode: "rgb_array": `render` returns a picture; "human": a window shows every
                step, which needs pygame.
            spawn: tasks near the map's spawn points, or at its evaluation points.
            settings: fields of `EnvConfig`, such as `range_noise=0.1` or `max_steps=200`.

        Raises:
            ValueError: the map is unusable, or an argument is unknown or out of its range.
        """
        require_render_mode(render_mode, RENDER_MODES)
        self.occupancy_map, self.env_params = make_world(map, spawn, settings)
        self.observation_space: spaces.Box = observation_space(self.env_params)  # type: ignore[assignment]
        self.action_space = spaces.Discrete(NUM_ACTIONS)
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": render_fps(self.env_params)}
        self._episode: programs.EpisodeState | None = None
        self._obs: NDArray[np.float32]
        self._renderer: Renderer | None = None
        self._window: Window | None = None
        if render_mode == "human":
            self._window = Window(self.metadata["render_fps"])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the first episode of a seed, or the next one."""
        super().reset(seed=seed)
        refuse_options(options)
        if seed is not None or self._episode is None:
            key = programs.make_keys(draw_key_numbers(self.np_random))
        else:
            key = self._episode.next_key
        obs, self._episode = programs.begin_one(key, self.env_params)
        self._obs = np.array(obs)
        self._show()
        return self._obs.copy(), {}

    def step(
        self, action: np.int64 | int
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one time step.

        Raises:
            gymnasium.error.InvalidAction: the action is none of 0..4.
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        if self._episode is None:
            raise error.ResetNeeded("no episode has begun, expected reset before step")
        if not self.action_space.contains(action):
            raise error.InvalidAction(
                f"action is {action!r:.80}, expected a whole number from 0 to {NUM_ACTIONS - 1}"
            )
        self._episode, step = programs.advance_one(self._episode, int(action), self.env_params)
        obs, reward, terminated, truncated, info = jax.device_get(step)
        self._obs = obs
        self._show()
        return (
            np.array(obs),
            float(reward),
            bool(terminated),
            bool(truncated),
            {name: value.item() for name, value in info.items()},
        )

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """A picture [h, w, 3] of the map, the scan and the goal; None in a window."""
        if self.render_mode != "rgb_array":
            return None
        return self._picture()

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._picture())

    def _picture(self) -> NDArray[np.uint8]:
        if self._episode is None:
            raise error.ResetNeeded("no episode has begun, expected reset before render")
        if self._renderer is None:
            self._renderer = Renderer(self.occupancy_map, self.env_params)
        return self._renderer.draw(jax.device_get(self._episode.env_state), self._obs)


def observation_space(env_params: EnvParams) -> spaces.Box:
    """The space of one observation."""
    return spaces.Box(0.0, 1.0, (observation_size(env_params),), np.float32)


def render_fps(env_params: EnvParams) -> int:
    """Pictures a second at which a robot moves as fast as it would; at least 1."""
    return max(round(1 / float(env_params.time_step)), 1)


def require_render_mode(render_mode: str | None, modes: tuple[str, ...]) -> None:
    """Refuse a render mode that there is not."""
    if render_mode is not None and render_mode not in modes:
        raise ValueError(f"render_mode is {render_mode!r:.80}, expected {' or '.join(modes)}")


def refuse_options(options: dict[str, Any] | None, *known: str) -> None:
    """Refuse options of a reset that there are not."""
    for name in options or {}:
        if name not in known:
            expected = " or ".join(known) or "none: arguments of the environment are given to make"
            raise ValueError(f"reset has the option {name!r:.80}, expected {expected}")


def draw_key_numbers(rng: np.random.Generator, *shape: int) -> NDArray[np.uint32]:
    """What `programs.make_keys` makes random keys of the given shape of."""
    return rng.integers(2**32, size=(*shape, programs.KEY_WIDTH), dtype=np.uint32)


def _register() -> None:
    for name in ("Maze", "Column", "Forest", "Cave", "Map"):
        gymnasium.register(
            f"sqn_jax/{name}-v0",
            entry_point="sqn_jax.adapters.gym:NavigationEnv",
            vector_entry_point="sqn_jax.adapters.gym_vector:NavigationVectorEnv",
            kwargs={} if name == "Map" else {"map": name.lower()},
        )


_register()
