"""Runs divided between two devices, beside the same runs on one."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from jax.sharding import Mesh, PartitionSpec
from rooms import small_room

from sqn_jax.agent import shards
from sqn_jax.agent.learner import policy_params
from sqn_jax.config import LearnerConfig, NetworkConfig, ReplayConfig, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import EnvParams
from sqn_jax.storage.checkpoint import Checkpoints
from sqn_jax.storage.manifest import Origin
from sqn_jax.training import devices, loop
from sqn_jax.training.loop import make_program
from sqn_jax.training.state import params_shapes

LENGTH = 12


@pytest.fixture(autouse=True, scope="module")
def quick_compilation() -> Iterator[None]:
    with compiling_quickly():
        yield


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    chosen = devices.choose(config_for("pqn"), 2)
    assert chosen is not None
    return chosen


@pytest.fixture(scope="module")
def world() -> EnvParams:
    """One for all runs, so that a run is started by the same compiled program in every test."""
    return small_room(LENGTH, velocity_noise=0.2, range_noise=0.2)


def config_for(method: Any, **changes: Any) -> TrainConfig:
    """Four robots, two chunks of two rounds."""
    learner = {"batch_size": 4, "learning_rate": 1e-3, "burn_in_length": 2}
    preset = PRESETS["smoke"]
    return dataclasses.replace(
        preset,
        method=method,
        num_envs=4,
        total_episodes=16,
        updates_per_round=3,
        network=NetworkConfig(hidden_size=8, layer_norm=True),
        replay=ReplayConfig(capacity=8, min_episodes=8),
        learner=dataclasses.replace(preset.learner, window_length=LENGTH // 2, **learner),
        **changes,
    )


def spread(mesh: Mesh, function: Any, *specs: PartitionSpec, out: Any) -> Any:
    """The function on each device, with arguments divided as told."""
    return jax.jit(
        jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=out, check_vma=False)
    )


WHOLE, ROWS, COLUMNS = PartitionSpec(), PartitionSpec("devices"), PartitionSpec(None, "devices")


def test_own_shards_laid_together_are_the_whole(mesh: Mesh) -> None:
    whole = jnp.arange(24.0).reshape(6, 4)
    for axis, divided in ((0, ROWS), (1, COLUMNS)):
        cut = partial(shards.own_shard, axis_name="devices", axis=axis)
        np.testing.assert_array_equal(spread(mesh, cut, WHOLE, out=divided)(whole), whole)
    gather = partial(shards.all_shards, axis_name="devices")
    np.testing.assert_array_equal(spread(mesh, gather, ROWS, out=WHOLE)(whole), whole)


def test_the_mean_over_devices_is_that_of_their_trees(mesh: Mesh) -> None:
    tree = {"a": jnp.arange(8.0).reshape(4, 2), "b": jnp.arange(2.0)}
    average = spread(mesh, partial(shards.mean, axis_name="devices"), ROWS, out=WHOLE)
    found = average(tree)
    np.testing.assert_array_equal(found["a"], [[2, 3], [4, 5]])
    np.testing.assert_array_equal(found["b"], [0.5])


@pytest.mark.parametrize("dtype", [np.float32, np.uint8, np.uint16, np.int32, np.bool_])
def test_items_are_fetched_from_whichever_device_holds_them(mesh: Mesh, dtype: Any) -> None:
    rng = np.random.default_rng(3)
    stored = rng.integers(0, 250, (3, 4, 5)).astype(dtype)
    rows, columns = rng.integers(0, 3, 8), rng.integers(0, 4, 8)
    assert {tuple(columns[:4] // 2), tuple(columns[4:] // 2)} != {(0,) * 4, (1,) * 4}
    fetch = spread(mesh, partial(shards.take, axis_name="devices"), COLUMNS, WHOLE, WHOLE, out=ROWS)
    found = fetch(jnp.asarray(stored), jnp.asarray(rows), jnp.asarray(columns))
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, stored[rows, columns])
    alone = shards.take(jnp.asarray(stored), jnp.asarray(rows), jnp.asarray(columns), None)
    np.testing.assert_array_equal(alone, stored[rows, columns])


@pytest.mark.parametrize(
    ("method", "num_seeds"),
    [
        pytest.param("pqn", 1, marks=pytest.mark.long),
        ("r2d2", 1),
        pytest.param("r2d2", 2, marks=pytest.mark.long),
    ],
)
def test_two_devices_make_the_run_that_one_makes(
    world: EnvParams, method: Any, num_seeds: int
) -> None:
    """To the rounding of sums: the same tasks, actions, noise and drawn episodes."""
    config = config_for(method, num_seeds=num_seeds)
    found = []
    for chosen in (None, devices.choose(config, 2)):
        program = make_program(world, config, chosen)
        runner = loop.start_run(program)
        *_, (runner, last) = loop.run(runner, world, program)
        found.append((runner, last.metrics))
    (one, told_by_one), (two, told_by_two) = found
    assert len(jax.tree.leaves(two.learner.params)[0].sharding.device_set) == 2
    expected = {"seeds": num_seeds, "devices": 2 // num_seeds}
    sharding = jax.tree.leaves(two.learner.params)[0].sharding
    assert dict(sharding.mesh.shape) == expected
    assert told_by_one.keys() == told_by_two.keys()
    for name, value in told_by_one.items():
        assert np.isfinite(value).all(), name
        np.testing.assert_allclose(told_by_two[name], value, rtol=1e-3, atol=1e-4, err_msg=name)
    for ours, theirs in zip(
        jax.tree.leaves(one.learner.params), jax.tree.leaves(two.learner.params), strict=True
    ):
        np.testing.assert_allclose(theirs, ours, atol=1e-4)
    if method == "r2d2":
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(y, x, atol=1e-3),
            one.learner.memory,
            two.learner.memory,
        )


@pytest.mark.parametrize("method", ["pqn", "r2d2"])
def test_a_run_saved_on_two_devices_goes_on_and_is_evaluated_on_one(
    mesh: Mesh, world: EnvParams, method: Any, tmp_path: Path
) -> None:
    config = config_for(method)
    one, both = (make_program(world, config, chosen) for chosen in (None, mesh))
    runner = loop.start_run(both)
    with Checkpoints(tmp_path, Origin(config)) as checkpoints:
        checkpoints.save(1, runner)
        alone, _ = checkpoints.restore(loop.runner_shapes(one))
        again, _ = checkpoints.restore(loop.runner_shapes(both))
        params = checkpoints.restore_policy(params_shapes(config), averaged=config.averages_params)
    for found, where in ((alone, 1), (again, 2)):
        for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(runner), strict=True):
            if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
                np.testing.assert_array_equal(x, y)
        assert len(jax.tree.leaves(found.learner.params)[0].sharding.device_set) == where
    expected = policy_params(runner.learner, config)
    jax.tree.map(np.testing.assert_array_equal, params, expected)
    for leaf in jax.tree.leaves(params):
        assert leaf.sharding.device_set == {jax.devices()[0]}


def chosen_count(num_envs: int, batch_size: int, wanted: int | None = None) -> int:
    learner = LearnerConfig(batch_size=batch_size)
    config = TrainConfig(method="pqn", num_envs=num_envs, learner=learner)
    found = devices.choose(config, wanted)
    return 1 if found is None else found.size


def test_a_device_gets_at_least_eight_robots_of_a_minibatch() -> None:
    assert len(jax.devices()) == 2
    assert chosen_count(256, 16) == 2
    assert chosen_count(16, 8) == 1
    assert chosen_count(17, 17) == 1  # Two cannot share 17 robots evenly.
    assert chosen_count(256, 16, wanted=1) == 1
    assert chosen_count(16, 8, wanted=2) == 2


@pytest.mark.parametrize(
    ("num_seeds", "sizes", "division", "words"),
    [
        (1, (16, 16), (1, 2), ""),
        (2, (16, 16), (2, 1), " (2 seeds spread over 2, all robots of a seed on one)"),
        (6, (16, 16), (2, 1), " (6 seeds spread over 2, all robots of a seed on one)"),
        (3, (16, 16), (1, 2), " (all 3 seeds, robots of each over 2)"),
        (2, (3, 1), (2, 1), " (2 seeds spread over 2, all robots of a seed on one)"),
    ],
)
def test_seeds_are_spread_first_and_robots_second(
    num_seeds: int, sizes: tuple[int, int], division: tuple[int, int], words: str
) -> None:
    """A seed of its own is always worth a device, however few robots there are."""
    learner = LearnerConfig(batch_size=sizes[1])
    config = TrainConfig(method="pqn", num_envs=sizes[0], learner=learner, num_seeds=num_seeds)
    mesh = devices.choose(config)
    assert mesh is not None
    assert (mesh.shape["seeds"], mesh.shape["devices"]) == division
    assert devices.describe_division(mesh, num_seeds) == words


@pytest.mark.parametrize(
    ("wanted", "sizes", "message"),
    [
        (0, (16, 8), "--num-devices is 0, expected 1 to 2 of this machine"),
        (3, (16, 8), "--num-devices is 3, expected 1 to 2 of this machine"),
        (2, (15, 5), r"--num-devices is 2, expected a divisor of num_envs \(15\)"),
        (2, (30, 5), r"expected a divisor .* learner\.batch_size \(5\)"),
    ],
)
def test_devices_that_are_not_there_or_do_not_divide_are_refused(
    wanted: int, sizes: tuple[int, int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        chosen_count(*sizes, wanted=wanted)


def test_the_number_of_cores_is_left_as_the_user_has_set_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[Any] = []
    monkeypatch.setattr(jax.config, "update", lambda name, value: told.append((name, value)))
    monkeypatch.setattr(devices, "num_cores", lambda: 7)
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=3")
    devices.use_cores()
    monkeypatch.delenv("XLA_FLAGS")
    devices.use_cores()  # The tests themselves have set it to 2.
    assert told == []
