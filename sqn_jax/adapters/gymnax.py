"""The simulator as an environment in the style of gymnax 1.x, without gymnax.

env = Navigation("maze")
obs, state = env.reset(key, env.default_params)
obs, state, reward, terminated, truncated, info = env.step(key, state, action, env.default_params)

All is for one robot; `jax.vmap` with `in_axes=(0, 0, 0, None)` makes many. The methods are pure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from sqn_jax.adapters import programs
from sqn_jax.adapters.options import Spawn, make_world, observation_size
from sqn_jax.env import NUM_ACTIONS, EnvParams, EnvState
from sqn_jax.maps import OccupancyMap

Info = dict[str, Array]


@dataclass(frozen=True)
class Discrete:
    """The whole numbers from 0 to n - 1."""

    n: int
    shape: tuple[int, ...] = ()
    dtype: DTypeLike = jnp.int32

    def sample(self, key: Array) -> Array:
        """One of them, drawn evenly; the key is consumed."""
        return jax.random.randint(key, self.shape, 0, self.n, self.dtype)

    def contains(self, x: Any) -> Array:
        """bool: whether a number is one of them."""
        return (jnp.asarray(x) >= 0) & (jnp.asarray(x) < self.n)


@dataclass(frozen=True)
class Box:
    """Arrays of a shape whose numbers lie between two limits."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: DTypeLike = jnp.float32

    def sample(self, key: Array) -> Array:
        """One of them, drawn evenly; the key is consumed."""
        return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: Any) -> Array:
        """bool: whether an array is one of them."""
        if jnp.shape(x) != self.shape:
            return jnp.bool_(False)
        low, high = jnp.asarray(self.low, self.dtype), jnp.asarray(self.high, self.dtype)
        return jnp.all((jnp.asarray(x) >= low) & (jnp.asarray(x) <= high))


@dataclass(frozen=True)
class Dict:
    """One of several spaces under each name."""

    spaces: Mapping[str, Box | Discrete]


class Navigation:
    """One robot that looks for its goal without a map.

    An observation is one vector [R + G] in 0..1. A state is an `EnvState`, params are
    `EnvParams`; those of another map or noise level can be given in place of the default.
    """

    name = "Navigation"
    num_actions = NUM_ACTIONS

    def __init__(
        self,
        map: str | Path | OccupancyMap,
        *,
        spawn: Spawn = "training",
        **settings: Any,
    ) -> None:
        """Load the map.

        Args:
            map: see `maps.load_map`; or a map.
            spawn: tasks near the map's spawn points, or at its evaluation points.
            settings: fields of `EnvConfig`, such as `max_steps=200`.

        Raises:
            ValueError: the map is unusable, or an argument is unknown or out of its range.
        """
        _, self.default_params = make_world(map, spawn, settings)

    def reset(self, key: Array, params: EnvParams | None = None) -> tuple[Array, EnvState]:
        """Begin an episode; the key is consumed."""
        return programs.reset_once(key, self._or_default(params))

    def step(
        self, key: Array, state: EnvState, action: Any, params: EnvParams | None = None
    ) -> tuple[Array, EnvState, Array, Array, Array, Info]:
        """Advance by one time step; an episode that ends is followed by the next at once.

        Args:
            key: consumed: for noise, and for the next episode.
            state: where the robot is.
            action: integer in 0..4.
            params: the world; None: `default_params`.

        Returns:
            Observation and state, those of the next episode where one has ended; reward,
            terminated (always False), truncated; and info: that of `sqn_jax.step`, `terminated`,
            `truncated` and `final_observation`, the observation before a reset.
        """
        return programs.step_and_reset(key, state, action, self._or_default(params))

    def reset_env(self, key: Array, params: EnvParams) -> tuple[Array, EnvState]:
        """The same as `reset`."""
        return programs.reset_once(key, params)

    def step_env(
        self, key: Array, state: EnvState, action: Any, params: EnvParams
    ) -> tuple[Array, EnvState, Array, Array, Info]:
        """Observation, state, reward, terminated and info of a step without a reset."""
        step_results = programs.step_once(key, state, action, params)
        obs, state, reward, terminated, _, info = step_results
        return obs, state, reward, terminated, info

    def is_truncated(self, state: EnvState, params: EnvParams | None = None) -> Array:
        """bool: whether the time limit is reached."""
        return state.step >= self._or_default(params).max_steps

    def is_terminated(self, state: EnvState, params: EnvParams | None = None) -> Array:
        """bool: False, reaching the goal ends nothing."""
        return jnp.zeros(jnp.shape(state.step), bool)

    def discount(self, state: EnvState, params: EnvParams | None = None) -> Array:
        """1.0: a time limit is no reason not to bootstrap."""
        return jnp.ones(jnp.shape(state.step))

    def action_space(self, params: EnvParams | None = None) -> Discrete:
        """0 to 4, see `env.ACTION_NAMES`."""
        return Discrete(NUM_ACTIONS)

    def observation_space(self, params: EnvParams | None = None) -> Box:
        """[R + G] numbers in 0..1."""
        return Box(0.0, 1.0, (observation_size(self._or_default(params)),))

    def state_space(self, params: EnvParams | None = None) -> Dict:
        """The fields of an `EnvState`."""
        params = self._or_default(params)
        return Dict(
            {
                "pose": Box(-math.inf, math.inf, (3,)),
                "goal": Box(0.0, math.inf, (2,)),
                "covered": Box(0, 2**32 - 1, params.lattice.shape, jnp.uint32),
                "step": Discrete(params.max_steps + 1),
            }
        )

    def _or_default(self, params: EnvParams | None) -> EnvParams:
        return self.default_params if params is None else params


class LegacyNavigation(Navigation):
    """The same with the five values of gymnax before 1.0: one `done` for both kinds of end."""

    def step(  # type: ignore[override]
        self, key: Array, state: EnvState, action: Any, params: EnvParams | None = None
    ) -> tuple[Array, EnvState, Array, Array, Info]:
        """Observation, state, reward, done and info; see `Navigation.step`."""
        obs, state, reward, terminated, truncated, info = super().step(key, state, action, params)
        return obs, state, reward, terminated | truncated, info

    def is_terminal(self, state: EnvState, params: EnvParams | None = None) -> Array:
        """bool: whether the episode is over, which here is the time limit alone."""
        return self.is_truncated(state, params)
