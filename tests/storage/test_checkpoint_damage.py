"""Damaged checkpoints: every fault is named, and the older one taken."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from saved_runs import assert_same, config_for, opened

from sqn_jax.storage import manifest
from sqn_jax.training.state import RunnerState, params_shapes


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
