"""Signals to a process: who ends when, with which exit code, and what it says."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from sqn_jax.runs.signals import Interrupted, collected, interruptible, last_words, say_stopped

# A loop in Python hears of a signal at once; what is compiled not before it has ended.
IN_PYTHON = "while True: time.sleep(0.01)"
IN_COMPILED_CODE = "hashlib.pbkdf2_hmac('sha256', b'x', b'x', 500_000_000)"

# Whoever runs the tests may have ignored SIGHUP, as nohup does, and children inherit that.
HEED_HANGUP = """
import signal
signal.signal(signal.SIGHUP, signal.SIG_DFL)
"""

PROGRAM = (
    HEED_HANGUP
    + """
import hashlib, sys, time
from sqn_jax.runs import signals
from sqn_jax.runs.signals import Interrupted, collected, interruptible, last_words, say_stopped
signals.GRACE = {grace}
try:
    with interruptible("sqn"), last_words("go on with this"):
        print("ready", flush=True)
        {body}
except Interrupted as stop:
    say_stopped(stop.signal)
    print("in order", flush=True)
    sys.exit(stop.exit_code)
"""
)


class Child:
    """A process that has said it is ready; use as a context manager, which leaves none behind."""

    def __init__(self, body: str, grace: float = 0.3) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(body=body, grace=grace)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        assert self.process.stdout.readline() == "ready\n"
        time.sleep(0.1)

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def send(self, number: int) -> None:
        self.process.send_signal(number)

    def told(self) -> str:
        """The next line on stderr that is not empty."""
        line = ""
        while not line:
            line = self.process.stderr.readline().strip()  # type: ignore[union-attr]
        return line

    def end(self) -> tuple[int, str, str]:
        self.process.wait(timeout=60)
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        return self.process.returncode, self.process.stdout.read(), self.process.stderr.read()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_in_python_ends_in_order(number: signal.Signals) -> None:
    with Child(IN_PYTHON) as child:
        child.send(number)
        code, out, err = child.end()
        assert (code, out) == (128 + number, "in order\n")
        assert err == f"\nsqn: stopped by {number.name}\ngo on with this\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_compiled_code_is_not_waited_for_where_nothing_is_to_be_saved(
    number: signal.Signals,
) -> None:
    with Child(IN_COMPILED_CODE) as child:
        sent = time.monotonic()
        child.send(number)
        code, out, err = child.end()
        assert (code, out) == (128 + number, "")
        assert err == f"\nsqn: stopped by {number.name}\ngo on with this\n"
        assert 0.25 < time.monotonic() - sent < 10


IN_A_CALLBACK = """
        import gc
        gc.callbacks.append(lambda phase, info: time.sleep(0.01))
        while True:
            gc.collect()
            time.sleep(0.005)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_gets_lost_in_a_callback_is_raised_again(number: signal.Signals) -> None:
    """Python prints what the garbage collector's callbacks raise, and goes on."""
    for _ in range(2):
        with Child(IN_A_CALLBACK.strip(), grace=1000) as child:
            child.send(number)
            code, out, err = child.end()
            assert (code, out) == (128 + number, "in order\n")
            assert err == f"\nsqn: stopped by {number.name}\ngo on with this\n"


def test_a_second_signal_ends_at_once() -> None:
    with Child(IN_COMPILED_CODE, grace=1000) as child:
        child.send(signal.SIGTERM)
        time.sleep(0.3)
        assert child.process.poll() is None
        child.send(signal.SIGINT)
        code, _, err = child.end()
        assert code == 130
        assert "stopped at once by SIGINT" in err


COLLECT = """
        with collected("stopping after this chunk and saving") as received:
            print("collecting", flush=True)
            hashlib.pbkdf2_hmac('sha256', b'x', b'x', {rounds})
            print(received, flush=True)
        if received:
            raise Interrupted(received[0])
"""


def test_what_is_to_be_saved_is_waited_for_and_the_user_told_at_once() -> None:
    with Child(COLLECT.strip().format(rounds=4_000_000), grace=0.05) as child:
        assert child.process.stdout.readline() == "collecting\n"  # type: ignore[union-attr]
        time.sleep(0.1)
        child.send(signal.SIGTERM)
        assert child.told() == "stopping after this chunk and saving; once more to stop at once"
        assert child.process.poll() is None
        code, out, err = child.end()
        assert (code, out) == (143, f"[{signal.SIGTERM:d}]\nin order\n")
        assert err == "\nsqn: stopped by SIGTERM\ngo on with this\n"


def test_while_it_is_waited_for_a_second_signal_ends_at_once() -> None:
    with Child(COLLECT.strip().format(rounds=500_000_000)) as child:
        assert child.process.stdout.readline() == "collecting\n"  # type: ignore[union-attr]
        time.sleep(0.1)
        child.send(signal.SIGINT)
        assert child.told() == "stopping after this chunk and saving; once more to stop at once"
        child.send(signal.SIGINT)
        code, out, err = child.end()
        assert (code, out) == (130, "")
        assert "stopped at once by SIGINT" in err


WITHOUT_TERMINAL = (
    HEED_HANGUP
    + """
import fcntl, os, sys, termios, time
from sqn_jax.runs.signals import collected, interruptible
fcntl.ioctl(0, termios.TIOCSCTTY, 0)  # the terminal is this session's: closing it hangs it up
with interruptible("sqn"), collected("saving") as received:
    print("ready", flush=True)
    while not received:
        time.sleep(0.01)
    time.sleep(0.2)
    print("a line to a terminal that is gone", file=sys.stderr, flush=True)
    with open(sys.argv[1], "w") as file:
        file.write(f"saved after {received}")
"""
)


def start_on_terminal(saved: Path) -> tuple[subprocess.Popen[bytes], int]:
    """The program above as the first process of a terminal of its own, which is returned, too."""
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", WITHOUT_TERMINAL, str(saved)],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
    )
    os.close(slave)
    told = b""
    while b"ready" not in told:
        told += os.read(master, 100)
    return process, master


def test_a_terminal_that_is_closed_does_not_keep_from_saving(tmp_path: Path) -> None:
    process, terminal = start_on_terminal(tmp_path / "saved")
    os.close(terminal)
    try:
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()
    assert (tmp_path / "saved").read_text() == f"saved after [{signal.SIGHUP:d}]"


def test_what_was_started_to_go_on_without_a_terminal_goes_on() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptible(), collected("saving") as received:
            os.kill(os.getpid(), signal.SIGHUP)
        assert received == []
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_afterwards_signals_are_what_they_were() -> None:
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    threads = threading.active_count()
    with interruptible():
        with collected("saving") as received:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.05)
        assert received == [signal.SIGTERM]
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before
    assert signal.set_wakeup_fd(-1) == -1
    assert threading.active_count() == threads


def test_last_words_are_those_of_the_command_that_was_stopped(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(ValueError, match="other"), last_words("first"):
        raise ValueError("other")
    with last_words("second"):
        pass
    say_stopped(signal.SIGINT)
    assert capsys.readouterr().err == "\nsqn: stopped by SIGINT\n"
    with pytest.raises(Interrupted), last_words("third"):
        raise Interrupted(signal.SIGTERM)
    say_stopped(signal.SIGTERM)
    assert capsys.readouterr().err == "\nsqn: stopped by SIGTERM\nthird\n"
