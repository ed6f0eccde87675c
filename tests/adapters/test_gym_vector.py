"""The Gymnasium vector environment, beside Gymnasium's own of as many single environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from one_room import LENGTH, NOISE
from refusals import refusal

import sqn_jax
from sqn_jax.adapters.gym import NavigationEnv
from sqn_jax.adapters.gym_vector import NavigationVectorEnv
from sqn_jax.maps import OccupancyMap

NUM_ENVS = 3
ACTIONS = np.random.default_rng(0).integers(0, 5, (3 * LENGTH, NUM_ENVS))
ONE_OF_THREE = np.array([False, True, False])


def make(room: OccupancyMap, mode: Any = AutoresetMode.NEXT_STEP, **arguments: Any) -> Any:
    return NavigationVectorEnv(room, NUM_ENVS, autoreset_mode=mode, **NOISE, **arguments)


def assert_same_infos(infos: dict[str, Any], expected: dict[str, Any]) -> None:
    """Equal where Gymnasium has an entry, and masked out where it has none."""
    assert infos.keys() >= expected.keys()
    for name, values in infos.items():
        if name.startswith("_"):
            continue
        mask = expected.get(f"_{name}", np.zeros(NUM_ENVS, bool))
        np.testing.assert_array_equal(infos[f"_{name}"], mask)
        if isinstance(values, dict):
            assert_same_infos(values, expected[name])
        elif mask.any():
            np.testing.assert_allclose(
                np.stack(values[mask]), np.stack(expected[name][mask]), rtol=1e-5, atol=1e-5
            )


def assert_same_results(results: Any, expected: Any) -> None:
    for array, other in zip(results[:-1], expected[:-1], strict=True):
        np.testing.assert_allclose(array, other, rtol=1e-5, atol=1e-5)
    assert_same_infos(results[-1], expected[-1])


def test_a_step_is_that_of_the_simulator_to_the_bit(room: OccupancyMap) -> None:
    many = jax.jit(jax.vmap(sqn_jax.step, in_axes=(0, 0, 0, None)))
    envs = make(room, "SameStep")
    envs.reset(seed=2)
    for actions in ACTIONS:
        _, episodes = envs._before
        keys = jax.vmap(jax.random.fold_in)(episodes.noise_key, episodes.env_state.step)
        expected = many(keys, episodes.env_state, actions, envs.env_params)
        obs, *results, infos = envs.step(actions)
        for array, other in zip(results, expected[2:5], strict=True):
            np.testing.assert_array_equal(array, other)
        is_over, info = results[-1].any(), infos
        if is_over:
            obs, info = np.stack(infos["final_obs"]), infos["final_info"]
        expected_obs = np.concatenate([expected[0].ranges, expected[0].goal], axis=1)
        np.testing.assert_array_equal(obs, expected_obs)
        for name, values in expected[5].items():
            np.testing.assert_array_equal(info[name], values)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_all_modes_are_those_of_gymnasium(room: OccupancyMap, mode: AutoresetMode) -> None:
    singles = [lambda: NavigationEnv(room, **NOISE)] * NUM_ENVS
    envs, others = make(room, mode), SyncVectorEnv(singles, autoreset_mode=mode)
    assert envs.observation_space == others.observation_space
    assert envs.action_space == others.action_space
    assert envs.metadata["autoreset_mode"] is mode
    assert_same_results(envs.reset(seed=7), others.reset(seed=7))
    ends = []
    for number, actions in enumerate(ACTIONS):
        results = envs.step(actions)
        assert_same_results(results, others.step(actions))
        ends.append(results[3])
        reset: Any = None
        if number == 1:  # From here on its episodes end at other times.
            reset = (ONE_OF_THREE, [5, 6, 7])
        elif mode is AutoresetMode.DISABLED and results[3].any():
            reset = (results[3], None)
        if reset:
            mask, seed = reset
            expected = others.reset(seed=seed, options={"reset_mask": mask.copy()})
            options = {"reset_mask": mask}
            assert_same_results(envs.reset(seed=seed, options=options), expected)
            assert options == {"reset_mask": mask}
    period = LENGTH + (mode is AutoresetMode.NEXT_STEP)
    assert np.flatnonzero(np.stack(ends)[:, 0])[:2].tolist() == [LENGTH - 1, LENGTH - 1 + period]
    assert np.flatnonzero(np.stack(ends)[:, 1])[:1].tolist() == [LENGTH + 1]
    assert_same_results(envs.reset(), others.reset())


def test_the_batch_stays_on_the_device_where_that_is_asked_for(room: OccupancyMap) -> None:
    mode = AutoresetMode.SAME_STEP
    envs, others = make(room, mode, arrays="jax"), make(room, mode)
    np.testing.assert_array_equal(envs.reset(seed=1)[0], others.reset(seed=1)[0])
    for actions in ACTIONS[: LENGTH + 1]:
        results, expected = envs.step(jax.numpy.asarray(actions)), others.step(actions)
        assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(results))
        final = expected[-1].pop("final_obs", None)
        if final is not None:
            np.testing.assert_array_equal(results[-1]["final_obs"], np.stack(final))
        for array, other in zip(results[:-1], expected[:-1], strict=True):
            np.testing.assert_array_equal(array, other)
            assert isinstance(other, np.ndarray)
            assert other.flags.writeable
        for name in expected[-1].keys() - {"final_info"}:
            np.testing.assert_array_equal(results[-1][name], expected[-1][name])


def test_the_wrappers_of_gymnasium_fit(room: OccupancyMap) -> None:
    envs = make(room, "SameStep")
    envs = DictInfoToList(RecordEpisodeStatistics(envs))
    envs.reset(seed=0)
    rewards = []
    for actions in ACTIONS[:LENGTH]:
        _, reward, _, _, infos = envs.step(actions)
        rewards.append(reward)
    assert infos[1]["episode"]["l"] == LENGTH
    np.testing.assert_allclose(infos[1]["episode"]["r"], np.sum(rewards, axis=0)[1], rtol=1e-5)
    assert "goal_distance" in infos[1]["final_info"]
    assert "goal_distance" not in infos[1]


def test_make_vec_takes_it(room: OccupancyMap) -> None:
    envs = gymnasium.make_vec(
        "sqn_jax/Map-v0",
        NUM_ENVS,
        map=room,
        max_episode_steps=9,
        num_beams=8,
        render_mode="rgb_array",
    )
    assert isinstance(envs, NavigationVectorEnv)
    assert envs.env_params.max_steps == 9
    assert envs.observation_space.shape == (NUM_ENVS, 8 + 2)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP


def test_every_env_has_its_picture(room: OccupancyMap) -> None:
    envs = make(room, render_mode="rgb_array")
    single = NavigationEnv(room, render_mode="rgb_array", **NOISE)
    envs.reset(seed=3)
    single.reset(seed=3 + NUM_ENVS - 1)
    pictures = envs.render()
    assert len(pictures) == NUM_ENVS
    assert np.mean(pictures[-1] != single.render()) < 0.01
    assert (pictures[0] != pictures[1]).any()


def test_envs_differ_with_and_without_a_seed(room: OccupancyMap) -> None:
    envs, others = make(room), make(room)
    observations = [*envs.reset()[0], *others.reset()[0], *others.reset(seed=0)[0]]
    observations += [*envs.reset()[0], *envs.reset(seed=[7, 8, None])[0]]
    assert len({obs.tobytes() for obs in observations}) == len(observations)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0, expected a whole number from 1 on"),
        ({"num_envs": 2.0}, "num_envs is 2.0, expected a whole number from 1 on"),
        ({"arrays": "torch"}, "arrays is 'torch', expected numpy or jax"),
        ({"render_mode": "human"}, "render_mode is 'human', expected rgb_array"),
        ({"autoreset_mode": "Never"}, "autoreset_mode is 'Never', expected one of NextStep, "),
        ({"max_steps": 1, "max_episode_steps": 1}, "both max_steps and max_episode_steps"),
        ({"beams": 1}, "unknown option 'beams', expected num_beams?"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_line(
    room: OccupancyMap, arguments: dict[str, Any], message: str
) -> None:
    assert refusal(lambda: NavigationVectorEnv(room, **arguments)).startswith(message)


def test_actions_seeds_and_masks_that_cannot_be_are_refused(room: OccupancyMap) -> None:
    envs = make(room, "Disabled")
    actions = ACTIONS[0]
    with pytest.raises(gymnasium.error.ResetNeeded, match="no episode has begun"):
        envs.step(actions)
    with pytest.raises(gymnasium.error.ResetNeeded, match="no episode has begun"):
        envs.reset(options={"reset_mask": ONE_OF_THREE})
    envs.reset(seed=0)
    for wrong in (actions[:2], actions + 0.5, actions - 5, actions + 5, 1):
        with pytest.raises(gymnasium.error.InvalidAction, match=r"expected whole numbers of sha"):
            envs.step(wrong)
    assert "seed has 2 entries, expected 3" in refusal(lambda: envs.reset(seed=[1, 2]))
    assert "seed is 1.5, expected a whole number" in refusal(lambda: envs.reset(seed=1.5))
    first, again = (envs.reset(seed=seed)[0] for seed in (7, np.int64(7)))
    np.testing.assert_array_equal(first, again)
    assert "expected reset_mask" in refusal(lambda: envs.reset(options={"mask": 1}))
    for mask in (ONE_OF_THREE[:2], ONE_OF_THREE & False, [True] * 3, ONE_OF_THREE.astype(int)):
        said = refusal(lambda mask=mask: envs.reset(options={"reset_mask": mask}))
        assert "expected a bool array of shape (3,) with at least one True" in said
    for actions in ACTIONS[:LENGTH]:
        envs.step(actions)
    with pytest.raises(gymnasium.error.ResetNeeded, match="an episode is over"):
        envs.step(actions)
