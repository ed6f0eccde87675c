"""Policies in two small files: what is read is what was written, and what is wrong is named."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from rooms import random_params, small_room

from sqn_jax.agent import make_network
from sqn_jax.config import NetworkConfig, TrainConfig
from sqn_jax.env import NUM_ACTIONS
from sqn_jax.policies import pretrained
from sqn_jax.policies.run_policies import Policy

CONFIG = TrainConfig(seed=4, num_seeds=2, network=NetworkConfig(hidden_size=8))


@pytest.fixture(scope="module")
def policy() -> Policy:
    network = make_network("sqn", CONFIG.network, NUM_ACTIONS)
    params = [random_params(network, small_room(9), seed) for seed in (0, 1)]
    config = dataclasses.replace(CONFIG, start_from="/somewhere/of/mine/first")
    return Policy("small", config, tuple(params))


@pytest.fixture
def folder(tmp_path: Path, policy: Policy) -> Path:
    pretrained.write_policy(tmp_path, policy, {"trained_on": "maze"}, index=1)
    return tmp_path


def exchange_arrays(folder: Path, arrays: dict[str, Any]) -> None:
    """Other arrays, with a checksum that fits."""
    np.savez(folder / "small.npz", **arrays)
    told = json.loads((folder / "small.json").read_text())
    told["sha256"] = hashlib.sha256((folder / "small.npz").read_bytes()).hexdigest()
    (folder / "small.json").write_text(json.dumps(told))


def test_a_policy_comes_back_bit_for_bit(folder: Path, policy: Policy) -> None:
    found = pretrained.read_policy(folder, "small")
    assert found.name == "small"
    assert found.training_seeds == (5,)
    assert found.config == dataclasses.replace(CONFIG, seed=5, num_seeds=1, start_from="first")
    jax.tree.map(np.testing.assert_array_equal, found.params[0], policy.params[1])
    assert json.loads((folder / "small.json").read_text())["card"] == {"trained_on": "maze"}


def test_it_is_found_by_the_name_of_its_file(folder: Path, policy: Policy) -> None:
    found = pretrained.find_policy(str(folder / "small.npz"))
    assert found.name == "small"
    jax.tree.map(np.testing.assert_array_equal, found.params[0], policy.params[1])
    with pytest.raises(ValueError, match=r"small\.npz: has no checkpoint best"):
        pretrained.find_policy(str(folder / "small.npz"), "best")
    with pytest.raises(ValueError, match="policy other: cannot be read"):
        pretrained.find_policy(str(folder / "other.npz"))


def test_every_damaged_or_missing_part_is_named_in_one_line(folder: Path) -> None:
    for name in ("small.npz", "small.json"):
        whole = (folder / name).read_bytes()
        for damaged in (b"", whole[: len(whole) // 2], b"\x93NUMPY", b"[1, 2]"):
            (folder / name).write_bytes(damaged)
            with pytest.raises(ValueError, match=r"^policy small: ") as told:
                pretrained.read_policy(folder, "small")
            assert "\n" not in str(told.value)
        (folder / name).unlink()
        with pytest.raises(ValueError, match="policy small: cannot be read"):
            pretrained.read_policy(folder, "small")
        (folder / name).write_bytes(whole)


def test_a_flipped_bit_in_the_arrays_is_found(folder: Path) -> None:
    """At places all over the file."""
    path = folder / "small.npz"
    whole = path.read_bytes()
    for place in range(0, len(whole), 97):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        with pytest.raises(ValueError, match=r"not the file that small\.json belongs to"):
            pretrained.read_policy(folder, "small")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arrays: arrays.pop("params/decision/output/bias"), r"output/bias is None"),
        (lambda arrays: arrays.update(extra=np.zeros(3)), r"array extra is \(3,\), expected None"),
        (lambda arrays: arrays.update({"params/decision/output/bias": np.zeros(3)}), r"is \(3,\)"),
    ],
)
def test_arrays_of_another_network_are_refused(folder: Path, change: Any, message: str) -> None:
    with np.load(folder / "small.npz") as file:
        arrays = dict(file)
    change(arrays)
    exchange_arrays(folder, arrays)
    with pytest.raises(ValueError, match=message):
        pretrained.read_policy(folder, "small")


def test_pickled_arrays_are_not_opened(folder: Path) -> None:
    exchange_arrays(folder, {"params": np.array([{"a": 1}], dtype=object)})
    with pytest.raises(ValueError, match="policy small: cannot be read"):
        pretrained.read_policy(folder, "small")


def test_an_unknown_name_is_refused_with_those_there_are() -> None:
    for name in ("none-such", "../config", ""):
        with pytest.raises(ValueError, match="no such policy, expected one of"):
            pretrained.find_policy(f"pretrained:{name}")


def test_what_comes_with_the_package_can_be_read() -> None:
    for name in pretrained.pretrained_names():
        found = pretrained.find_policy(f"pretrained:{name}")
        leaves = jax.tree.leaves(found.params)
        assert leaves
        assert all(np.isfinite(leaf).all() for leaf in leaves)


def test_nothing_that_only_run_folders_need_is_imported() -> None:
    """Orbax takes a fifth of a second, which every evaluation of a pretrained policy would wait."""
    code = (
        "import sys, sqn_jax.cli.evaluate, sqn_jax.evaluation.compare, sqn_jax.policies.pretrained;"
        "sys.exit(any(name.split('.')[0] == 'orbax' for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
