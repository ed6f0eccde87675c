"""Processes that C++ code aborts: one line where JAX does so for the sake of another, else all."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

PROGRAM = """
import ctypes, os
from sqn_jax.runs import aborts
libc = ctypes.CDLL(None)
libc.fputs.argtypes = [ctypes.c_char_p, ctypes.c_void_p]
aborts.GRACE_SECONDS = 0.0
with aborts.reported("a process was lost"):
    libc.fputs({text!r}, ctypes.c_void_p.in_dll(libc, "stderr"))
    {end}
"""
FATAL = b"F1128 client.h:80] JAX distributed service detected fatal errors.\n    @ 0x7f49\n"


@pytest.mark.skipif(sys.platform != "linux", reason="the name of C's stream")
@pytest.mark.parametrize(
    ("text", "end", "code", "printed"),
    [
        (FATAL, "os.abort()", 1, b"sqn: a process was lost\n"),
        (b"LLVM ERROR: out of memory\n", "os.abort()", -signal.SIGABRT, None),
        (b"a warning\n", "pass", 0, b"a warning\n"),
        (b"", "print('as always')", 0, b""),
    ],
)
def test_an_abort_for_the_sake_of_another_process_is_one_line(
    text: bytes, end: str, code: int, printed: bytes | None
) -> None:
    program = PROGRAM.format(text=text, end=end)
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60)
    assert ended.returncode == code, ended.stderr
    if printed is None:
        assert ended.stderr.endswith(text)
    else:
        assert ended.stderr == printed
    assert ended.stdout == (b"as always\n" if "print" in end else b"")
