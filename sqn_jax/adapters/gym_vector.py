"""A Gymnasium vector environment: many robots in one compiled program, whose state stays there.

envs = gymnasium.make_vec("sqn_jax/Maze-v0", num_envs=256, autoreset_mode="SameStep")
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import gymnasium
import jax
import numpy as np
from gymnasium import error, spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jax import Array
from numpy.typing import NDArray

from sqn_jax.adapters import programs
from sqn_jax.adapters.gym import (
    draw_key_numbers,
    observation_space,
    refuse_options,
    render_fps,
    require_render_mode,
)
from sqn_jax.adapters.options import Spawn, make_world
from sqn_jax.adapters.render import Renderer
from sqn_jax.env import NUM_ACTIONS
from sqn_jax.maps import OccupancyMap

RENDER_MODES = ("rgb_array",)

Infos = dict[str, Any]
Result = tuple[Any, Any, Any, Any, Infos]


class NavigationVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """N robots of one world; see `gym.NavigationEnv` for spaces, end, seeds and info.

    The episodes of env i after `reset(seed=s)` are those of a `NavigationEnv` with seed s + i, but
    for rounding.
    A reset without a seed goes on with the next episode of each env.

    Autoreset: NEXT_STEP begins the next episode in the step after the last; its reward is 0.
    SAME_STEP begins it at once; `final_obs` and `final_info` are of the step before. DISABLED
    leaves it to `reset(options={"reset_mask": mask})`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        map: str | Path | OccupancyMap,
        num_envs: int | np.integer[Any] = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        arrays: Literal["numpy", "jax"] = "numpy",
        render_mode: str | None = None,
        spawn: Spawn = "training",
        max_episode_steps: int | None = None,
        **settings: Any,
    ) -> None:
        """Load the map.

        Args:
            map: see `maps.load_map`; or a map.
            num_envs: N, robots.
            autoreset_mode: what happens after the end of an episode.
            arrays: "numpy": results are arrays of one's own on the host; "jax": they stay on the
                device, and with SAME_STEP `infos` has `final_obs` and `final_info` in every step.
            render_mode: "rgb_array": `render` returns a picture of each env.
            spawn: tasks near the map's spawn points, or at its evaluation points.
            max_episode_steps: another name of the setting `max_steps`, that of `make_vec`.
            settings: fields of `EnvConfig`.

        Raises:
            ValueError: the map is unusable, or an argument is unknown or out of its range.
        """
        if isinstance(num_envs, np.integer):
            num_envs = int(num_envs)
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs is {num_envs!r:.80}, expected a whole number from 1 on")
        if arrays not in ("numpy", "jax"):
            raise ValueError(f"arrays is {arrays!r:.80}, expected numpy or jax")
        require_render_mode(render_mode, RENDER_MODES)
        if max_episode_steps is not None:
            if "max_steps" in settings:
                raise ValueError("both max_steps and max_episode_steps are given, expected one")
            settings["max_steps"] = max_episode_steps
        self.autoreset_mode = _mode(autoreset_mode)
        self.occupancy_map, self.env_params = make_world(map, spawn, settings)
        self.num_envs = num_envs
        self.arrays = arrays
        self.single_observation_space = observation_space(self.env_params)
        self.single_action_space = spaces.Discrete(NUM_ACTIONS)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = render_mode
        self.metadata = {
            **type(self).metadata,
            "autoreset_mode": self.autoreset_mode,
            "render_fps": render_fps(self.env_params),
        }
        self._before: tuple[Array, programs.EpisodeState] | None = None
        """Observations [N, R + G] and states [N] before the next step, on the device."""
        self._is_over: Array | NDArray[np.bool_] = np.zeros(num_envs, bool)
        self._renderer: Renderer | None = None

    def reset(  # type: ignore[override]
        self,
        *,
        seed: int | np.integer[Any] | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, Infos]:
        """Begin an episode in all envs, or in those that `options["reset_mask"]` [N] selects.

        Args:
            seed: that of env 0, the others count up from it; or one for each env; None: go on.
            options: `reset_mask`, bool [N].
        """
        if isinstance(seed, np.integer):
            seed = int(seed)
        if not (seed is None or isinstance(seed, int | Sequence)):
            raise ValueError(f"seed is {seed!r:.80}, expected a whole number, or one for each env")
        super().reset(seed=seed if isinstance(seed, int) else None)
        refuse_options(options, "reset_mask")
        keys = self._keys(seed)
        if "reset_mask" in (options or {}):
            assert options is not None
            selected, (obs, episodes) = self._mask(options["reset_mask"]), self._begun()
        else:
            selected = np.ones(self.num_envs, bool)
            obs, episodes = self._before or programs.blank(keys, self.env_params)
        keys = programs.select_envs(selected, keys, episodes.next_key)
        episodes = dataclasses.replace(episodes, next_key=keys)
        self._before = programs.restart_selected(selected, obs, episodes, self.env_params)
        self._is_over = self._is_over & ~selected
        return self._own(self._before[0]), {}

    def step(self, actions: Any) -> Result:
        """Advance all envs by one time step.

        Args:
            actions: integers [N] in 0..4. Those of a JAX array are not looked at: what is above 4
                acts as 4.

        Raises:
            gymnasium.error.InvalidAction: actions of another shape, or none of 0..4.
            gymnasium.error.ResetNeeded: no episode has begun; or, with autoreset DISABLED, one is
                over.
        """
        _, episodes = self._begun()
        mode, was_over = self.autoreset_mode, self._is_over
        if mode is AutoresetMode.DISABLED and np.asarray(was_over).any():
            raise error.ResetNeeded(
                "an episode is over, expected reset with the option reset_mask before step"
            )
        episodes, step = programs.advance_many(episodes, self._checked(actions), self.env_params)
        self._before = step.obs, episodes
        obs, reward, terminated, truncated, info = self._own(step)
        is_over = terminated | truncated
        if mode is AutoresetMode.SAME_STEP:
            infos = self._infos_of_both(info, obs, is_over)
            return self._restarted(is_over, obs), reward, terminated, truncated, infos
        self._is_over = is_over
        if mode is AutoresetMode.NEXT_STEP:
            obs = self._restarted(was_over, obs)
            reward = reward * ~was_over
            terminated, truncated = terminated & ~was_over, truncated & ~was_over
            self._is_over = is_over & ~was_over
        return obs, reward, terminated, truncated, _masked(info, ~was_over)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """A picture [h, w, 3] of each env."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = Renderer(self.occupancy_map, self.env_params)
        obs, episodes = self._begun()
        states, observations = jax.device_get((episodes.env_state, obs))
        return tuple(
            self._renderer.draw(jax.tree.map(lambda x, i=i: x[i], states), observations[i])
            for i in range(self.num_envs)
        )

    def _restarted(self, selected: Any, obs: Any) -> Any:
        """Observations [N, R + G] once the next episode has begun in some envs [N]."""
        if self.arrays == "numpy" and not selected.any():
            return obs
        self._before = programs.restart_selected(selected, *self._begun(), self.env_params)
        return self._own(self._before[0])

    def _infos_of_both(self, info: Infos, obs: Any, is_over: Any) -> Infos:
        """Infos where a step can be the last of one episode and the first of the next."""
        infos = _masked(info, ~is_over)
        if self.arrays == "jax":
            infos["final_obs"] = obs
        elif is_over.any():  # As Gymnasium has it: an observation, or None.
            infos["final_obs"] = np.full(self.num_envs, None, object)
            for index in np.flatnonzero(is_over):
                infos["final_obs"][index] = obs[index]
        else:
            return infos
        final = {"_final_obs": is_over, "_final_info": is_over}
        return infos | final | {"final_info": _masked(info, is_over)}

    def _begun(self) -> tuple[Array, programs.EpisodeState]:
        if self._before is None:
            raise error.ResetNeeded("no episode has begun, expected reset before")
        return self._before

    def _keys(self, seed: int | Sequence[int | None] | None) -> Array:
        """The keys [N] of the episodes that begin next; those of envs with a seed are its own."""
        if seed is None and self._before is not None:
            return self._before[1].next_key
        if seed is None:
            return programs.make_keys(draw_key_numbers(self.np_random, self.num_envs))
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed has {len(seeds)} entries, expected {self.num_envs}")
        is_seeded = np.array([each is not None for each in seeds])
        numbers = [draw_key_numbers(seeding.np_random(each)[0]) for each in seeds]
        keys = programs.make_keys(np.stack(numbers))
        if self._before is None or is_seeded.all():
            return keys
        return programs.select_envs(is_seeded, keys, self._before[1].next_key)

    def _mask(self, mask: Any) -> NDArray[np.bool_]:
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == bool
        if not is_mask or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"reset_mask is {mask!r:.80}, expected a bool array of shape ({self.num_envs},) "
                "with at least one True"
            )
        return mask

    def _checked(self, actions: Any) -> Any:
        """Actions [N], refused where they are known and wrong."""
        if not isinstance(actions, Array):
            actions = np.asarray(actions)
        expected = f"whole numbers of shape ({self.num_envs},) from 0 to {NUM_ACTIONS - 1}"
        if actions.shape != (self.num_envs,) or not np.issubdtype(actions.dtype, np.integer):
            raise error.InvalidAction(
                f"actions are {actions.dtype} of shape {actions.shape}, expected {expected}"
            )
        if isinstance(actions, np.ndarray) and not ((actions >= 0) & (actions < NUM_ACTIONS)).all():
            raise error.InvalidAction(
                f"actions hold {actions.min()} to {actions.max()}, expected {expected}"
            )
        return actions

    def _own(self, results: Any) -> Any:
        """Results as the user gets them: on the device, or arrays of their own on the host."""
        return results if self.arrays == "jax" else jax.tree.map(np.array, results)


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        expected = ", ".join(each.value for each in AutoresetMode)
        raise ValueError(f"autoreset_mode is {mode!r:.80}, expected one of {expected}") from None


def _masked(info: Infos, mask: Any) -> Infos:
    """Info with a mask [N] beside each entry that says which envs have it."""
    return info | {f"_{name}": mask for name in info}
