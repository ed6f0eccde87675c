"""The compiled programs of the adapters: episode after episode, of one env and of a batch.

Every env has a chain of random keys. The key of an episode gives its task, the noise of its steps
and the key of the next episode, so the episodes of an env do not depend on how many others there
are, on when these end, or on who resets them.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.custom_batching import custom_vmap
from numpy.typing import NDArray

from sqn_jax.env import EnvParams, EnvState, Observation, navigation

KEY_WIDTH = 2
"""uint32 numbers that a random key consists of."""


def make_keys(numbers: Any) -> Array:
    """Random keys [...] out of uint32 [..., KEY_WIDTH]."""
    return jax.random.wrap_key_data(jnp.asarray(numbers), impl="threefry2x32")


@struct.dataclass
class EpisodeState:
    """One env within its episode."""

    env_state: EnvState
    noise_key: Array
    """Of the noise of its steps."""
    next_key: Array
    """Of the episode after it."""


GymnaxStep = tuple[Array, EnvState, Array, Array, Array, dict[str, Array]]
"""Observation [R + G], state, reward, terminated, truncated, info."""


class Step(NamedTuple):
    """What a step returns."""

    obs: Array
    """[R + G]."""
    reward: Array
    terminated: Array
    truncated: Array
    info: dict[str, Array]


def flat(obs: Observation) -> Array:
    """An observation as one vector [R + G]: ranges, then goal."""
    return jnp.concatenate([obs.ranges, obs.goal])


def begin(key: Array, env_params: EnvParams) -> tuple[Array, EpisodeState]:
    """First observation [R + G] and state of the episode of a key, which is consumed."""
    reset_key, noise_key, next_key = jax.random.split(key, 3)
    obs, env_state = navigation.reset(reset_key, env_params)
    return flat(obs), EpisodeState(env_state, noise_key, next_key)


def advance(
    episode: EpisodeState, action: Array, env_params: EnvParams
) -> tuple[EpisodeState, Step]:
    """One time step of one env; the action is an integer in 0..4."""
    key = jax.random.fold_in(episode.noise_key, episode.env_state.step)
    obs, env_state, reward, terminated, truncated, info = navigation.step(
        key, episode.env_state, action, env_params
    )
    step = Step(flat(obs), reward, terminated, truncated, info)
    return dataclasses.replace(episode, env_state=env_state), step


def restart(
    is_over: Array, obs: Array, episodes: EpisodeState, env_params: EnvParams
) -> tuple[Array, EpisodeState]:
    """Begin the next episode in the envs [N] that `is_over` selects.

    Resets are computed only if there is such an env: they cost as much as a step.
    """

    def begin_selected() -> tuple[Array, EpisodeState]:
        fresh = jax.vmap(begin, in_axes=(0, None))(episodes.next_key, env_params)
        return select_envs(is_over, fresh, (obs, episodes))

    return jax.lax.cond(is_over.any(), begin_selected, lambda: (obs, episodes))


def select_envs(selected: Array | NDArray[np.bool_], new: Any, old: Any) -> Any:
    """Arrays [N, ...] of `new` where `selected` [N], of `old` elsewhere."""

    def select(new_array: Array, old_array: Array) -> Array:
        mask = jnp.expand_dims(selected, tuple(range(1, old_array.ndim)))
        return jnp.where(mask, new_array, old_array)

    return jax.tree.map(select, new, old)


def blank(keys: Array, env_params: EnvParams) -> tuple[Array, EpisodeState]:
    """Observations [N, R + G] and states [N] of envs before their first episodes, of keys [N]."""
    shapes = jax.eval_shape(jax.vmap(begin, in_axes=(0, None)), keys, env_params)
    obs, env_states = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), (shapes[0], shapes[1].env_state)
    )
    return obs, EpisodeState(env_states, noise_key=keys, next_key=keys)


def _reset(key: Array, env_params: EnvParams) -> tuple[Array, EnvState]:
    obs, state = navigation.reset(key, env_params)
    return flat(obs), state


def _step(key: Array, state: EnvState, action: Any, env_params: EnvParams) -> GymnaxStep:
    obs, *others = navigation.step(key, state, action, env_params)
    return cast(GymnaxStep, (flat(obs), *others))


def _reset_where(
    is_over: Array, key: Array, before: tuple[Array, EnvState], env_params: EnvParams
) -> tuple[Array, EnvState]:
    """Begin an episode if `is_over`; under one `jax.vmap` computed only if any of them is.

    `vmap` alone would turn the branch into both sides of it, for all envs in every step.
    """

    @custom_vmap
    def choose(is_over: Array, key: Array, before: Any, params: EnvParams) -> Any:
        return jax.lax.cond(is_over, lambda: _reset(key, params), lambda: before)

    @choose.def_vmap
    def choose_many(num_envs: int, batched: Any, *arguments: Any) -> Any:
        is_over, key, before, params = arguments
        before = jax.tree.map(
            lambda x, is_batched: x if is_batched else jnp.broadcast_to(x, (num_envs, *x.shape)),
            before,
            batched[2],
        )
        axes = [jax.tree.map(lambda is_batched: 0 if is_batched else None, b) for b in batched]
        axes[2] = 0

        def reset_selected() -> Any:
            return jax.vmap(reset_or_not, in_axes=tuple(axes))(is_over, key, before, params)

        results = jax.lax.cond(is_over.any(), reset_selected, lambda: before)
        return results, jax.tree.map(lambda _: True, results)

    def reset_or_not(is_over: Array, key: Array, before: Any, params: EnvParams) -> Any:
        fresh = _reset(key, params)
        return jax.tree.map(lambda new, old: jnp.where(is_over, new, old), fresh, before)

    return choose(is_over, key, before, env_params)


begin_one = jax.jit(begin)
advance_one = jax.jit(advance)
advance_many = jax.jit(jax.vmap(advance, in_axes=(0, 0, None)))
"""A step of N envs without a reset."""
restart_selected = jax.jit(restart)

reset_once = jax.jit(_reset)
"""A key to an observation [R + G] and a state."""
step_once = jax.jit(_step)
"""A step of one env without a reset, as `sqn_jax.step`."""
reset_where = jax.jit(_reset_where)


def step_and_reset(key: Array, state: EnvState, action: Any, env_params: EnvParams) -> GymnaxStep:
    """A step of one env, followed by a reset where the episode ends."""
    # Two programs, unless the caller makes one of them: alone, each rounds as the simulator does.
    step_key, reset_key = jax.random.split(key)
    final_obs, state, reward, terminated, truncated, info = step_once(
        step_key, state, action, env_params
    )
    obs, state = reset_where(terminated | truncated, reset_key, (final_obs, state), env_params)
    ends = {"terminated": terminated, "truncated": truncated, "final_observation": final_obs}
    return obs, state, reward, terminated, truncated, info | ends
