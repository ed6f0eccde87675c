"""Checkpoints: what comes back, what is kept, and what damage to any of their files does."""

from __future__ import annotations

import dataclasses
import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from rooms import small_room

from sqn_jax.config import NetworkConfig, ReplayConfig, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import EnvParams
from sqn_jax.maps import load_map
from sqn_jax.storage import manifest
from sqn_jax.storage.checkpoint import Checkpoints, NotSaved
from sqn_jax.storage.manifest import Mismatch, Origin
from sqn_jax.training import loop
from sqn_jax.training.state import RunnerState, params_shapes

LENGTH = 6


def config_for(method: Any = "r2d2", **changes: Any) -> TrainConfig:
    return dataclasses.replace(
        PRESETS["smoke"],
        method=method,
        task_sampling="learnability",
        num_envs=4,
        total_episodes=16,
        network=NetworkConfig(hidden_size=8, layer_norm=True),
        replay=ReplayConfig(capacity=8, min_episodes=8),
        learner=dataclasses.replace(PRESETS["smoke"].learner, batch_size=4, window_length=LENGTH),
        **changes,
    )


@pytest.fixture(scope="module")
def world() -> EnvParams:
    return small_room(LENGTH)


@pytest.fixture(scope="module")
def states(world: EnvParams) -> list[RunnerState]:
    """Three states of one run in which every number differs from one to the next."""
    with compiling_quickly():
        start = loop.start_run(loop.make_program(world, config_for()))

    def moved(by: int) -> RunnerState:
        def shift(x: Any) -> Any:
            if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
                return jax.random.key(by)
            return ~x if x.dtype == bool and by % 2 else x + jnp.asarray(by, x.dtype)

        return jax.tree.map(shift, start)

    return [moved(by) for by in range(3)]


@pytest.fixture(scope="module")
def shapes(world: EnvParams) -> RunnerState:
    return loop.runner_shapes(loop.make_program(world, config_for()))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory, states: list[RunnerState]) -> Path:
    """A run folder with checkpoints after chunks 1 and 2; to be copied, not changed."""
    path = tmp_path_factory.mktemp("saved")
    with opened(path) as checkpoints:
        for chunk in (1, 2):
            checkpoints.save(chunk, states[chunk], score=0.5)
    return path


def opened(path: Path, config: TrainConfig | None = None, **known: Any) -> Checkpoints:
    return Checkpoints(path, Origin(config or config_for(), **known))


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    """A copy to do damage to."""
    shutil.copytree(saved, tmp_path / "run")
    return tmp_path / "run"


def without_replay(runner: RunnerState) -> RunnerState:
    return dataclasses.replace(runner, learner=dataclasses.replace(runner.learner, memory=None))


def assert_same(one: Any, other: Any) -> None:
    for ours, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jax.dtypes.issubdtype(ours.dtype, jax.dtypes.prng_key):
            ours, theirs = jax.random.key_data(ours), jax.random.key_data(theirs)
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


def test_what_was_saved_comes_back_bit_for_bit(
    saved: Path, states: list[RunnerState], shapes: RunnerState
) -> None:
    with opened(saved) as checkpoints:
        found, description = checkpoints.restore(shapes)
    assert_same(found, states[2])
    assert description.is_exact
    assert description.score == 0.5
    for averaged, expected in (
        (True, states[2].learner.target_params),
        (False, states[2].learner.params),
    ):
        with opened(saved) as checkpoints:
            params = checkpoints.restore_policy(params_shapes(config_for()), averaged=averaged)
        assert_same(params, expected)


# Damage.


def flip(file: Path, rng: np.random.Generator) -> None:
    data = bytearray(file.read_bytes())
    at = rng.integers(8 * len(data))
    data[at // 8] ^= 1 << at % 8
    file.write_bytes(bytes(data))


def cut(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: rng.integers(len(data))])


def delete(file: Path, _: np.random.Generator) -> None:
    file.unlink()


def grow(file: Path, _: np.random.Generator) -> None:
    file.write_bytes(file.read_bytes() + b"\0")


def files_of(step: Path) -> list[Path]:
    return sorted(path.relative_to(step) for path in step.rglob("*") if path.is_file())


DAMAGE = [flip, *(pytest.param(damage, marks=pytest.mark.long) for damage in (cut, delete, grow))]


