"""What SIGINT, SIGTERM and SIGHUP, of a terminal that is gone, do to a command.

Where nothing would be lost they do what the system does by default: they end the process at once,
in the middle of a compilation, too, of which Python would hear only after it. How to go on has been
said before. While chunks of training run they are noted instead: the chunk is finished and saved.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

import jax

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(KeyboardInterrupt):
    """A signal came in while a run trained; what it had trained is saved."""

    def __init__(self, number: int, go_on: str = "") -> None:
        self.exit_code = 128 + number
        """130, 143 or 129, as a shell says of a process that a signal has ended."""
        told = f", go on with {go_on}" if go_on else ""
        super().__init__(f"stopped by {signal.Signals(number).name} after saving{told}")


def end_at_once() -> None:
    """Let Ctrl-C end this process without waiting for Python, as SIGTERM does by default."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def deferred(waiting_for: str) -> Iterator[list[int]]:
    """Note signals, since something is to be saved first; a second one does what it did before.

    What was started to go on without its terminal, by nohup, goes on.

    Args:
        waiting_for: what is done before ending, as the user is told upon the first signal.

    Yields:
        The signals so far.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before = {each: signal.getsignal(each) for each in STOPPING}
    terminals = [stream for stream in (1, 2) if os.isatty(stream)]

    def note(number: int, _: FrameType | None) -> None:
        if number == signal.SIGHUP:
            # To write to a terminal that is gone fails, and would keep the run from saving.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for stream in terminals:
                os.dup2(nowhere, stream)
            os.close(nowhere)
        if not received:
            with suppress(OSError):  # Not through `sys.stderr`: it may be at work just now.
                os.write(2, f"\n{waiting_for}; once more to stop at once\n".encode())
            # But a terminal that closes may say so twice, and after Ctrl-C.
            for each in (signal.SIGINT, signal.SIGTERM):
                signal.signal(each, before[each])
        received.append(number)

    for each, handler in before.items():
        if each != signal.SIGHUP or handler != signal.SIG_IGN:
            signal.signal(each, note)
    try:
        yield received
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def wait_for(arrays: Any) -> None:
    """Wait until arrays are computed, in naps: Python handles signals between them, not in JAX."""
    while not all(each.is_ready() for each in jax.tree.leaves(arrays)):
        time.sleep(0.005)
