"""The environment in the style of gymnax, beside `sqn_jax.step` and `sqn_jax.reset`."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from one_room import LENGTH, NOISE, begin, take
from refusals import refusal

from sqn_jax.adapters.gymnax import Box, Discrete, LegacyNavigation, Navigation
from sqn_jax.maps import OccupancyMap

NUM_ENVS = 3
ACTIONS = np.random.default_rng(0).integers(0, 5, (2 * LENGTH + 2, NUM_ENVS))


@pytest.fixture(scope="module")
def env(room: OccupancyMap) -> Navigation:
    return Navigation(room, **NOISE)


def assert_same(results: Any, others: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, results, others)


def assert_close(results: Any, others: Any) -> None:
    """But for rounding: batches of another size are other programs."""
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), results, others)


def both(key: jax.Array, state: Any, action: Any, params: Any) -> Any:
    """What `step` and `reset` give with the halves of a key."""
    step_key, reset_key = jax.random.split(key)
    return take(step_key, state, action, params), begin(reset_key, params)


def vector(obs: Any) -> np.ndarray:
    return np.concatenate([obs.ranges, obs.goal])


def expected_step(key: Any, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
    step, (fresh_obs, fresh_state) = both(key, state, action, params)
    obs, state, reward, terminated, truncated, info = step
    ends = {"terminated": terminated, "truncated": truncated, "final_observation": vector(obs)}
    obs, state = (fresh_obs, fresh_state) if truncated else (obs, state)
    return vector(obs), state, reward, terminated, truncated, info | ends


def test_a_step_is_that_of_the_simulator_and_a_reset_follows_the_last(env: Navigation) -> None:
    params = env.default_params
    obs, state = env.reset(jax.random.key(0), params)
    first_obs, first_state = begin(jax.random.key(0), params)
    assert_same((obs, state), (vector(first_obs), first_state))
    ends = []
    for number, action in enumerate(ACTIONS[:, 0].tolist()):
        key = jax.random.key(100 + number)
        expected = expected_step(key, state, action, params)
        results = env.step(key, state, action, params)
        assert_same(results, expected)
        assert env.observation_space(params).contains(results[0])
        if not results[4]:
            obs, *others, info = env.step_env(jax.random.split(key)[0], state, action, params)
            assert_same((obs, *others), expected[:4])
            assert info.keys() == expected[5].keys() - {
                *("terminated", "truncated", "final_observation")
            }
        state = results[1]
        ends.append(bool(results[4]))
        assert env.is_truncated(state, params) == (state.step == LENGTH) == False  # noqa: E712
    assert np.flatnonzero(ends).tolist() == [LENGTH - 1, 2 * LENGTH - 1]
    assert not env.is_terminated(state, params)
    assert env.discount(state, params) == 1


def test_a_batch_is_its_envs_whenever_their_episodes_end(env: Navigation) -> None:
    params = env.default_params
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    starts = [env.reset(jax.random.key(i), params)[1] for i in range(NUM_ENVS)]
    # Their ends do not fall together.
    starts = [state.replace(step=jnp.int32(i)) for i, state in enumerate(starts)]
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    for number, actions in enumerate(ACTIONS):
        keys = jax.random.split(jax.random.key(number), NUM_ENVS)
        results = step(keys, states, actions, params)
        for i in range(NUM_ENVS):
            starts[i], single = (out := env.step(keys[i], starts[i], actions[i], params))[1], out
            assert_close(jax.tree.map(lambda x, i=i: x[i], results), single)
        states = results[1]


@pytest.mark.long
def test_what_envs_share_may_be_shared(env: Navigation) -> None:
    """One state and many actions, as a planner has it, on the step before the time limit."""
    params = env.default_params
    _, state = env.reset(jax.random.key(0), params)
    for step in (0, LENGTH - 1):
        state = state.replace(step=jnp.int32(step))
        many = jax.vmap(partial(env.step, jax.random.key(1)), in_axes=(None, 0, None))
        results = many(state, jnp.arange(5), params)
        for action in range(5):
            single = env.step(jax.random.key(1), state, action, params)
            assert_close(jax.tree.map(lambda x, i=action: x[i], results), single)


def test_the_legacy_form_has_five_values(room: OccupancyMap, env: Navigation) -> None:
    legacy = LegacyNavigation(room, **NOISE)
    params = legacy.default_params
    _, state = env.reset(jax.random.key(0), params)
    state = state.replace(step=jnp.int32(LENGTH - 1))
    obs, next_state, reward, done, info = legacy.step(jax.random.key(2), state, 1, params)
    six = env.step(jax.random.key(2), state, 1)
    assert_same((obs, next_state, reward, done, info), (*six[:3], six[4], six[5]))
    assert done


def test_spaces_hold_what_they_draw(env: Navigation) -> None:
    actions, box = env.action_space(), env.observation_space()
    assert (actions, env.num_actions) == (Discrete(5), 5)
    drawn = jax.vmap(actions.sample)(jax.random.split(jax.random.key(0), 200))
    assert sorted(set(drawn.tolist())) == [0, 1, 2, 3, 4]
    assert [bool(actions.contains(x)) for x in (-1, 0, 4, 5)] == [False, True, True, False]
    assert box == Box(0.0, 1.0, (73,))
    sample = box.sample(jax.random.key(0))
    assert sample.shape == (73,)
    assert box.contains(sample)
    assert not box.contains(sample.at[3].set(1.1))
    _, state = env.reset(jax.random.key(0))
    for name, space in env.state_space().spaces.items():
        value = getattr(state, name)
        assert (value.shape, value.dtype) == (space.shape, space.dtype), name
        assert space.contains(value), name


def test_what_cannot_be_used_is_refused_in_a_line(room: OccupancyMap) -> None:
    assert refusal(lambda: Navigation(room, beams=3)).startswith("unknown option 'beams'")


def test_spaces_look_at_shapes_and_old_code_finds_its_names(room: OccupancyMap) -> None:
    env = LegacyNavigation(room, max_steps=2)
    space = env.observation_space()
    assert space.contains(jnp.full(space.shape, 0.5))
    assert not space.contains(jnp.full(3, 0.5))
    _, state = env.reset(jax.random.key(0))
    for step, is_over in ((0, False), (1, False), (2, True)):
        there = dataclasses.replace(state, step=jnp.int32(step))
        assert bool(env.is_terminal(there)) is is_over
