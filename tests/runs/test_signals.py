"""Signals to a process: who ends when, with which exit code, and what it says."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from sqn_jax.runs.signals import Interrupted, deferred

STOPPING = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]

# Whoever runs the tests may have ignored SIGHUP, as nohup does, and children inherit that.
PROGRAM = """
import hashlib, os, signal, sys, time
signal.signal(signal.SIGHUP, signal.SIG_DFL)
import jax, jax.numpy as jnp
from sqn_jax.runs.signals import Interrupted, deferred, end_at_once, wait_for
end_at_once()
try:
    {body}
except Interrupted as stop:
    print(stop, file=sys.stderr)
    sys.exit(stop.exit_code)
"""

# Neither C code of Python's nor a program of XLA's lets Python's handlers run.
IN_COMPILED_CODE = """
    print("ready", flush=True)
    hashlib.pbkdf2_hmac('sha256', b'x', b'x', 500_000_000)
"""
IN_A_CHUNK = """
    chunk = jax.jit(lambda x: jax.lax.fori_loop(0, {steps}, lambda i, c: jnp.sin(c) @ c, x))
    chunk = chunk.lower(jnp.ones((64, 64))).compile()
    with deferred("stopping after this chunk and saving") as received:
        result = chunk(jnp.ones((64, 64)))
        print("ready", flush=True)
        wait_for(result)
        print("saved", flush=True)
    if received:
        raise Interrupted(received[0], "this command")
"""
NEVER, SOON = 10**9, 150_000
"""Steps of a chunk: longer than any test waits, and a second or so."""
TOLD = "stopping after this chunk and saving; once more to stop at once"


class Child:
    """A process, its exit status as a shell tells it; it has said that it is ready."""

    def __init__(self, body: str) -> None:
        program = PROGRAM.format(body=body.strip())

        self.shell = subprocess.Popen(
            ["sh", "-c", '"$0" -c "$1"; echo "status $?"', sys.executable, program],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.shell.stdout is not None
        assert self.shell.stdout.readline() == "ready\n"
        children = Path(f"/proc/{self.shell.pid}/task/{self.shell.pid}/children")
        self.pid = int(children.read_text().split()[0])
        time.sleep(0.1)

    def send(self, number: int) -> None:
        os.kill(self.pid, number)

    def runs(self) -> bool:
        return self.shell.poll() is None

    def next_line(self) -> str:
        """The next line on stderr that is not empty."""
        line = ""
        while not line:
            line = self.shell.stderr.readline().strip()  # type: ignore[union-attr]
        return line

    def end(self) -> tuple[int, str, str]:
        """Exit status, the rest of stdout and of stderr."""
        out, err = self.shell.communicate(timeout=60)
        out, _, status = out.rpartition("status ")
        return int(status), out, err


@contextmanager
def started(body: str) -> Iterator[Child]:
    child = Child(body)
    try:
        yield child
    finally:
        if child.runs():
            child.send(signal.SIGKILL)
            child.shell.communicate()


linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@linux
@pytest.mark.parametrize("number", STOPPING)
def test_compiled_code_is_not_waited_for_where_nothing_is_to_be_saved(
    number: signal.Signals,
) -> None:
    with started(IN_COMPILED_CODE) as child:
        sent = time.monotonic()
        child.send(number)
        status, out, err = child.end()
        assert (status, out) == (128 + number, "")
        assert "Traceback" not in err
        assert time.monotonic() - sent < 5


@linux
@pytest.mark.parametrize("number", STOPPING)
def test_a_chunk_is_waited_for_and_the_user_told_at_once(number: signal.Signals) -> None:
    with started(IN_A_CHUNK.format(steps=SOON)) as child:
        child.send(number)
        assert child.next_line() == TOLD
        assert child.runs()
        status, out, err = child.end()
        assert (status, out) == (128 + number, "saved\n")
        assert err == f"stopped by {number.name} after saving, resume with this command\n"


@linux
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_while_a_chunk_is_waited_for_a_second_signal_ends_at_once(number: signal.Signals) -> None:
    with started(IN_A_CHUNK.format(steps=NEVER)) as child:
        child.send(signal.SIGINT)
        assert child.next_line() == TOLD
        child.send(number)
        assert child.end()[:2] == (128 + number, "")


@linux
def test_a_terminal_that_closes_says_so_twice_and_even_after_ctrl_c_cuts_nothing_off() -> None:
    with started(IN_A_CHUNK.format(steps=3 * SOON)) as child:
        child.send(signal.SIGINT)
        assert child.next_line() == TOLD
        for _ in range(2):
            child.send(signal.SIGHUP)
            time.sleep(0.05)
        assert child.end()[:2] == (130, "saved\n")


WITHOUT_TERMINAL = """
import fcntl, signal, sys, termios, time
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from sqn_jax.runs.signals import deferred
fcntl.ioctl(0, termios.TIOCSCTTY, 0)  # the terminal is this session's: closing it hangs it up
with deferred("saving") as received:
    print("ready", flush=True)
    while not received:
        time.sleep(0.01)
    time.sleep(0.2)
    for stream in (sys.stdout, sys.stderr):
        print("a line to a terminal that is gone", file=stream, flush=True)
    with open(sys.argv[1], "w") as file:
        file.write(f"saved after {received[0]:d}")
"""


def test_a_terminal_that_is_closed_does_not_keep_from_saving(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", WITHOUT_TERMINAL, str(tmp_path / "saved")],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
    )
    try:
        os.close(slave)
        told = b""
        while b"ready" not in told:
            told += os.read(master, 100)
        os.close(master)
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()
    assert (tmp_path / "saved").read_text() == f"saved after {signal.SIGHUP:d}"


def test_what_was_started_to_go_on_without_a_terminal_goes_on() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with deferred("saving") as received:
            os.kill(os.getpid(), signal.SIGHUP)
        assert received == []
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_afterwards_signals_are_what_they_were(capfd: pytest.CaptureFixture[str]) -> None:
    before = [signal.getsignal(each) for each in STOPPING]
    with deferred("saving") as received:
        os.kill(os.getpid(), signal.SIGTERM)
    assert received == [signal.SIGTERM]
    assert [signal.getsignal(each) for each in STOPPING] == before
    assert capfd.readouterr().err == "\nsaving; once more to stop at once\n"


def test_who_was_interrupted_says_by_what_and_how_to_go_on() -> None:
    stop = Interrupted(signal.SIGTERM, "`this`")
    assert stop.exit_code == 143
    assert str(stop) == "stopped by SIGTERM after saving, resume with `this`"
    assert str(Interrupted(signal.SIGINT)) == "stopped by SIGINT after saving"
