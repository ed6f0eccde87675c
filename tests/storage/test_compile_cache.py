"""Compiled programs on disk: where they are kept, when they are not, and what damage does."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from compiling import compiling_quickly
from numpy.typing import NDArray
from rooms import write_empty_room

from sqn_jax.cli import main
from sqn_jax.storage import compile_cache
from sqn_jax.storage.compile_cache import cached_programs, watched_compilation


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder the user has chosen, not made yet."""
    monkeypatch.setenv("SQN_JAX_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def cache_dir() -> str | None:
    """Where JAX keeps programs at present."""
    return jax.config.jax_compilation_cache_dir


def entries(folder: Path) -> list[Path]:
    return sorted(folder.glob("*-cache"))


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def refused(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that tells why there is no cache."""
    with cached_programs():
        assert cache_dir() is None
    stderr = capsys.readouterr().err
    assert stderr.startswith("compiled programs are not cached: ")
    assert stderr.count("\n") == 1
    return stderr


# Where.


@pytest.mark.parametrize(
    ("system", "variable", "where"),
    [
        ("linux", "{tmp}/caches", "caches"),
        ("darwin", "{tmp}/caches", "caches"),
        ("linux", "", "home/.cache"),
        ("linux", "not/absolute", "home/.cache"),
        ("darwin", "", "home/Library/Caches"),
    ],
)
def test_programs_are_kept_in_the_users_cache_folder_for_him_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, system: str, variable: str, where: str
) -> None:
    monkeypatch.delenv("SQN_JAX_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", variable.format(tmp=tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "platform", system)
    expected = tmp_path / where / "sqn_jax" / "compiled"
    mask = os.umask(0)
    try:
        with cached_programs():
            assert cache_dir() == str(expected)
    finally:
        os.umask(mask)
    assert mode_of(expected) == mode_of(expected.parent) == 0o700
    assert cache_dir() is None


@pytest.mark.parametrize("word", ["off", " OFF "])
def test_the_switch_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    monkeypatch.setenv("SQN_JAX_CACHE", word)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with cached_programs():
        assert cache_dir() is None
    assert list(tmp_path.iterdir()) == []


def test_a_cache_the_user_set_up_for_jax_is_left_alone(tmp_path: Path, folder: Path) -> None:
    own = str(tmp_path / "own")
    jax.config.update("jax_compilation_cache_dir", own)
    try:
        with cached_programs():
            assert cache_dir() == own
        assert cache_dir() == own
    finally:
        jax.config.update("jax_compilation_cache_dir", None)
    assert list(tmp_path.iterdir()) == []


def test_the_library_alone_keeps_nothing(tmp_path: Path) -> None:
    script = (
        "import jax, sqn_jax, sqn_jax.training.loop, sqn_jax.runs.train\n"
        "jax.jit(lambda x: x + 1)(1.0)\n"
        "assert jax.config.jax_compilation_cache_dir is None\n"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "HOME": str(tmp_path)}
    del environment["SQN_JAX_CACHE"]
    subprocess.run([sys.executable, "-c", script], env=environment, check=True, timeout=90)
    assert list(tmp_path.iterdir()) == []


# Refused folders.


@pytest.mark.parametrize("mode", [0o770, 0o702, 0o1777])
def test_a_folder_others_may_write_to_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], mode: int
) -> None:
    folder.mkdir()
    folder.chmod(mode)
    assert f"others may write to {folder}\n" in refused(capsys)
    assert list(folder.iterdir()) == []


def test_nor_may_others_be_able_to_put_another_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    (tmp_path / "link").symlink_to(shared, target_is_directory=True)
    monkeypatch.setenv("SQN_JAX_CACHE", str(tmp_path / "link" / "mine" / "kept"))
    shared.chmod(0o777)
    assert f"others may write to {shared}\n" in refused(capsys)
    shared.chmod(0o1777)  # As /tmp is.
    with cached_programs():
        assert cache_dir() == str(shared / "mine" / "kept")


def test_somebody_elses_folder_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    assert f"{folder} belongs to somebody else\n" in refused(capsys)


def test_a_folder_that_cannot_be_made_is_no_reason_to_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("SQN_JAX_CACHE", str(tmp_path / "file" / "kept"))
    assert str(tmp_path / "file") in refused(capsys)
    monkeypatch.setenv("SQN_JAX_CACHE", "~nobody_of_this_name/kept")
    assert "home" in refused(capsys)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder.mkdir(mode=0o500)
    assert os.strerror(errno.EACCES) in refused(capsys)


# Small programs: what is read, and what damage does.

Array = NDArray[np.float32]


def expected(shift: float) -> Array:
    return np.arange(8, dtype=np.float32) * 3 + shift


def run_program(shift: float) -> tuple[Array, bool]:
    """Compile x * 3 + shift anew, run it on 0 to 7; returns the result and whether it was read."""

    def scaled(x: jax.Array) -> jax.Array:
        return x * 3 + shift

    x = jax.device_put(np.arange(8, dtype=np.float32))
    with watched_compilation() as was_read:
        program = jax.jit(scaled, donate_argnums=0).lower(x).compile()
    result = np.asarray(program(x))
    assert x.is_deleted(), "the argument was to be donated"
    return result, was_read()


@pytest.fixture
def filled(folder: Path) -> Path:
    """The folder with two programs in it."""
    with cached_programs():
        for shift in (1.0, 2.0):
            result, was_read = run_program(shift)
            assert not was_read
            np.testing.assert_array_equal(result, expected(shift))
            # At once, since the run may be killed.
            assert all(
                entry.with_name(entry.name[:-6] + "-sha256").exists() for entry in entries(folder)
            )
    assert len(entries(folder)) >= 2
    return folder


def test_a_program_is_read_the_second_time(
    filled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in filled.iterdir()}
    with cached_programs():
        for shift in (1.0, 2.0):
            result, was_read = run_program(shift)
            assert was_read
            np.testing.assert_array_equal(result, expected(shift))
        assert not run_program(3.0)[1]
    assert not run_program(1.0)[1], "outside nothing is read"
    assert before.items() <= {path: path.read_bytes() for path in filled.iterdir()}.items()
    assert capsys.readouterr().err == ""


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda whole: b"",
    "cut short": lambda whole: whole[:-1],
    "one bit": lambda whole: whole[:100] + bytes([whole[100] ^ 1]) + whole[101:],
    "zeros": lambda whole: whole[:100] + bytes(len(whole) - 100),
}


@pytest.mark.parametrize("kind", [*DAMAGE, "another program"])
def test_a_damaged_program_is_compiled_again(
    filled: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    whole = {path: path.read_bytes() for path in entries(filled)}
    ours = list(whole)
    damaged = [DAMAGE.get(kind, bytes)(whole[path]) for path in ours]
    if kind == "another program":  # Which JAX would run without a word.
        ours = [path for path in whole if path.name.startswith("jit_scaled")]
        damaged = [whole[path] for path in reversed(ours)]
    for path, content in zip(ours, damaged, strict=True):
        path.write_bytes(content)
    with cached_programs():
        for shift in (1.0, 2.0):
            result, was_read = run_program(shift)
            assert not was_read
            np.testing.assert_array_equal(result, expected(shift))
    stderr = capsys.readouterr().err
    assert f"{filled}: {len(ours)} damaged" in stderr
    assert stderr.count("\n") == 1
    with cached_programs():
        assert run_program(1.0)[1]
    assert capsys.readouterr().err == ""


def test_an_entry_damaged_under_way_is_told_of_and_replaced(
    filled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with cached_programs():
        for path in entries(filled):
            path.write_bytes(path.read_bytes()[:50])
        for shift in (1.0, 2.0):
            np.testing.assert_array_equal(run_program(shift)[0], expected(shift))
    stderr = capsys.readouterr().err
    assert f"compiled programs in {filled}: reading jit_" in stderr
    assert stderr.count("\n") == 1
    with cached_programs():
        assert all(run_program(shift)[1] for shift in (1.0, 2.0))


def test_an_unfinished_entry_is_deleted_without_a_word(
    filled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in filled.glob("*-sha256"):
        path.unlink()
    with cached_programs():
        assert entries(filled) == []
    assert capsys.readouterr().err == ""


def test_a_full_disk_is_told_of_once_and_leaves_no_pieces(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with cached_programs():
        resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))
        try:
            for shift in (1.0, 2.0):
                np.testing.assert_array_equal(run_program(shift)[0], expected(shift))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    stderr = capsys.readouterr().err
    assert "writing jit_" in stderr
    assert os.strerror(errno.EFBIG) in stderr
    assert stderr.count("\n") == 1
    assert list(folder.iterdir()) == []


def test_a_folder_deleted_under_way_stops_nothing(
    filled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with cached_programs():
        assert run_program(1.0)[1]
        shutil.rmtree(filled)
        np.testing.assert_array_equal(run_program(3.0)[0], expected(3.0))
    stderr = capsys.readouterr().err
    assert os.strerror(errno.ENOENT) in stderr
    assert stderr.count("\n") == 1


def test_the_oldest_are_deleted_when_the_folder_is_full(
    filled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, new = (path for path in entries(filled) if path.name.startswith("jit_scaled"))
    for path in filled.iterdir():
        os.utime(path, (1e9, 1e9))
    os.utime(new, (2e9, 2e9))
    monkeypatch.setattr(compile_cache, "LARGEST_BYTES", new.stat().st_size)
    with cached_programs():
        assert entries(filled) == [new]


# The command line.


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_empty_room(tmp_path_factory.mktemp("map"))


def train_one_chunk(room: Path, run: Path, caches: Path) -> tuple[dict[str, Any], str, str]:
    """`sqn train`, stopped after a chunk; returns its numbers, stdout and stderr."""
    words = ["train", "--preset", "smoke", "--map", str(room), "--env.max-steps", "30"]
    words += ["--total-episodes", "320000", "--run-dir", str(run)]
    # Compiled in half the time, and as costly to compile beside the reading.
    environment = {
        **os.environ,
        "XDG_CACHE_HOME": str(caches),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    del environment["SQN_JAX_CACHE"]
    program, pipe = [sys.executable, "-m", "sqn_jax", *words], subprocess.PIPE
    with subprocess.Popen(program, env=environment, stdout=pipe, stderr=pipe, text=True) as process:
        metrics = run / "metrics.jsonl"
        while process.poll() is None and not (metrics.exists() and "\n" in metrics.read_text()):
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, err
    row = json.loads(metrics.read_text().splitlines()[0])
    del row["wall_seconds"], row["steps_per_second"]
    return row, out, err


def test_a_second_training_reads_what_the_first_compiled(room: Path, tmp_path: Path) -> None:
    kept = tmp_path / "caches" / "sqn_jax" / "compiled"
    first, out, err = train_one_chunk(room, tmp_path / "first", tmp_path / "caches")
    assert "\ncompiled in" in out
    assert "compiled programs" not in err
    assert mode_of(kept) == 0o700
    chunk = [path for path in entries(kept) if path.name.startswith("jit_train_chunk-")]
    assert len(chunk) == 1
    others = [path for path in entries(kept) if path not in chunk]
    for path in others:
        path.write_bytes(path.read_bytes()[:-1])
    second, out, err = train_one_chunk(room, tmp_path / "second", tmp_path / "caches")
    assert "\ncompiled earlier, read in" in out
    programs = [path for path in others if not path.name.startswith("arrays-")]
    assert f"compiled programs in {kept}: {len(programs)} damaged" in err
    assert err.count("compiled programs") == 1
    assert "Traceback" not in err
    assert "warning" not in err.lower()
    assert second == first


def test_an_evaluation_keeps_its_programs_too(
    folder: Path, room: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--maps", str(room), "--episodes", "1", "--eval-seeds", "1", "--max-steps", "2"]
    with compiling_quickly():
        assert main(["evaluate", *words]) == 0
    assert "compiled programs" not in capsys.readouterr().err
    assert any(path.name.startswith("jit__start_by_hand-") for path in entries(folder))


@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_the_help_names_the_switch(capsys: pytest.CaptureFixture[str], command: str) -> None:
    assert main([command, "--help"]) == 0
    assert "SQN_JAX_CACHE=off" in " ".join(capsys.readouterr().out.split())
