"""What a command leaves for the next: the same tables, and few programs."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from unittest import mock

import jax
import numpy as np
import pytest

import sqn_jax
from sqn_jax.env import free_space, make_env, prepare
from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.evaluation.cached_work import cached_work
from sqn_jax.evaluation.settings import Settings
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.training import exported

ROOT = Path(__file__).parents[2]

MOST_PROGRAMS = 7
"""Of an evaluation: keys, tasks, episodes, metrics. A dozen tiny ones would take a second more."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SQN_JAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def table_of(name: str) -> np.ndarray:
    prepare._table.cache_clear()  # Another process.
    return np.asarray(make_env(name).sight.far_sides)


def test_tables_of_an_earlier_command_are_read_and_the_same(folder: Path) -> None:
    expected = {name: table_of(name) for name in ("maze", "column")}
    with cached_work():
        table_of("maze")
    with (
        cached_work(),
        mock.patch.object(free_space, "free_rectangles", wraps=free_space.free_rectangles) as made,
    ):
        np.testing.assert_array_equal(table_of("maze"), expected["maze"])
        assert made.call_count == 0
        np.testing.assert_array_equal(table_of("column"), expected["column"])
        assert made.call_count == 2, "a table for rays, one for the body"
    prepare._table.cache_clear()


def test_an_evaluation_compiles_few_programs() -> None:
    jax.clear_caches()
    compiled: list[str] = []

    def note(event: str, _: float, **about: str | int) -> None:
        if event.endswith("backend_compile_duration"):
            compiled.append(str(about.get("fun_name")))

    policy = find_policy("pretrained:sqn")
    settings = Settings(maps=("maze",), tasks=("random pairs",), episodes=3, eval_seeds=1)
    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        evaluate_session([TrainedAgent("sqn", (policy,))], settings)
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    assert 4 <= len(compiled) <= MOST_PROGRAMS, compiled


@pytest.mark.parametrize("case", ["fresh", "edited", "off"])
def test_programs_are_stored_only_where_the_source_is_what_runs(
    case: str, folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    root = tmp_path / "package"
    root.mkdir()
    source = root / "__init__.py"
    source.write_text("")
    monkeypatch.setattr(sqn_jax, "__file__", str(source))
    monkeypatch.setattr(sqn_jax, "_IMPORTED", source.stat().st_mtime + 1)
    if case == "edited":
        os.utime(source, (source.stat().st_mtime + 2,) * 2)
    elif case == "off":
        monkeypatch.setenv("SQN_JAX_CACHE", "off")
    with cached_work():
        assert bool(exported._caches) == (case == "fresh")
    assert not exported._caches


def test_every_library_that_a_command_imports_is_declared() -> None:
    """`jax.export` imports flatbuffers, which JAX does not require."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert any(text.startswith("flatbuffers") for text in declared)
    assert "flatbuffers" in (ROOT / "constraints.txt").read_text()
