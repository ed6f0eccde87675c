"""The Gymnasium environment: what Gymnasium's own checker says of it, and that it is `step`."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from one_room import LENGTH, NOISE, take
from refusals import refusal

from sqn_jax.adapters.gym import NavigationEnv
from sqn_jax.adapters.render import FREE, GOAL, OBSTACLE, ROBOT
from sqn_jax.maps import OccupancyMap


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """A pygame whose display notes what it shows."""
    shown: list[Any] = []
    window = SimpleNamespace(blit=lambda surface, _: shown.append(surface))
    display = SimpleNamespace(
        init=lambda: None,
        set_caption=lambda _: None,
        set_mode=lambda size: window,
        flip=lambda: None,
        quit=lambda: None,
    )
    pygame = SimpleNamespace(
        display=display,
        error=RuntimeError,
        time=SimpleNamespace(Clock=lambda: SimpleNamespace(tick=lambda _: None)),
        event=SimpleNamespace(pump=lambda: None),
        surfarray=SimpleNamespace(make_surface=lambda picture: picture),
    )
    monkeypatch.setitem(sys.modules, "pygame", pygame)
    monkeypatch.setenv("DISPLAY", ":0")
    return shown


def episode(env: Any, actions: Any, **reset: Any) -> list[Any]:
    """All observations and results of an episode."""
    results = [env.reset(**reset)]
    return results + [env.step(action) for action in actions]


def assert_same(results: Any, others: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, results, others)


ACTIONS = [1, 3, 1, 1, 4, 2]


@pytest.mark.usefixtures("screen")
def test_the_checker_of_gymnasium_has_nothing_to_say(room: OccupancyMap) -> None:
    check_env(gymnasium.make("sqn_jax/Map-v0", map=room, **NOISE).unwrapped)


def test_an_episode_is_that_of_step_to_the_bit(room: OccupancyMap) -> None:
    env = NavigationEnv(room, **NOISE)
    obs, info = env.reset(seed=4)
    assert info == {}
    state, noise_key = env._episode.env_state, env._episode.noise_key
    for number, action in enumerate(ACTIONS, start=1):
        obs, reward, terminated, truncated, info = env.step(action)
        key = jax.random.fold_in(noise_key, number - 1)
        expected, state, *others, expected_info = take(key, state, action, env.env_params)
        assert_same(obs, np.concatenate([expected.ranges, expected.goal]))
        assert [reward, terminated, truncated] == [value.item() for value in others]
        assert info == {name: value.item() for name, value in expected_info.items()}
        assert truncated == (number == LENGTH)
    assert env.observation_space.contains(obs)


def test_a_seed_is_a_sequence_of_episodes(room: OccupancyMap) -> None:
    env, other = NavigationEnv(room, **NOISE), NavigationEnv(room, **NOISE)
    first, second = episode(env, ACTIONS, seed=1), episode(env, ACTIONS)
    assert_same(episode(other, ACTIONS, seed=1), first)
    other.reset()  # Half an episode counts as one.
    third = episode(env, ACTIONS)
    assert_same(episode(other, ACTIONS), third)
    assert_same(episode(env, ACTIONS, seed=1), first)
    assert_same(episode(env, ACTIONS), second)
    starts = [first, second, third, episode(env, ACTIONS, seed=2)]
    starts += [episode(NavigationEnv(room, **NOISE), ACTIONS) for _ in range(2)]
    assert len({results[0][0].tobytes() for results in starts}) == len(starts)


def test_noise_differs_between_steps(room: OccupancyMap) -> None:
    env = NavigationEnv(room, **NOISE)
    observations = [result[0] for result in episode(env, [0] * 5, seed=0)]
    assert len({obs.tobytes() for obs in observations}) == 6


def test_results_are_the_user_s_own(room: OccupancyMap) -> None:
    env = NavigationEnv(room, **NOISE)
    obs, _ = env.reset(seed=0)
    obs[:] = 0
    assert env._obs.any()
    assert env.step(0)[0].flags.writeable


@pytest.mark.parametrize("name", ["Maze", "Column", "Forest", "Cave"])
def test_the_maps_of_the_project_are_registered(name: str) -> None:
    spec = gymnasium.spec(f"sqn_jax/{name}-v0")
    assert spec.kwargs == {"map": name.lower()}
    assert spec.vector_entry_point


def test_settings_are_given_by_keyword(room: OccupancyMap) -> None:
    env = gymnasium.make(
        "sqn_jax/Map-v0", map=room, num_beams=9, heading_encoding="sincos", max_steps=2
    ).unwrapped
    assert env.observation_space.shape == (9 + 3,)
    assert env.env_params.max_steps == 2
    # As a sweep has them.
    swept = NavigationEnv(room, max_steps=np.int64(3), range_noise=np.float32(0.5)).env_params
    assert (swept.max_steps, swept.config.range_noise) == (3, 0.5)
    assert NavigationEnv(room, time_step=0.2).metadata["render_fps"] == 5
    points = NavigationEnv(room, spawn="evaluation").env_params.spawn_positions
    assert_same(points[:, 0], room.evaluation_points.astype(np.float32))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_beam": 9}, "unknown option 'num_beam', expected num_beams?"),
        ({"fleet": 9}, "unknown option 'fleet', expected one of map, spawn, num_beams, "),
        ({"num_beams": 1}, "env.num_beams is 1, expected at least 2"),
        ({"num_beams": "9"}, "env.num_beams is '9', expected a value of type int"),
        ({"spawn": "here"}, "spawn is 'here', expected training or evaluation"),
        ({"render_mode": "ansi"}, "render_mode is 'ansi', expected human or rgb_array"),
        ({"map": "nowhere"}, "unknown map 'nowhere'"),
        ({"map": 3}, "map is 3, expected a name, a path or an OccupancyMap"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_line(
    room: OccupancyMap, arguments: dict[str, Any], message: str
) -> None:
    assert refusal(lambda: NavigationEnv(**{"map": room} | arguments)).startswith(message)


def test_actions_and_resets_that_cannot_be_are_refused(room: OccupancyMap) -> None:
    env = NavigationEnv(room, **NOISE)
    with pytest.raises(gymnasium.error.ResetNeeded, match="expected reset before step"):
        env.step(0)
    assert "option 'start', expected none" in refusal(lambda: env.reset(options={"start": 1}))
    env.reset(seed=0)
    for action in (5, -1, 1.0, "1", [1]):
        with pytest.raises(gymnasium.error.InvalidAction, match="whole number from 0 to 4"):
            env.step(action)


def test_a_picture_shows_the_map_the_robot_and_the_goal(room: OccupancyMap) -> None:
    env = NavigationEnv(room, render_mode="rgb_array", **NOISE)
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (360, 480, 3)  # 3 x 4 m, 120 pixels a meter.
    state = env._episode.env_state

    def pixel(x: float, y: float) -> tuple[int, ...]:
        return tuple(picture[int(360 - 120 * y), int(120 * x)].tolist())

    for corner in ((0.02, 0.02), (3.98, 0.02), (0.02, 2.98), (3.98, 2.98)):
        assert pixel(*corner) == OBSTACLE
    x, y, heading = state.pose.tolist()
    assert pixel(x + 0.05 * np.cos(heading), y + 0.05 * np.sin(heading)) == ROBOT
    assert pixel(*state.goal.tolist()) == GOAL
    colors = {tuple(color) for color in picture.reshape(-1, 3).tolist()}
    assert FREE in colors  # Behind the wall in the middle.


def test_a_window_shows_every_state(room: OccupancyMap, screen: list[Any]) -> None:
    env = NavigationEnv(room, render_mode="human", **NOISE)
    episode(env, ACTIONS, seed=0)
    assert len(screen) == 1 + LENGTH
    assert screen[0].shape == (480, 360, 3)
    assert env.render() is None
    env.close()


@pytest.mark.usefixtures("screen")
@pytest.mark.parametrize("missing", ["pygame", "display"])
def test_a_window_that_nobody_sees_is_refused(
    room: OccupancyMap, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    if missing == "pygame":
        monkeypatch.setitem(sys.modules, "pygame", None)
    else:
        for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
            monkeypatch.delenv(name, raising=False)
    with pytest.raises((ImportError, RuntimeError), match='render_mode is "human", ') as caught:
        NavigationEnv(room, render_mode="human")
    assert "\n" not in str(caught.value)
