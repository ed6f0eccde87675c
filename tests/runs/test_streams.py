"""What is printed costs nothing of what is computed: closed streams, readers gone, full disks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sqn_jax.config import TrainConfig
from sqn_jax.runs import streams, train

# Prints to both, then opens a file as a run does, and says what became of it in that file.
PROGRAM = """
import os, signal, sys
from sqn_jax.runs import streams
signal.signal(signal.SIGHUP, signal.SIG_DFL)
streams.install()
for _ in range(2):
    print("0.5 \\u00b1 0.1 \\u221e \\udcff" + "x" * 10_000)
    print("progress", file=sys.stderr, flush=True)
    sys.stdout.flush()
left = streams.reader_left()
for stream in (sys.stdout, sys.stderr):
    if stream.error:  # What follows, of libraries too, goes to the null device.
        assert os.path.samestat(os.fstat(stream.fileno()), os.stat(os.devnull))
with open(sys.argv[1], "w") as file:
    file.write(f"{file.fileno()} {streams.failure()!r} {left}")
"""


def shell(tmp_path: Path, redirection: str, environment: str = "") -> tuple[list[str], str]:
    """Run the program in a shell; what it said of its streams, and what arrived on stdout."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    noted = tmp_path / "noted"
    noted.unlink(missing_ok=True)
    root = Path(__file__).parents[2]
    command = f"{environment} PYTHONPATH='{root}' '{sys.executable}' '{program}' '{noted}'"
    done = subprocess.run(
        ["bash", "-c", f"{command} {redirection}"], capture_output=True, text=True, timeout=60
    )
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr
    return noted.read_text().split(" ", 1), done.stdout


@pytest.mark.parametrize(
    ("redirection", "expected"),
    [
        ("", "None False"),
        (">&-", "None False"),
        ("2>&-", "None False"),
        ("<&- >&- 2>&-", "None False"),
        ("| true", "'' True"),
        ("2> >(true)", "'' True"),
        (
            ">/dev/full",
            "'standard output: cannot be written (No space left on device)' False",
        ),
        (
            "2>/dev/full",
            "'standard error: cannot be written (No space left on device)' False",
        ),
    ],
)
def test_a_stream_that_fails_is_noted_and_nothing_else_happens(
    tmp_path: Path, redirection: str, expected: str
) -> None:
    # The pause lets the reader leave before anything is written.
    (descriptor, noted), _ = shell(tmp_path, redirection, "sleep 0.3;")
    assert noted == expected
    assert int(descriptor) > 2  # No file of a run gets the messages of a library.


def test_what_an_encoding_lacks_is_replaced(tmp_path: Path) -> None:
    _, text = shell(tmp_path, "", "PYTHONIOENCODING=ascii")
    assert text.startswith("0.5 +/- 0.1 \\u221e \\udcffx")
    _, text = shell(tmp_path, "", "PYTHONIOENCODING=utf-8")
    assert text.startswith("0.5 ± 0.1 ∞ \\udcffx")


def test_streams_of_others_have_not_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not streams.reader_left()
    monkeypatch.setattr(sys, "stderr", None)
    assert not streams.reader_left()


def test_a_run_on_many_maps_says_that_it_prepares_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ValueError("no map")

    monkeypatch.setattr(train, "load_map", refuse)
    for last, said in ((18, ""), (19, "preparing 20 maps ...\n")):
        with pytest.raises(ValueError, match="no map"):
            train.train_session(TrainConfig(map=f"maze:0-{last}"), tmp_path / "run")
        assert capsys.readouterr().err == said
