"""Files of HTML that the program writes."""

from __future__ import annotations

from pathlib import Path

from sqn_jax.storage.files import NotWritten, probe_file, written_whole


def require_writable(path: Path) -> None:
    """Refuse a file that could not be written, before any work is done for it.

    Raises:
        ValueError: the name does not end in .html, or the file cannot be written.
    """
    if path.suffix != ".html":
        raise ValueError(f"--out is {path}, expected a file ending in .html")
    if not path.parent.is_dir() or path.is_dir():
        raise ValueError(f"--out {path}: expected a file in an existing folder")
    try:
        probe_file(path)
    except NotWritten as error:
        raise ValueError(f"--out {error}") from None


def write_page(path: Path, html: str) -> None:
    """Write a page, all or nothing.

    Raises:
        ValueError: it cannot be written.
    """
    with written_whole(path) as partial:
        partial.write_text(html, encoding="utf-8", errors="replace", newline="\n")
