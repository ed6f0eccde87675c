"""Checkpoints: what comes back, which stay, and those of other runs."""

from __future__ import annotations

import dataclasses
import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from saved_runs import assert_same, config_for, opened, without_replay

from sqn_jax.config import NetworkConfig
from sqn_jax.env import EnvParams
from sqn_jax.maps import load_map
from sqn_jax.storage import manifest
from sqn_jax.storage.checkpoint import NotSaved
from sqn_jax.storage.manifest import Mismatch
from sqn_jax.training import loop
from sqn_jax.training.state import RunnerState, params_shapes


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
