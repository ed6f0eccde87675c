"""What the agent sees: scaling, heading, and the noise on readings and velocity."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_oracle import open_map, wrap_map
from rollouts import Rollout

from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams, EnvState, make_env, observe, reset_to, step
from sqn_jax.env.geometry import decode_goal, encode_distance

SAMPLES = 4000
Unit = Literal["relative", "absolute"]


def empty_hall(config: EnvConfig | None = None) -> EnvParams:
    """An empty hall of 9 m x 7 m, walls 0.05 m thick, and a robot in it."""
    return make_env(wrap_map(open_map(rows=140, columns=180), [(2.0, 2.0), (6.0, 2.0)]), config)


@pytest.fixture(scope="module")
def empty_params() -> EnvParams:
    return empty_hall()


start_at = jax.jit(reset_to)


@jax.jit
def many_starts(pose, goal, params):
    """Observations of the same start with `SAMPLES` keys."""
    keys = jax.random.split(jax.random.key(3), SAMPLES)
    return jax.vmap(lambda key: reset_to(key, pose, goal, params)[0])(keys)


@jax.jit
def many_steps(pose, action, params):
    """Poses and rewards of one action from the same start with `SAMPLES` keys."""
    keys = jax.random.split(jax.random.key(4), SAMPLES)
    _, state = reset_to(keys[0], pose, jnp.array([4.0, 4.0]), params)
    _, states, rewards, *_ = jax.vmap(lambda key: step(key, state, action, params))(keys)
    return states.pose, rewards


def test_every_number_of_whole_episodes_lies_in_zero_to_one(
    maze_rollout: Rollout, hall_rollout: Rollout
) -> None:
    for run in (maze_rollout, hall_rollout):
        for leaf, size in ((run.observations.ranges, 71), (run.observations.goal, 2)):
            assert leaf.shape[-1] == size
            assert leaf.dtype == np.float32
            assert leaf.min() >= 0.0
            assert leaf.max() <= 1.0
        # The whole width is used: at least the maximal range, and headings all around.
        assert run.observations.ranges.max() == 1.0
        assert np.ptp(run.observations.goal[..., 1]) > 0.9


def test_the_numbers_are_scaled_as_documented(empty_params: EnvParams) -> None:
    # Facing +y at (2, 2): the south wall is behind, east beam 17 (-90 degrees) reads 5 m or more,
    # west beam 53 the wall at 0.05 m. The goal is 3 m east and 4 m north: 5 m, at
    # atan2(4, 3) - 90 = -36.87 degrees, (180 - 36.87) / 360 = 0.39758.
    pose, goal = jnp.array([2.0, 2.0, jnp.pi / 2]), jnp.array([5.0, 6.0])
    obs, _ = start_at(jax.random.key(0), pose, goal, empty_params)
    assert obs.ranges[17] == 1.0
    assert obs.ranges[53] == pytest.approx((2.0 - 0.05) / 5.0, abs=1e-5)
    assert obs.ranges[35] == pytest.approx((6.95 - 2.0) / 5.0, abs=1e-5)
    np.testing.assert_allclose(obs.goal, [5.0 / 24.0, 0.39758], atol=1e-5)


def test_the_goal_distance_saturates_at_its_limit() -> None:
    params = empty_hall(EnvConfig(max_goal_distance=2.0))
    for distance, expected in ((1.0, 0.5), (2.0, 1.0), (5.0, 1.0)):
        pose, goal = jnp.array([2.0, 2.0, 0.0]), jnp.array([2.0 + distance, 2.0])
        obs, _ = start_at(jax.random.key(0), pose, goal, params)
        assert obs.goal[0] == pytest.approx(expected, abs=1e-6)


def test_a_rational_goal_distance_is_a_half_at_its_scale_and_tells_all_apart(
    empty_params: EnvParams,
) -> None:
    """5, 15 and 60 m at a scale of 5 m: 5/10, 15/20, 60/65; on the agent's input as it stands."""
    config = EnvConfig(goal_distance_encoding="rational")
    params = dataclasses.replace(empty_params, config=config)
    ranges = jnp.full(71, 1.0)
    for distance, expected in ((0.0, 0.0), (5.0, 0.5), (15.0, 0.75), (60.0, 12 / 13)):
        state = EnvState(jnp.zeros(3), jnp.array([0.0, distance]), jnp.zeros(1), jnp.int32(0))
        obs = observe(jax.random.key(0), ranges, state, params)
        np.testing.assert_allclose(obs.goal, [expected, 0.75 if distance else 0.5], atol=1e-6)
    distances = jnp.linspace(0.0, 1000.0, 10_001)
    shown = np.asarray(encode_distance(distances, config))
    assert (np.diff(shown) > 0).all()
    assert shown[-1] < 1


