"""Aborts of the C++ libraries, as one line instead of their stack traces.

JAX's coordination service aborts a process whose run has lost another one: no Python error is
raised, and a page is printed. What C code prints as an error is held back here. Where that service
aborts the process a line takes its place; where an error is raised it says enough; else it is shown
at the end.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

MARK = b"distributed service detected fatal errors"
"""What JAX prints before it aborts a process for the sake of another."""

GRACE_SECONDS = 2.0
"""Time for Python to come to its own end, if it has noticed too."""

STREAMS = {"linux": "stderr", "darwin": "__stderrp"}
"""Name of C's own standard error, which is not Python's."""

_UNBUFFERED = 2
"""`_IONBF` of stdio.h."""


@contextmanager
def reported(line: str) -> Iterator[None]:
    """Within this context, end the process with exit code 1 and a line where JAX aborts it.

    Args:
        line: what is printed then.
    """
    if sys.platform not in STREAMS:
        yield
        return
    libc = ctypes.CDLL(None)
    libc.fdopen.restype = libc.signal.restype = ctypes.c_void_p
    libc.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
    libc.setvbuf.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t]
    with tempfile.TemporaryFile() as printed:

        @ctypes.CFUNCTYPE(None, ctypes.c_int)
        def on_abort(_: int) -> None:
            text = _text_of(printed)
            if MARK not in text:
                os.write(2, text)
                return  # And the process is aborted.
            time.sleep(GRACE_SECONDS)
            os.write(2, f"sqn: {line}\n".encode())
            os._exit(1)

        file = libc.fdopen(os.dup(printed.fileno()), b"w")
        libc.setvbuf(file, None, _UNBUFFERED, 0)
        stream = ctypes.c_void_p.in_dll(libc, STREAMS[sys.platform])
        before, stream.value = stream.value, file
        handler = libc.signal(signal.SIGABRT, ctypes.cast(on_abort, ctypes.c_void_p))
        try:
            yield
        finally:
            libc.signal(signal.SIGABRT, handler)
            stream.value = before
        os.write(2, _text_of(printed))


def _text_of(file: IO[bytes]) -> bytes:
    return os.pread(file.fileno(), 2**20, 0)
