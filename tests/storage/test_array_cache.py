"""Arrays kept beside compiled programs: computed once, and never read where they may be others."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sqn_jax.storage import array_cache, compile_cache
from sqn_jax.storage.array_cache import cached_arrays, code_of, code_of_package
from sqn_jax.storage.compile_cache import cached_programs


class Maker:
    """Counts how often it computes."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return {"a": np.arange(6, dtype=np.int8).reshape(2, 3), "b": np.float32([np.nan, 2.5])}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SQN_JAX_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def test_what_is_kept_comes_back_with_its_types(folder: Path) -> None:
    make = Maker()
    found = []
    for _ in range(2):  # Two commands.
        with cached_programs():
            found.append(cached_arrays("plans", [b"map", b"robot"], make))
    assert make.calls == 1
    for name, array in make().items():
        for each in found:
            assert each[name].dtype == array.dtype
            np.testing.assert_array_equal(each[name], array)
    (entry,) = folder.glob("*-cache")
    assert entry.name.startswith("arrays-plans-")


def test_what_depends_on_something_else_is_computed_anew(folder: Path) -> None:
    make = Maker()
    with cached_programs():
        # The same bytes, divided otherwise, are something else, too.
        for parts in ([b"ab", b"c"], [b"a", b"bc"], [b"abc"], [b"ab", b"c"]):
            cached_arrays("plans", parts, make)
        cached_arrays("paths", [b"abc"], make)
    assert make.calls == 4