def test_a_rational_goal_distance_of_60_m_passes_the_replay_to_the_centimeter() -> None:
    """Half of 1/65535 at a slope of 5 / 65^2 a meter is 6.4 mm."""
    config = EnvConfig(goal_distance_encoding="rational")
    distances = np.linspace(0.0, 60.0, 5000)
    stored = np.round(distances / (distances + 5) * 65535).astype(np.uint16)
    shown = stored.astype(np.float32) / np.float32(65535)
    found, _ = decode_goal(np.stack([shown, shown], axis=-1), config)
    assert np.abs(found - distances).max() < 0.0065


def test_the_linear_heading_has_its_seam_behind_the_robot(empty_params: EnvParams) -> None:
    for heading in (0.0, 2.8, -1.3):
        for bearing, expected in (
            (0.0, 0.5),
            (np.pi / 2, 0.75),
            (-np.pi / 2, 0.25),
            (np.pi - 1e-3, 1.0 - 1e-3 / (2 * np.pi)),
            (-np.pi + 1e-3, 1e-3 / (2 * np.pi)),
        ):
            direction = heading + bearing
            goal = jnp.array([4.0 + np.cos(direction), 3.0 + np.sin(direction)])
            pose = jnp.array([4.0, 3.0, heading])
            obs, _ = start_at(jax.random.key(0), pose, goal, empty_params)
            assert obs.goal[1] == pytest.approx(expected, abs=1e-5)


def test_sine_and_cosine_of_the_heading_have_no_seam() -> None:
    params = empty_hall(EnvConfig(heading_encoding="sincos"))
    for bearing in (0.0, 1.0, -2.0, np.pi - 1e-4, -np.pi + 1e-4):
        goal = jnp.array([4.0 + np.cos(0.4 + bearing), 3.0 + np.sin(0.4 + bearing)])
        obs, _ = start_at(jax.random.key(0), jnp.array([4.0, 3.0, 0.4]), goal, params)
        expected = [1.0 / 24.0, (1 + np.sin(bearing)) / 2, (1 + np.cos(bearing)) / 2]
        np.testing.assert_allclose(obs.goal, expected, atol=1e-5)


@pytest.mark.parametrize("unit", ["relative", "absolute"])
def test_range_noise_is_uniform_about_the_true_reading_and_clipped(unit: Unit) -> None:
    # Facing east at (2, 2): beam 53 (north) reads 6.95 - 2.0 = 4.95 m, beam 17 (south) 1.95 m,
    # beam 35 (east) the maximal 5 m.
    pose, goal = jnp.array([2.0, 2.0, 0.0]), jnp.array([4.0, 2.0])
    params = empty_hall(EnvConfig(range_noise=0.4, range_noise_unit=unit))
    ranges = np.asarray(many_starts(pose, goal, params).ranges)
    assert ranges.min() >= 0.0
    assert ranges.max() == 1.0
    south = ranges[:, 17] * 5.0
    half_width = 0.4 * 1.95 if unit == "relative" else 0.4 * 5.0
    low, high = max(1.95 - half_width, 0.0), 1.95 + half_width
    assert low - 1e-4 <= south.min() <= low + 0.02
    assert high - 0.02 <= south.max() <= high + 1e-4
    # A uniform distribution: equal counts in eight bins, up to 5 sigma of a binomial.
    inside = south[south > 0]
    counts, _ = np.histogram(inside, bins=8, range=(low, high))
    share = len(inside) / 8
    assert np.abs(counts - share).max() < 5 * np.sqrt(share)
    if unit == "absolute":
        # 1.95 m with noise below -1.95 of -2..2 m: one in eighty reads nothing at all.
        assert np.mean(south == 0) == pytest.approx(0.05 / 4, abs=0.01)
    # Half of the readings at the maximal range would be longer, and are clipped.
    assert np.mean(ranges[:, 35] == 1.0) == pytest.approx(0.5, abs=0.05)
    # Beams are independent of each other.
    assert abs(np.corrcoef(ranges[:, 17], ranges[:, 18])[0, 1]) < 0.08
    # The goal is not touched.
    np.testing.assert_array_equal(np.ptp(many_starts(pose, goal, params).goal, axis=0), 0.0)