@pytest.mark.parametrize("damage", DAMAGE)
def test_any_damaged_file_is_named_and_the_older_checkpoint_taken(
    damage: Callable[[Path, np.random.Generator], None],
    folder: Path,
    states: list[RunnerState],
    shapes: RunnerState,
) -> None:
    """Every file of the newest checkpoint, one at a time."""
    step, aside = folder / "checkpoints" / "2", folder / "checkpoints" / "2.damaged"
    rng = np.random.default_rng(7)
    names = files_of(step)
    assert len(names) > 30
    for name in names:
        whole = (step / name).read_bytes()
        damage(step / name, rng)
        with (
            opened(folder) as checkpoints,
            pytest.warns(UserWarning, match="going on from chunk 1") as warned,
        ):
            found, _ = checkpoints.restore(shapes)
        assert len(warned) == 1
        assert name.as_posix() in str(warned[0].message)
        assert str(step) in str(warned[0].message)
        assert_same(found, states[1])
        assert not step.exists()
        aside.rename(step)
        (step / name).write_bytes(whole)
    with opened(folder) as checkpoints:  # All is whole again.
        assert_same(checkpoints.restore(shapes)[0], states[2])


@pytest.mark.parametrize("damage", [pytest.param(flip, marks=pytest.mark.long), delete])
def test_a_policy_is_read_from_sound_files_or_not_at_all(
    damage: Callable[[Path, np.random.Generator], None], folder: Path, states: list[RunnerState]
) -> None:
    step = folder / "checkpoints" / "2"
    rng, refused = np.random.default_rng(8), 0
    for name in files_of(step):
        whole = (step / name).read_bytes()
        damage(step / name, rng)
        params, fault = None, ""
        try:
            with opened(folder) as checkpoints:
                params = checkpoints.restore_policy(params_shapes(config_for()), averaged=False)
        except ValueError as error:
            fault = str(error)
        if params is None:
            assert f"{name.as_posix()} is" in fault
            assert "\n" not in fault
            assert "that of chunk 1 is sound" in fault
            refused += 1
        else:  # A file of the replay, say.
            assert name.parts[0] in ("target_params", "memory", "rest")
            assert_same(params, states[2].learner.params)
        (step / name).write_bytes(whole)
    assert refused > 10
    assert step.is_dir()  # Who only reads moves nothing.


def test_every_bit_of_a_manifest_counts(folder: Path) -> None:
    """500 flips at random: none goes unnoticed."""
    step = folder / "checkpoints" / "2"
    whole, rng = (step / "manifest.json").read_bytes(), np.random.default_rng(9)
    manifest.read(step, 2)
    for _ in range(500):
        flip(step / "manifest.json", rng)
        with pytest.raises(manifest.Damaged, match=r"^manifest\.json is not what was written"):
            manifest.read(step, 2)
        (step / "manifest.json").write_bytes(whole)


def test_files_that_do_not_belong_to_a_checkpoint_are_named(
    folder: Path, shapes: RunnerState
) -> None:
    (folder / "checkpoints" / "2" / "rest" / "more").write_text("x")
    with opened(folder) as checkpoints, pytest.warns(UserWarning, match="rest/more does not bel"):
        checkpoints.restore(shapes)


def test_checkpoints_that_have_changed_places_are_noticed(
    folder: Path, shapes: RunnerState
) -> None:
    shutil.rmtree(folder / "checkpoints" / "2")
    (folder / "checkpoints" / "1").rename(folder / "checkpoints" / "2")
    with opened(folder) as checkpoints, pytest.raises(ValueError, match=r"that of chunk 1$"):
        checkpoints.restore(shapes)


def test_where_none_is_sound_each_is_named_and_stays(folder: Path, shapes: RunnerState) -> None:
    for chunk in ("1", "2"):
        (folder / "checkpoints" / chunk / "rest" / "_METADATA").unlink()
    with opened(folder) as checkpoints, pytest.raises(ValueError, match="damaged") as error:
        checkpoints.restore(shapes)
    assert str(error.value).count("rest/_METADATA is missing") == 2
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == ["1", "2"]


@pytest.mark.parametrize(
    "content",
    [
        {"contents": {"schema": 1}},
        {"contents": {"schema": 2}},
        {"contents": []},
        {"contents": None},
        [],
        {"contents": {"schema": 1, "chunk": 2, "files": {"../../x": ""}, "leaves": {"a": 1}}},
    ],
)
def test_a_manifest_from_elsewhere_ends_in_one_line(
    content: Any, folder: Path, shapes: RunnerState
) -> None:
    """Sealed as it should be, with other contents."""
    if isinstance(content, dict) and isinstance(content["contents"], dict):
        content["sha256"] = manifest._contents_digest(content["contents"])
    (folder / "checkpoints" / "2" / "manifest.json").write_text(json.dumps(content))
    with opened(folder) as checkpoints, pytest.raises(ValueError, match=r"manifest\.json"):
        checkpoints.restore_policy(params_shapes(config_for()), averaged=False)


