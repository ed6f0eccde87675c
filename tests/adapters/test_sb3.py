"""The vectorized environment of Stable-Baselines3, beside Gymnasium's of the same seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from one_room import LENGTH, NOISE
from refusals import refusal

pytest.importorskip("stable_baselines3", reason="needs the extra sb3, which is not part of dev")

from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecMonitor

from sqn_jax.adapters.gym import NavigationEnv
from sqn_jax.adapters.gym_vector import NavigationVectorEnv
from sqn_jax.adapters.sb3 import NavigationVecEnv
from sqn_jax.maps import OccupancyMap

NUM_ENVS = 3
ACTIONS = np.random.default_rng(0).integers(0, 5, (2 * LENGTH + 1, NUM_ENVS))


def make(room: OccupancyMap, **arguments: Any) -> NavigationVecEnv:
    return NavigationVecEnv(room, NUM_ENVS, **NOISE, **arguments)


def test_an_episode_is_that_of_the_vector_environment_to_the_bit(room: OccupancyMap) -> None:
    # Goals that large are reached by chance, though not by all.
    size = {"goal_radius": 1.5}
    envs = make(room, **size)
    others = NavigationVectorEnv(room, NUM_ENVS, autoreset_mode="SameStep", **NOISE, **size)
    assert envs.seed(3) == [3, 4, 5]
    np.testing.assert_array_equal(envs.reset(), others.reset(seed=3)[0])
    reached, successes = np.zeros(NUM_ENVS, bool), []
    for actions in ACTIONS:
        obs, rewards, dones, infos = envs.step(actions)
        expected = others.step(actions)
        for array, other in zip((obs, rewards, dones), (*expected[:2], expected[3]), strict=True):
            np.testing.assert_array_equal(array, other)
        vector_info = expected[-1]
        names = [name for name in vector_info if f"_{name}" in vector_info and "final" not in name]
        for i, info in enumerate(infos):
            assert {name: info[name] for name in names} == {
                name: vector_info[name][i].item() for name in names
            }
            reached[i] |= info["reached"]
            if dones[i]:
                np.testing.assert_array_equal(
                    info["terminal_observation"], vector_info["final_obs"][i]
                )
                assert info["TimeLimit.truncated"] is True
                assert info["is_success"] is bool(reached[i])
                successes.append(info["is_success"])
                reached[i] = False
            else:
                assert info.keys() == set(names)
    assert len(successes) == 2 * NUM_ENVS
    assert len(set(successes)) == 2


def test_a_reset_uses_a_seed_once(room: OccupancyMap) -> None:
    envs = make(room)
    envs.seed(1)
    first, second = envs.reset(), envs.reset()
    assert (first != second).any()
    envs.seed(1)
    np.testing.assert_array_equal(envs.reset(), first)


def test_the_checker_and_the_monitor_of_stable_baselines3_fit(room: OccupancyMap) -> None:
    check_env(NavigationEnv(room, **NOISE))
    envs = VecMonitor(make(room, render_mode="rgb_array"))
    envs.reset()
    for actions in ACTIONS[:LENGTH]:
        *_, infos = envs.step(actions)
    assert infos[0]["episode"]["l"] == LENGTH
    assert envs.render().shape == (720, 960, 3)  # Four tiles of 360 x 480 pixels.
    envs.close()


def test_what_cannot_be_used_is_refused_in_a_line(room: OccupancyMap) -> None:
    assert "'arrays': Stable-Baselines3 sets it" in refusal(lambda: make(room, arrays="jax"))
    assert refusal(lambda: make(room, beams=3)).startswith("unknown option 'beams'")
    envs = make(room)
    assert envs.get_attr("num_envs", 1) == [NUM_ENVS]
    assert envs.env_is_wrapped(object) == [False] * NUM_ENVS
    for call in (lambda: envs.set_attr("x", 1), lambda: envs.env_method("x")):
        with pytest.raises(NotImplementedError, match="the envs"):
            call()
