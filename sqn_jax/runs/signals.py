"""What SIGINT, SIGTERM and SIGHUP, of a terminal that is gone, do to a command.

Python handles a signal between two instructions of its main thread; a compilation or a chunk of
training is one instruction, and takes seconds to minutes. A thread beside it is told at once: it
says what is going to happen, and ends the process where the main thread does not.
"""

from __future__ import annotations

import os
import random
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

GRACE = 5.0
"""Seconds the main thread is given to end in order, where nothing is left to be saved."""

_CLOSE, _AGAIN = 0, 255
"""Bytes that no signal has: the thread is to end; what was raised has got lost."""


class Interrupted(KeyboardInterrupt):
    """One of them came in, anywhere; what is on its way up may clean up."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = signal.Signals(number)

    @property
    def exit_code(self) -> int:
        """130, 143 or 129."""
        return 128 + self.signal


class _Said:
    """What is to be said of a signal, and whether it is waited for."""

    waiting: str | None = None
    """What the main thread does before it ends; None where it may end at any time."""
    last: str | None = None
    """A line for the user once all has ended."""
    on_terminal: tuple[int, ...] = ()
    """Standard output and standard error, where they lead to a terminal."""


_said = _Said()


@contextmanager
def interruptible(command: str = "sqn") -> Iterator[None]:
    """Raise `Interrupted` upon a signal.

    A second one ends the process at once, and so does the first after `GRACE` seconds. What was
    started to go on without its terminal, by nohup, goes on.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, _: FrameType | None) -> NoReturn:
        _leave_terminal(number)
        raise Interrupted(number)

    def raise_again(lost: Any) -> None:
        # A callback of the garbage collector, say: what it raises goes nowhere.
        if lost.exc_type is Interrupted:
            os.write(writer, bytes([_AGAIN]))
        else:
            told(lost)

    told, sys.unraisablehook = sys.unraisablehook, raise_again
    before = {each: signal.signal(each, stop) for each in _heeded()}
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    woken = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    _said.on_terminal = tuple(stream for stream in (1, 2) if os.isatty(stream))
    watch = threading.Thread(target=_watch, args=(reader, command), daemon=True)
    watch.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(woken)
        os.write(writer, bytes([_CLOSE]))
        watch.join()
        os.close(reader)
        os.close(writer)
        sys.unraisablehook = told
        for each, handler in before.items():
            signal.signal(each, handler)


@contextmanager
def collected(waiting: str) -> Iterator[list[int]]:
    """Collect signals instead of being ended by them, since there is something to be saved first.

    Args:
        waiting: what is done before ending, as the user is told upon a signal.

    Yields:
        The signals so far.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def keep(number: int, _: FrameType | None) -> None:
        _leave_terminal(number)
        received.append(number)

    before = {each: signal.signal(each, keep) for each in _heeded()}
    _said.waiting = waiting
    try:
        yield received
    finally:
        _said.waiting = None
        for each, handler in before.items():
            signal.signal(each, handler)


@contextmanager
def last_words(text: str) -> Iterator[None]:
    """A line for the user, in case a signal ends the process within this context."""
    _said.last = text
    try:
        yield
    except Interrupted:
        raise  # The words are said by `say_stopped`.
    except BaseException:
        _said.last = None
        raise
    else:
        _said.last = None


def say_stopped(number: int, command: str = "sqn") -> None:
    """Tell the user which signal it was, and what can be done now."""
    words = "" if _said.last is None else f"{_said.last}\n"
    _said.last = None
    sys.stderr.write(f"\n{command}: stopped by {signal.Signals(number).name}\n{words}")
    sys.stderr.flush()


def _heeded() -> list[signal.Signals]:
    nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [each for each in STOPPING if not (nohup and each == signal.SIGHUP)]


def _leave_terminal(number: int) -> None:
    """Upon SIGHUP let the streams that led to the terminal lead nowhere.

    To write to a terminal that is gone fails, and would keep the main thread from saving. Both
    threads do this before they write: neither can wait for the other.
    """
    if number == signal.SIGHUP:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in _said.on_terminal:
            os.dup2(nowhere, stream)
        os.close(nowhere)


def _watch(reader: int, command: str) -> None:
    """Read the numbers of signals as they come, until told to close."""
    first, deadline = 0, None
    while True:
        left = None if deadline is None else max(0.0, deadline - time.monotonic())
        ready, _, _ = select.select([reader], [], [], left)
        if not ready and _said.waiting is not None:
            deadline = None  # Something to be saved has come in between.
            continue
        if not ready:
            say_stopped(first, command)
            os._exit(128 + first)
        (number,) = os.read(reader, 1)
        if number == _CLOSE:
            return
        if number == _AGAIN:
            time.sleep(random.uniform(0.01, 0.1))  # Out of step with what swallowed it.
            signal.pthread_kill(threading.main_thread().ident or 0, first)
            os.read(reader, 1)  # Of the signal just sent, which is no second one.
            continue
        if number not in STOPPING:
            continue
        _leave_terminal(number)
        if first:
            sys.stderr.write(f"\n{command}: stopped at once by {signal.Signals(number).name}\n")
            sys.stderr.flush()
            os._exit(128 + number)
        first = number
        if _said.waiting is None:
            deadline = time.monotonic() + GRACE
        else:
            sys.stderr.write(f"\n{_said.waiting}; once more to stop at once\n")
            sys.stderr.flush()
