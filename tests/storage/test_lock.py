"""One writer a run folder."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sqn_jax.storage.lock import NAME, locked, owner

HOLD = """
import sys, time
from pathlib import Path
from sqn_jax.storage.lock import locked
with locked(Path(sys.argv[1])):
    print("mine", flush=True)
    time.sleep(100)
"""


def holder(folder: Path) -> subprocess.Popen[str]:
    child = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "mine\n"
    return child


def test_a_second_writer_is_refused_and_told_of_the_first(tmp_path: Path) -> None:
    with holder(tmp_path) as child:
        for _ in range(2):  # Being refused takes nothing away from the first.
            refused = pytest.raises(ValueError, match=f"in use by process {child.pid} on")
            with refused, locked(tmp_path):
                pass
        child.kill()


def test_the_lock_of_a_killed_process_keeps_nobody_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with holder(tmp_path) as child:
        child.kill()
    with locked(tmp_path):
        stderr = capsys.readouterr().err
        assert stderr.startswith(f"process {child.pid} on ")
        assert "did not end in order" in stderr
        assert f"process {os.getpid()} " in (tmp_path / NAME).read_text()
    with locked(tmp_path):
        assert capsys.readouterr().err == ""


def test_others_that_share_the_folder_see_who_has_it(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    assert owner(run_dir) == ""
    with locked(run_dir):
        assert owner(run_dir).startswith(f"process {os.getpid()} on ")
        assert owner(tmp_path) == ""
    assert owner(run_dir) == ""


def test_however_the_block_ends_the_folder_is_free_again(tmp_path: Path) -> None:
    for fault in (ValueError, KeyboardInterrupt):
        with pytest.raises(fault), locked(tmp_path / "new" / "run"):
            raise fault
        assert (tmp_path / "new" / "run" / NAME).read_text() == ""
    started = time.monotonic()
    with locked(tmp_path / "new" / "run"):
        assert time.monotonic() - started < 1


def test_a_folder_that_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    refused = pytest.raises(ValueError, match=r"file/run: cannot be written \(Not a directory\)")
    with refused, locked(tmp_path / "file" / "run"):
        pass
