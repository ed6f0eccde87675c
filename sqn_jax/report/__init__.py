"""A report on trained policies: one page that needs no other files and no network.

`content` runs the evaluation, `episodes` ranks the episodes and finds where robots got stuck,
`pictures` draws, `page` writes HTML, `play` the page beside it, to try the worst episode on.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sqn_jax.evaluation.cached_work import cached_work
from sqn_jax.evaluation.settings import Settings
from sqn_jax.outside.messages import say
from sqn_jax.report.content import Run, gather_content, read_runs
from sqn_jax.report.page import to_html
from sqn_jax.report.pictures import draw_pictures
from sqn_jax.report.play import path_beside, worst_to_play
from sqn_jax.storage import html

__all__ = ["Run", "read_runs", "require_writable", "write_report"]


def require_writable(out: Path) -> None:
    """Refuse a report that could not be written, before any episode runs.

    Raises:
        ValueError: the name does not end in .html, or the file or the one beside it cannot be
            written.
    """
    html.require_writable(out)
    html.require_writable(path_beside(out))


@cached_work()
def write_report(
    runs: Sequence[Run],
    settings: Settings,
    out: Path,
    *,
    baselines: bool = True,
    epsilon: float = 0.0,
) -> list[Path]:
    """Evaluate runs with a progress bar and write a page about them, and one to play on.

    Args:
        runs: from `read_runs`, at least one.
        settings: of the evaluation; the report is for the first goal radius.
        out: the HTML file; an existing one is replaced, as is `path_beside` it.
        baselines: whether to evaluate the oracle and the wall follower too.
        epsilon: probability of a random action of the policies in each step; 0 is greedy.

    Returns:
        The files that were written: without the second where no policy can be played.

    Raises:
        ValueError: a map is unusable for a robot, two runs have the same name, or the file
            cannot be written.
    """
    content = gather_content(runs, settings, baselines=baselines, epsilon=epsilon)
    pictures = draw_pictures(content)
    play_file = path_beside(out)
    try:
        playable = worst_to_play(content, play_file.name)
    except ValueError as error:
        say(f"{play_file} is left out: {error}")
        html.write_page(out, to_html(content, pictures, no_play=str(error)))
        return [out]
    html.write_page(play_file, playable.html)
    html.write_page(out, to_html(content, pictures, playable.links))
    return [out, play_file]
