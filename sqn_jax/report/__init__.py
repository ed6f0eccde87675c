"""A report on trained policies: one page that needs no other files and no network.

`content` runs the evaluation, `episodes` ranks the episodes and finds where robots got stuck,
`pictures` draws, `page` writes HTML.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sqn_jax.evaluation.settings import Settings
from sqn_jax.report.content import Run, gather_content, read_runs
from sqn_jax.report.page import to_html
from sqn_jax.report.pictures import draw_pictures
from sqn_jax.storage.compile_cache import cached_programs
from sqn_jax.storage.html import require_writable, write_page

__all__ = ["Run", "read_runs", "require_writable", "write_report"]


@cached_programs()
def write_report(
    runs: Sequence[Run],
    settings: Settings,
    out: Path,
    *,
    baselines: bool = True,
    epsilon: float = 0.0,
) -> None:
    """Evaluate runs with a progress bar and write a page about them.

    Args:
        runs: from `read_runs`, at least one.
        settings: of the evaluation; the report is for the first goal radius.
        out: the HTML file; an existing one is replaced.
        baselines: whether to evaluate the oracle and the wall follower too.
        epsilon: probability of a random action of the policies in each step; 0 is greedy.

    Raises:
        ValueError: a map is unusable for a robot, two runs have the same name, or the file
            cannot be written.
    """
    content = gather_content(runs, settings, baselines=baselines, epsilon=epsilon)
    write_page(out, to_html(content, draw_pictures(content)))
