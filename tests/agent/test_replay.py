"""The ring against a list, draws against probabilities, weights and priorities by hand."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from small_problems import HIDDEN, Seen, SeenWithMotion, random_episodes

from sqn_jax.agent import Trajectory, r2d2, replay

add = jax.jit(replay.add)
sample = jax.jit(
    replay.sample, static_argnames=("batch_size", "priority_exponent", "importance_exponent")
)
ITEM = {"a": jax.ShapeDtypeStruct((3,), jnp.float32), "b": jax.ShapeDtypeStruct((), jnp.uint8)}


def block(first: int, size: int) -> dict[str, jax.Array]:
    """Items numbered from `first`, no two rows nor columns alike."""
    numbers = np.arange(first, first + size)
    rows = numbers[:, None] + np.array([[0.0, 0.25, 0.5]])
    return {"a": jnp.asarray(rows, jnp.float32), "b": jnp.asarray(numbers % 256, jnp.uint8)}


def filled(priorities: list[float], capacity: int) -> replay.ReplayState:
    """A replay holding one item a priority, item i at place i."""
    state = replay.init(ITEM, capacity, 1)
    for place in range(len(priorities)):
        state = add(state, block(place, 1))
    return replay.update_priorities(
        state, jnp.arange(len(priorities)), jnp.asarray(priorities, jnp.float32)
    )


@pytest.mark.parametrize(("capacity", "size"), [(12, 4), (12, 3), (6, 6), (5, 1)])
def test_the_ring_holds_what_a_list_of_the_newest_holds(capacity: int, size: int) -> None:
    rng = np.random.default_rng(capacity)
    state = replay.init(ITEM, capacity, size)
    places: list[int | None] = [None] * capacity
    priorities = [0.0] * capacity
    largest, following = 1.0, 0
    for count in range(20):
        state = add(state, block(size * count, size))
        for offset in range(size):
            places[following] = size * count + offset
            priorities[following] = largest
            following = (following + 1) % capacity
        stored = [place for place, number in enumerate(places) if number is not None]
        if rng.random() < 0.5:
            chosen = rng.choice(stored, size=min(3, len(stored)), replace=False)
            values = rng.uniform(0.1, 3.0, len(chosen))
            for place, value in zip(chosen, values, strict=True):
                priorities[place] = value
            largest = max(largest, values.max())
            state = replay.update_priorities(
                state, jnp.asarray(chosen), jnp.asarray(values, jnp.float32)
            )
        assert int(state.size) == len(stored)
        assert int(state.position) == following
        np.testing.assert_allclose(state.priorities, priorities, rtol=1e-6)
        for place in stored:
            expected = block(places[place], 1)
            row, column = divmod(place, size)
            np.testing.assert_array_equal(state.storage["a"][row, column], expected["a"][0])
            assert int(state.storage["b"][row, column]) == int(expected["b"][0])


def test_a_block_that_does_not_divide_the_capacity_is_refused() -> None:
    with pytest.raises(ValueError, match="block of 5 items does not divide the capacity 12"):
        replay.init(ITEM, 12, 5)


def test_items_of_another_type_are_refused() -> None:
    items = block(0, 4)
    with pytest.raises(AssertionError):
        replay.add(replay.init(ITEM, 12, 4), {**items, "b": items["b"].astype(jnp.float32)})


def test_a_block_of_another_size_is_refused() -> None:
    with pytest.raises(AssertionError):
        replay.add(replay.init(ITEM, 12, 4), block(0, 3))


@pytest.mark.parametrize("exponent", [0.0, 0.5, 0.9, 1.0])
def test_items_are_drawn_in_proportion_to_powers_of_their_priorities(exponent: float) -> None:
    priorities, draws = [0.2, 3.0, 1.0, 0.5, 8.0], 20_000
    state = filled(priorities, capacity=8)
    items, places, _ = sample(
        jax.random.key(3), state, draws, priority_exponent=exponent, importance_exponent=0.4
    )
    weights = [priority**exponent for priority in priorities]
    expected = np.array(weights) / sum(weights)
    np.testing.assert_allclose(
        replay.probabilities(state, exponent), [*expected, 0, 0, 0], atol=1e-6
    )
    counts = np.bincount(places, minlength=8)
    assert counts[5:].sum() == 0, "a place where nothing is stored was drawn"
    assert stats.chisquare(counts[:5], draws * expected).pvalue > 0.001
    np.testing.assert_array_equal(items["b"], places)
    np.testing.assert_array_equal(items["a"][:, 1], np.asarray(places) + 0.25)


def test_draws_are_independent_of_each_other_and_of_other_keys() -> None:
    state = filled([1.0] * 4, capacity=4)
    exponents = {"priority_exponent": 1.0, "importance_exponent": 0.0}
    _, first, _ = sample(jax.random.key(4), state, 8000, **exponents)
    _, second, _ = sample(jax.random.key(5), state, 8000, **exponents)
    for one, other in ((first[:-1], first[1:]), (first, second)):
        pairs = np.bincount(4 * np.asarray(one) + np.asarray(other), minlength=16)
        assert stats.chisquare(pairs).pvalue > 0.001


def test_importance_weights_are_those_worked_out_by_hand() -> None:
    # Chances 1/10, 2/10, 3/10, 4/10 of four items: 4 p = 0.4, 0.8, 1.2, 1.6; with exponent 1/2 and
    # scaled by the largest, sqrt(0.4 / 4 p) = 1, sqrt(1/2), sqrt(1/3), 1/2.
    state = filled([1.0, 2.0, 3.0, 4.0], capacity=6)
    by_hand = np.array([1.0, 0.5**0.5, (1 / 3) ** 0.5, 0.5])
    _, places, weights = sample(
        jax.random.key(6), state, 40, priority_exponent=1.0, importance_exponent=0.5
    )
    assert set(np.asarray(places)) == {0, 1, 2, 3}
    np.testing.assert_allclose(weights, by_hand[places], rtol=1e-5)
    for uncorrected in ((1.0, 0.0), (0.0, 0.6)):
        _, _, weights = sample(
            jax.random.key(7),
            state,
            40,
            priority_exponent=uncorrected[0],
            importance_exponent=uncorrected[1],
        )
        np.testing.assert_allclose(weights, np.ones(40), rtol=1e-6)


def test_weights_are_scaled_by_the_largest_of_the_batch_itself() -> None:
    state = filled([1.0, 1e6], capacity=2)
    _, places, weights = sample(
        jax.random.key(8), state, 6, priority_exponent=1.0, importance_exponent=0.6
    )
    assert np.asarray(places).tolist() == [1] * 6
    np.testing.assert_allclose(weights, np.ones(6))


def test_a_single_item_in_a_large_replay_is_the_only_one_drawn() -> None:
    state = replay.init(ITEM, 10_000, 1)
    state = add(state, block(7, 1))
    items, places, weights = sample(
        jax.random.key(9), state, 64, priority_exponent=0.9, importance_exponent=0.6
    )
    assert not np.asarray(places).any()
    assert set(np.asarray(items["b"])) == {7}
    np.testing.assert_allclose(weights, np.ones(64))


def test_new_items_get_the_largest_priority_ever_seen() -> None:
    state = filled([0.5, 4.0], capacity=4)
    state = replay.update_priorities(state, jnp.array([1]), jnp.array([0.25]))
    state = add(state, block(2, 1))
    np.testing.assert_allclose(state.priorities, [0.5, 0.25, 4.0, 0.0])


def test_no_priority_falls_to_zero() -> None:
    state = filled([0.0, 1.0], capacity=2)
    assert float(state.priorities[0]) > 0
    assert float(replay.probabilities(state, 0.9)[0]) > 0


def test_sequence_priorities_mix_the_largest_and_the_mean_error() -> None:
    # First sequence: |errors| 1, 3, 2, largest 3, mean 2; second: 0, 0, 6, largest 6, mean 2.
    errors = jnp.array([[1.0, 0.0], [-3.0, 0.0], [2.0, -6.0]])
    np.testing.assert_allclose(
        replay.sequence_priorities(errors, 0.9), [0.9 * 3 + 0.1 * 2, 0.9 * 6 + 0.1 * 2], rtol=1e-6
    )
    np.testing.assert_allclose(replay.sequence_priorities(errors, 0.0), [2.0, 2.0], rtol=1e-6)
    np.testing.assert_allclose(replay.sequence_priorities(errors, 1.0), [3.0, 6.0], rtol=1e-6)


def test_num_bytes_is_what_is_allocated() -> None:
    item = {"a": jnp.zeros((7, 3), jnp.float32), "b": jnp.zeros(5, jnp.uint8)}
    allocated = sum(leaf.nbytes for leaf in jax.tree.leaves(replay.init(item, 9, 3)))
    assert replay.num_bytes(item, 9) == allocated == 9 * (7 * 3 * 4 + 5 + 4) + 12


def test_packed_episodes_come_back_to_the_rounding_of_their_integers() -> None:
    episodes = random_episodes(np.random.default_rng(40), 5, 3, terminated=0.3)
    # The ends of the scale, which must not wrap around.
    ranges = episodes.obs.ranges.at[0, 0, :2].set(jnp.array([0.0, 1.0]))
    goal = episodes.obs.goal.at[0, 0].set(jnp.array([0.0, 1.0]))
    episodes = episodes.replace(obs=episodes.obs.replace(ranges=ranges, goal=goal))
    packed = r2d2.pack(episodes)
    assert packed.obs.ranges.shape == (3, 6, 4)
    assert packed.obs.ranges.dtype == packed.actions.dtype == jnp.uint8
    assert packed.obs.goal.dtype == jnp.uint16
    np.testing.assert_array_equal(packed.actions, np.asarray(episodes.actions).T)
    back = r2d2.unpack(packed, HIDDEN)
    assert not np.asarray(back.carry).any(), "a stored episode begins without a memory"
    assert jax.tree.map(lambda x: (x.shape, x.dtype), back) == jax.tree.map(
        lambda x: (x.shape, x.dtype), episodes
    )
    assert np.abs(np.asarray(back.obs.ranges - ranges)).max() <= 0.5 / 255 + 1e-6
    assert np.abs(np.asarray(back.obs.goal - goal)).max() <= 0.5 / 65535 + 1e-6
    np.testing.assert_array_equal(back.obs.ranges[0, 0, :2], [0.0, 1.0])
    np.testing.assert_array_equal(back.obs.goal[0, 0], [0.0, 1.0])
    for name in ("actions", "rewards", "terminated"):
        np.testing.assert_array_equal(getattr(back, name), getattr(episodes, name))


def test_packed_motion_comes_back_exactly() -> None:
    rng = np.random.default_rng(42)
    episodes = random_episodes(rng, 5, 3)
    motion = jnp.asarray(rng.integers(0, 2, (6, 3, 4)), jnp.float32)
    seen = SeenWithMotion(episodes.obs.ranges, episodes.obs.goal, motion)
    packed = r2d2.pack(episodes.replace(obs=seen))
    assert packed.obs.motion.dtype == jnp.uint8
    back = r2d2.unpack(packed, HIDDEN).obs.motion
    assert back.dtype == jnp.float32
    np.testing.assert_array_equal(back, motion)


def test_episodes_survive_the_replay_in_order() -> None:
    episodes = random_episodes(np.random.default_rng(41), 5, 3)
    state = replay.init(r2d2.packed_item(episodes), 6, 3)
    state = replay.add(replay.add(state, r2d2.pack(episodes)), r2d2.pack(episodes))
    items, places, _ = sample(
        jax.random.key(10), state, 4, priority_exponent=0.9, importance_exponent=0.6
    )
    drawn = r2d2.unpack(items, HIDDEN)
    robots = np.asarray(places) % 3
    np.testing.assert_array_equal(drawn.actions, episodes.actions[:, robots])
    np.testing.assert_array_equal(drawn.rewards, episodes.rewards[:, robots])
    np.testing.assert_allclose(drawn.obs.goal, episodes.obs.goal[:, robots], atol=1e-5)


def test_the_replay_of_the_paper_takes_less_than_half_a_gigabyte() -> None:
    def shape(*sizes: int, dtype: Any = jnp.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(sizes, dtype)

    episodes = Trajectory(
        obs=Seen(ranges=shape(401, 50, 71), goal=shape(401, 50, 2)),
        actions=shape(400, 50, dtype=jnp.int32),
        rewards=shape(400, 50),
        terminated=shape(400, 50, dtype=jnp.bool_),
        carry=shape(50, 128),
    )
    # 71 ranges of 1 byte and two numbers of 2 bytes at each of 401 observations; action, reward
    # and end in 1, 4 and 1 bytes at each of 400 steps; a priority of 4 bytes.
    episode_bytes = 401 * (71 + 2 * 2) + 400 * (1 + 4 + 1)
    total = replay.num_bytes(r2d2.packed_item(episodes), 10_000)
    assert total == 10_000 * (episode_bytes + 4) + 12
    assert total < 0.5e9
