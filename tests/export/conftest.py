"""A folder that was exported."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from compiling import compiling_quickly
from rooms import write_empty_room
from tiny_policies import random_policy, tiny

from sqn_jax.cli import main
from sqn_jax.policies.pretrained import write_policy


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all tests, which leave it as it is."""
    place = tmp_path_factory.mktemp("export")
    policy = random_policy(tiny(num_skills=3, layer_norm=True))
    room = str(write_empty_room(place))
    write_policy(place, policy, {"evaluation": []})
    with compiling_quickly():
        arguments = ["export", str(place / "tiny.npz"), "--out", str(place / "robot")]
        assert main([*arguments, "--map", room]) == 0
    return place / "robot"


@pytest.fixture
def changed(exported: Path, tmp_path: Path) -> Path:
    """A copy to change."""
    return Path(shutil.copytree(exported, tmp_path / "robot"))
