"""A report on trained policies: one page that needs nothing beside it, neither files nor a network.

`content` drives and gathers, `episodes` finds those that went worst and where, `pictures` draws,
`page` puts it into HTML.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sqn_jax.evaluation.compare import Settings
from sqn_jax.report.content import Run, gather, read_runs
from sqn_jax.report.page import require_writable, to_html, write
from sqn_jax.report.pictures import draw
from sqn_jax.storage.compile_cache import cached_programs

__all__ = ["Run", "read_runs", "require_writable", "write_report"]


@cached_programs()
def write_report(
    runs: Sequence[Run], settings: Settings, out: Path, *, references: bool = True
) -> None:
    """Evaluate runs under a progress bar and write a page about them.

    Args:
        runs: from `read_runs`, at least one.
        settings: where and how often; the first goal radius is the one reported.
        out: an HTML file, replaced where it is there.
        references: whether an oracle and a wall follower drive too.

    Raises:
        ValueError: a map is unusable for a robot, runs cannot be told apart, or the file cannot be
            written.
    """
    content = gather(runs, settings, references=references)
    write(out, to_html(content, draw(content)))