def test_nothing_is_kept_where_no_programs_are(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = Maker()
    cached_arrays("plans", [b"x"], make)
    monkeypatch.setenv("SQN_JAX_CACHE", "off")
    with cached_programs():
        cached_arrays("plans", [b"x"], make)
    assert make.calls == 2
    assert not folder.exists()


@pytest.mark.parametrize("damage", ["flipped", "unsealed", "link"])
def test_what_was_changed_is_not_read(folder: Path, damage: str, tmp_path: Path) -> None:
    make = Maker()
    with cached_programs():
        cached_arrays("plans", [b"x"], make)
        (entry,) = folder.glob("*-cache")
        data = bytearray(entry.read_bytes())
        if damage == "flipped":
            data[len(data) // 2] ^= 1
            entry.write_bytes(data)
        elif damage == "link":
            (tmp_path / "elsewhere").write_bytes(data)
            entry.unlink()
            entry.symlink_to(tmp_path / "elsewhere")
        else:  # A process was killed before it was sealed.
            next(folder.glob("*-sha256")).unlink()
        np.testing.assert_array_equal(cached_arrays("plans", [b"x"], make)["a"], make()["a"])
        assert make.calls == 3
        cached_arrays("plans", [b"x"], make)
        assert make.calls == 3, "it was not kept again"


def test_another_command_that_tidies_meanwhile_is_no_error(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before and after each of the two files, and all of the folder gone."""
    write_whole = array_cache.write_whole

    def tidied(path: Path, data: bytes) -> None:
        compile_cache._tidy(folder)
        write_whole(path, data)
        compile_cache._tidy(folder)

    def gone(path: Path, data: bytes) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        write_whole(path, data)

    make = Maker()
    with cached_programs():
        monkeypatch.setattr(array_cache, "write_whole", tidied)
        cached_arrays("plans", [b"x"], make)
        cached_arrays("plans", [b"x"], make)
        assert make.calls == 1
        monkeypatch.setattr(array_cache, "write_whole", gone)
        np.testing.assert_array_equal(cached_arrays("plans", [b"y"], make)["a"], make()["a"])


def test_what_is_too_large_is_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = Maker()
    monkeypatch.setattr(array_cache, "LARGEST_FILE", 100)
    with cached_programs():
        for _ in range(2):
            cached_arrays("plans", [b"x"], make)
        assert make.calls == 2
        assert not list(folder.glob("*-cache"))


def test_arrays_have_a_limit_of_their_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest go; a program of another start stays."""
    with cached_programs():
        for part in (b"x", b"y"):
            cached_arrays("plans", [part], Maker())
        program = folder / "jit_f-1-cache"
        program.write_bytes(b"program" * 1_000)
        compile_cache.seal_of(program).write_bytes(compile_cache._digest(program))
    arrays = sorted(folder.glob("arrays-*-cache"), key=lambda path: path.stat().st_mtime_ns)
    os.utime(arrays[0], (1, 1))
    monkeypatch.setattr(compile_cache, "LARGEST_ARRAYS", arrays[1].stat().st_size)
    with cached_programs():
        assert sorted(folder.glob("*-cache")) == sorted([arrays[1], program])


def test_a_full_disk_is_no_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sqn_jax.storage.array_cache.write_whole", full)
    with cached_programs():
        assert cached_arrays("plans", [b"x"], Maker()).keys() == {"a", "b"}


def test_other_code_is_something_else(tmp_path: Path) -> None:
    modules: list[ModuleType] = []
    for name, text in (("one", "x = 1\n"), ("two", "x = 2\n")):
        module = ModuleType(name)
        module.__file__ = str(tmp_path / f"{name}.py")
        Path(module.__file__).write_text(text)
        modules.append(module)
    assert code_of(modules[0]) != code_of(modules[1])
    assert code_of(modules[0]) == code_of(modules[0])


def test_a_package_is_another_with_any_file_name_or_library(tmp_path: Path) -> None:
    package, library = ModuleType("package"), ModuleType("library")
    package.__file__ = str(tmp_path / "__init__.py")
    package.__version__ = library.__version__ = "1.0"  # type: ignore[attr-defined]
    (tmp_path / "inner").mkdir()
    digests = []

    def note() -> None:
        digests.append(code_of_package(package, library))

    for name, text in (
        *(("__init__.py", ""), ("inner/a.py", "x = 1\n"), ("inner/a.py", "x = 2\n")),
        *(("inner/b.py", ""), ("c.py", "")),
    ):
        (tmp_path / name).write_text(text)
        note()
    (tmp_path / "inner" / "b.py").rename(tmp_path / "b.py")
    note()
    library.__version__ = "1.1"  # type: ignore[attr-defined]
    note()
    package.__version__ = "1.1"  # type: ignore[attr-defined]
    note()
    assert len(set(digests)) == len(digests)
    (tmp_path / "inner" / "notes.txt").write_text("no code")
    assert code_of_package(package, library) == digests[-1]


def test_what_killed_commands_left_is_deleted_after_an_hour(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left: list[Path] = []

    def killed(partial: Path, target: Path) -> None:
        left.append(partial.rename(partial.with_name(f"{partial.name}.left")))
        raise KeyboardInterrupt

    with cached_programs():
        cached_arrays("plans", [b"x"], Maker())
    (whole,) = folder.glob("*-cache")
    others = [folder / name for name in (".film.partial.mp4", "notes-sha256")]
    for path in others:
        path.write_text("somebody's own")
    with monkeypatch.context() as patched, cached_programs():
        # Killed while the second of its two files is written.
        replace = Path.replace
        patched.setattr(
            Path,
            "replace",
            lambda self, target: (killed if str(target).endswith("-cache") else replace)(
                self, target
            ),
        )
        with pytest.raises(KeyboardInterrupt):
            cached_arrays("plans", [b"y"], Maker())
    seals = set(folder.glob("*-sha256")) - {compile_cache.seal_of(whole), *others}
    left += seals
    assert len(left) == 2
    with cached_programs():
        assert all(path.exists() for path in left)
    for path in (*folder.iterdir(),):
        os.utime(path, (1e9, 1e9))
    with cached_programs():
        assert sorted(folder.iterdir()) == sorted([whole, compile_cache.seal_of(whole), *others])
