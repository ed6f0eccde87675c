"""Standard output and error of a command: what is printed must not cost what is computed.

A stream that was closed (`>&-`), a reader that leaves (`| head`) and a full disk raise no error
where something is printed: all that follows is discarded, and the command ends with exit code 1.
A run that is being trained is saved first, and ends as `Interrupted`. Characters that an encoding
lacks are replaced.
"""

from __future__ import annotations

import codecs
import errno
import io
import os
import signal
import sys
from typing import TextIO

_STAND_INS = {"±": "+/-"}


class Stream(io.TextIOWrapper):
    """Text that goes to the null device from its first error on."""

    error: OSError | None = None
    """The first error; None while there was none."""
    was_closed = False
    """Whether there was nowhere to write to from the start."""

    def write(self, text: str) -> int:
        """Write a text, or discard it."""
        try:
            return super().write(text)
        except OSError as error:
            self._discard(error)
            return len(text)

    def flush(self) -> None:
        """Write what is buffered, or discard it."""
        try:
            super().flush()
        except OSError as error:
            self._discard(error)

    def _discard(self, error: OSError) -> None:
        _open_null(self.fileno())  # Also for what is still buffered.
        self.error = self.error or error


def install() -> None:
    """Make `sys.stdout` and `sys.stderr` streams that raise no errors.

    Descriptors that are closed are opened on the null device, before a file of the run gets their
    numbers, and with them the messages of some library.
    """
    codecs.register_error("stand-ins", _stand_in)
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            _open_null(descriptor)
    sys.stdout, sys.stderr = _wrapped(sys.stdout, 1), _wrapped(sys.stderr, 2)


def require_output(instead: str) -> None:
    """Refuse to compute what is only printed where standard output is closed.

    Raises:
        ValueError: it is; the message says what to give instead.
    """
    if sys.stdout is None or (isinstance(sys.stdout, Stream) and sys.stdout.was_closed):
        raise ValueError(f"standard output is closed, expected {instead}")


def reader_left() -> bool:
    """Whether a run should stop since nobody reads its output; never under `nohup`."""
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        return False
    return any(error.errno == errno.EPIPE for _, error in _errors())


def failure() -> str | None:
    """Flush both streams; a line on what could not be written, None if all was.

    The line is empty if the reader has left, as `head` does.
    """
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    for name, error in _errors():
        is_left = error.errno == errno.EPIPE
        return "" if is_left else f"{name}: cannot be written ({error.strerror})"
    return None


def _errors() -> list[tuple[str, OSError]]:
    streams = {"standard output": sys.stdout, "standard error": sys.stderr}
    return [
        (name, stream.error)
        for name, stream in streams.items()
        if isinstance(stream, Stream) and stream.error is not None
    ]


def _wrapped(stream: TextIO | None, descriptor: int) -> Stream:
    """A stream in place of Python's own, which is None where its descriptor was closed."""
    encoding, is_by_line = "utf-8", descriptor == 2
    if stream is not None:
        stream.flush()
        encoding, is_by_line = stream.encoding, stream.isatty() or is_by_line
    buffer = io.BufferedWriter(io.FileIO(descriptor, "w", closefd=False))
    wrapped = Stream(buffer, encoding, "stand-ins", line_buffering=is_by_line)
    wrapped.was_closed = stream is None
    return wrapped


def _stand_in(error: UnicodeError) -> tuple[str, int]:
    """Error handler of the encodings: stand-ins, backslash and number of all other characters."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    texts = [
        _STAND_INS.get(sign) or sign.encode("ascii", "backslashreplace").decode()
        for sign in lacking
    ]
    return "".join(texts), error.end


def _open_null(descriptor: int) -> None:
    """Let a descriptor stand for the null device."""
    null_device = os.open(os.devnull, os.O_RDWR)
    if null_device != descriptor:
        os.dup2(null_device, descriptor)
        os.close(null_device)
