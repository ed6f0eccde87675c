"""How a command reacts to SIGINT, SIGTERM and SIGHUP (the terminal was closed).

While nothing would be lost, the system's default applies: the signal ends the process at once, also
during a compilation, after which Python would react only. The command to resume with has been
printed before. During training a signal is recorded instead: the chunk is finished and saved.
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

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(KeyboardInterrupt):
    """A signal stopped a training run; its state is saved."""

    def __init__(self, number: int, resume_command: str = "") -> None:
        self.exit_code = 128 + number
        """130, 143, 129 or 141, as a shell reports a process that a signal has ended."""
        advice = f", resume with {resume_command}" if resume_command else ""
        super().__init__(f"stopped by {signal.Signals(number).name} after saving{advice}")


def end_at_once() -> None:
    """Let Ctrl-C end this process without waiting for Python, as SIGTERM does by default."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def deferred(waiting_for: str) -> Iterator[list[int]]:
    """Record signals instead of ending, so that a run can save first; a second one ends it.

    A process that ignores SIGHUP (`nohup`) continues to do so.

    Args:
        waiting_for: what is done before the process ends; printed upon the first signal.

    Yields:
        A list, to which the numbers of the signals are appended.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    terminals = [stream for stream in (1, 2) if os.isatty(stream)]

    def record(number: int, _: FrameType | None) -> None:
        # Before anything else: another signal may come while this function runs.
        received.append(number)
        if len(received) == 1:
            # Not for SIGHUP: a closing terminal may send it twice, and after Ctrl-C.
            for stop in (signal.SIGINT, signal.SIGTERM):
                signal.signal(stop, handlers[stop])
        if number == signal.SIGHUP:
            # Writing to a closed terminal fails, and would prevent the run from saving.
            null_device = os.open(os.devnull, os.O_WRONLY)
            for stream in terminals:
                os.dup2(null_device, stream)
            os.close(null_device)
        if len(received) == 1:
            with suppress(OSError):  # Not through `sys.stderr`, which may be in use.
                os.write(2, f"\n{waiting_for}; once more to stop at once\n".encode())

    for number, handler in handlers.items():
        if number != signal.SIGHUP or handler != signal.SIG_IGN:
            signal.signal(number, record)
    try:
        yield received
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def wait_for(arrays: Any) -> None:
    """Wait until arrays are computed, in short sleeps: Python handles no signals inside JAX."""
    import jax

    while not all(array.is_ready() for array in jax.tree.leaves(arrays)):
        time.sleep(0.005)