def test_the_reward_sees_the_true_scan() -> None:
    pose = jnp.array([2.0, 2.0, 0.7])
    # The goal at (4, 4) is 2.83 m away, far from any wall.
    _, noisy = many_steps(pose, 0, empty_hall(EnvConfig(range_noise=0.9)))
    np.testing.assert_allclose(noisy, 2 * np.exp(-np.sqrt(8.0)) - 0.2, atol=1e-5)
    # Coverage too: a turn uncovers the same with and without noise.
    _, noisy = many_steps(pose, 3, empty_hall(EnvConfig(range_noise=0.9)))
    _, exact = many_steps(pose, 3, empty_hall())
    np.testing.assert_array_equal(noisy, exact)
    assert exact[0] > 0.1


@pytest.mark.parametrize(
    ("unit", "sigma"), [("relative", (0.5, 0.2 * np.pi)), ("absolute", (0.2, 0.2))]
)
@pytest.mark.parametrize(
    ("action", "command"), [(0, (0.0, 0.0)), (1, (2.5, 0.0)), (2, (-1.25, 0.0)), (3, (0.0, np.pi))]
)
def test_velocity_noise_has_the_moments_it_should(
    unit: Unit, sigma: tuple[float, float], action: int, command: tuple[float, float]
) -> None:
    # Sigma 0.2: relative to (2.5 m/s, pi rad/s), or in m/s and rad/s.
    params = empty_hall(EnvConfig(velocity_noise=0.2, velocity_noise_unit=unit))
    poses = np.asarray(many_steps(jnp.array([4.5, 3.5, 0.5]), action, params)[0], np.float64)
    turn = poses[:, 2] - 0.5
    # The chord of an arc points along the middle heading, and is shorter by sin(a) / a.
    middle = 0.5 + turn / 2
    chord = (poses[:, 0] - 4.5) * np.cos(middle) + (poses[:, 1] - 3.5) * np.sin(middle)
    speed = chord / 0.1 / np.sinc(turn / 2 / np.pi)
    for got, mean, std in ((speed, command[0], sigma[0]), (turn / 0.1, command[1], sigma[1])):
        # Five standard errors of a mean and of a standard deviation.
        assert np.mean(got) == pytest.approx(mean, abs=5 * std / np.sqrt(SAMPLES))
        assert np.std(got) == pytest.approx(std, abs=5 * std / np.sqrt(2 * SAMPLES))
        # Normal: 68.3 % within one sigma.
        assert np.mean(np.abs(got - mean) < std) == pytest.approx(0.683, abs=0.04)
    assert abs(np.corrcoef(speed, turn)[0, 1]) < 0.08


def test_without_noise_every_key_gives_the_same(empty_params: EnvParams) -> None:
    pose, goal = jnp.array([2.0, 2.0, 0.3]), jnp.array([4.0, 2.0])
    assert np.ptp(many_starts(pose, goal, empty_params).ranges, axis=0).max() == 0.0
    assert np.ptp(many_steps(pose, 1, empty_params)[0], axis=0).max() == 0.0