def test_numbers_that_change_on_the_way_back_are_noticed(
    saved: Path, shapes: RunnerState, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By whatever fault of a library: sound files are no proof of sound numbers."""
    with opened(saved) as checkpoints:
        restore = checkpoints._orbax.restore

        def altered(*args: Any, **kwargs: Any) -> Any:
            found = restore(*args, **kwargs)
            found["rest"]["round"] += 1
            return found

        monkeypatch.setattr(checkpoints._orbax, "restore", altered)
        with pytest.raises(ValueError, match="rest/round was restored with other numbers"):
            checkpoints.restore(shapes)


# Other runs.


def test_another_network_is_told_in_a_table_and_nothing_is_moved(
    folder: Path, world: EnvParams
) -> None:
    wide = dataclasses.replace(config_for(), network=NetworkConfig(hidden_size=16), seed=3)
    with opened(folder, wide) as checkpoints, pytest.raises(Mismatch) as error:
        checkpoints.restore(loop.runner_shapes(loop.make_program(world, wide)))
    lines = [line.split() for line in error.value.table.splitlines()]
    assert ["network.hidden_size", "8", "16"] in lines
    assert ["network.layer_norm", "True", "False"] in lines
    assert ["seed", "0", "3"] in lines
    assert len(lines) == 4
    with opened(folder, wide) as checkpoints, pytest.raises(Mismatch):
        checkpoints.restore_policy(params_shapes(wide), averaged=False)
    assert (folder / "checkpoints" / "2").is_dir()


def test_another_form_of_the_state_is_told_array_by_array(folder: Path, world: EnvParams) -> None:
    """As when another version of the program wrote it."""
    two_seeds = dataclasses.replace(config_for(), num_seeds=2)
    shapes = loop.runner_shapes(loop.make_program(world, two_seeds))
    with opened(folder) as checkpoints, pytest.raises(Mismatch) as error:
        checkpoints.restore(shapes)
    assert "rest/round" in error.value.table
    assert "int32 ()" in error.value.table
    assert "int32 (2,)" in error.value.table


def test_settings_that_may_change_do_not_matter(folder: Path, shapes: RunnerState) -> None:
    longer = dataclasses.replace(
        config_for(), total_episodes=64, checkpoint_minutes=1.0, max_skipped_updates=3
    )
    with opened(folder, longer) as checkpoints:
        checkpoints.restore(shapes)


def written_before_randomization(folder: Path, **others: Any) -> None:
    """Turn the newest manifest into one of a version that did not know these settings."""
    path = folder / "checkpoints" / "2" / "manifest.json"
    contents = json.loads(path.read_text())["contents"]
    del contents["config"]["randomization"]
    contents["config"] |= others
    sealed = {"contents": contents, "sha256": manifest._contents_digest(contents)}
    path.write_text(json.dumps(sealed))


def test_a_setting_that_came_later_had_its_default_before(
    folder: Path, states: list[RunnerState], shapes: RunnerState
) -> None:
    written_before_randomization(folder)
    with opened(folder) as checkpoints:
        assert_same(checkpoints.restore(shapes)[0], states[2])


def test_settings_that_are_no_more_are_told(folder: Path, shapes: RunnerState) -> None:
    written_before_randomization(folder, old_setting=7)
    with opened(folder) as checkpoints, pytest.raises(Mismatch) as error:
        checkpoints.restore(shapes)
    lines = [line.split() for line in error.value.table.splitlines()]
    assert ["old_setting", "7", "-"] in lines
    assert ["randomization.speed", "-", "0.0"] in lines


def test_another_map_is_noticed_but_not_where_it_lies(
    tmp_path: Path, states: list[RunnerState], shapes: RunnerState
) -> None:
    maze, column = load_map("maze"), load_map("column")
    cell = maze.occupied.copy()
    cell[5, 5] = ~cell[5, 5]
    with opened(tmp_path, world=maze.identity()) as checkpoints:
        checkpoints.save(1, states[1])
    elsewhere = dataclasses.replace(config_for(), map="/elsewhere/maze.yaml")
    with opened(tmp_path, elsewhere, world=maze.identity()) as checkpoints:
        checkpoints.restore(shapes)
    for other in (
        dataclasses.replace(maze, occupied=cell),
        dataclasses.replace(maze, resolution=0.1),
        dataclasses.replace(maze, spawn_points=maze.spawn_points[::-1]),
        dataclasses.replace(maze, max_steps=401),
        column,
    ):
        with (
            opened(tmp_path, world=other.identity()) as checkpoints,
            pytest.raises(Mismatch) as error,
        ):
            checkpoints.restore(shapes)
        assert "map." in error.value.table


# What is kept.


def test_the_newest_two_and_the_best_are_kept(
    tmp_path: Path, states: list[RunnerState], shapes: RunnerState
) -> None:
    with opened(tmp_path) as checkpoints:
        for chunk, score in enumerate((0.2, 0.9, 0.3, 0.4, 0.5), start=1):
            checkpoints.save(chunk, states[chunk % 3], score=score)
        assert checkpoints.chunks() == [2, 4, 5]

        def params_of(which: int | str) -> Any:
            return checkpoints.restore_policy(
                params_shapes(config_for()), averaged=False, which=which
            )

        assert_same(params_of("best"), states[2].learner.params)
        assert_same(params_of("newest"), states[2].learner.params)
        assert_same(params_of(4), states[1].learner.params)
        with pytest.raises(ValueError, match="no checkpoint 3, expected newest, best or 2, 4, 5"):
            params_of(3)
        checkpoints.save(6, states[0], score=0.95)
        assert checkpoints.chunks() == [5, 6]
        assert_same(params_of("best"), states[0].learner.params)
    assert not list((tmp_path / "checkpoints").glob(".*"))


def test_a_light_checkpoint_leaves_out_the_replay_and_says_so(
    tmp_path: Path, states: list[RunnerState], shapes: RunnerState
) -> None:
    with opened(tmp_path) as checkpoints:
        checkpoints.save(1, states[1], light=True)
        found, description = checkpoints.restore(shapes)
    assert not description.is_exact
    assert found.learner.memory is None
    assert_same(found, without_replay(states[1]))
    assert not (tmp_path / "checkpoints" / "1" / "memory").exists()
    pqn = without_replay(states[2])
    with opened(tmp_path) as checkpoints:  # Without a replay there is nothing to leave out.
        checkpoints.save(2, pqn, light=True)
        found, description = checkpoints.restore(without_replay(shapes))
    assert description.is_exact
    assert_same(found, pqn)


def test_a_save_that_was_broken_off_leaves_no_trace(
    folder: Path, states: list[RunnerState], shapes: RunnerState
) -> None:
    """The state in which a killed process leaves the folder, in two stages."""
    checkpoints_dir = folder / "checkpoints"
    shutil.copytree(checkpoints_dir / "2", checkpoints_dir / ".3.partial")
    (checkpoints_dir / ".3.partial" / "manifest.json").unlink()
    shutil.copytree(
        checkpoints_dir / "2", checkpoints_dir / ".3.partial.orbax-checkpoint-tmp-0" / "3"
    )
    with opened(folder) as checkpoints:
        assert checkpoints.chunks() == [1, 2]
        assert_same(checkpoints.restore(shapes)[0], states[2])
        checkpoints.save(3, states[0])
        assert_same(checkpoints.restore(shapes)[0], states[0])
    assert not list(checkpoints_dir.glob(".*"))


def test_what_stands_in_the_way_is_set_aside(
    folder: Path, states: list[RunnerState], shapes: RunnerState
) -> None:
    """A run that fell back comes to the same chunk again."""
    (folder / "checkpoints" / "2" / "manifest.json").write_text("{}")
    with warnings.catch_warnings(), opened(folder) as checkpoints:
        warnings.simplefilter("ignore")
        checkpoints.restore(shapes)
        checkpoints.save(2, states[0])
        assert_same(checkpoints.restore(shapes)[0], states[0])
        assert checkpoints.chunks() == [1, 2]


def test_a_disk_without_room_is_not_written_to(
    folder: Path, states: list[RunnerState], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Orbax's threads would each print a traceback."""

    def written(*_: Any, **__: Any) -> None:
        raise AssertionError("written to")

    num_bytes = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(states[0].learner))
    with opened(folder) as checkpoints:
        monkeypatch.setattr(checkpoints._orbax, "save", written)
        usage = shutil.disk_usage(folder)._replace(free=num_bytes)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
        fault = r"\(No space left on device: 0\.\d MB free, 2\.\d needed\); that of chunk 2 is"
        with pytest.raises(NotSaved, match=fault):
            checkpoints.save(3, states[0])
        assert checkpoints.chunks() == [1, 2]


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every write of a manifest fails as on a full disk."""

    def fail(*_: Any, **__: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sqn_jax.storage.manifest.json.dump", fail)


@pytest.mark.usefixtures("full_disk")
def test_what_cannot_be_written_leaves_the_older_ones_as_they_were(
    folder: Path, states: list[RunnerState], shapes: RunnerState
) -> None:
    with opened(folder) as checkpoints:
        with pytest.raises(NotSaved, match=r"No space left on device\); that of chunk 2 is"):
            checkpoints.save(3, states[0])
        assert checkpoints.chunks() == [1, 2]
        assert_same(checkpoints.restore(shapes)[0], states[2])
    assert not list((folder / "checkpoints").glob(".*"))
