"""The report's page: its numbers, and hostile names in it."""

from __future__ import annotations

import dataclasses
import io
import json
import re
from html import unescape
from urllib.parse import unquote

from PIL import Image
from report_parts import EVIL, Page, entry, evil_content, needs_nothing

from sqn_jax.config.presets import PRESETS
from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.evaluation.settings import Settings
from sqn_jax.report.content import changed_settings
from sqn_jax.report.page import lead, success_table, to_html
from sqn_jax.report.pictures import Illustration, Illustrations
from sqn_jax.report.play import worst_to_play

RESULTS = [
    entry("sqn", "maze", 0.75, 123.4),
    entry("bug", "maze", 0.5, 200.0),
    entry("sqn", "hall", 0.25, 1234.5),
    entry("bug", "hall", 0.125, 300.25),
]


def test_the_table_holds_the_evaluation_s_numbers_and_the_paper_s_beside_them() -> None:
    page = Page(success_table(RESULTS, Settings(maps=("maze", "hall.yaml"))))
    assert page.rows[0] == ["", "maze", "hall"]
    assert page.row("sqn") == ["0.75 [0.38, 0.88]", "123.4", "0.25 [0.12, 0.62]", "1,234.5"]
    assert page.row("bug (wall follower)")[:2] == ["0.50 [0.25, 0.75]", "200.0"]
    assert page.row("the paper, SQN") == ["0.98", "181.1", "", ""]  # Table I of the paper.


def test_a_user_s_own_map_called_maze_is_not_set_beside_the_paper_s() -> None:
    page = Page(success_table(RESULTS, Settings(maps=("my/maze.yaml", "hall.yaml"))))
    assert "paper" not in page.text
    pairs = [{**each, "tasks": "random pairs"} for each in RESULTS]
    assert "paper" not in Page(success_table(pairs, Settings(maps=("maze", "hall.yaml")))).text


def test_what_differs_from_the_nearest_preset_is_named_and_nothing_else() -> None:
    config = PRESETS["quick"]
    learner = dataclasses.replace(config.learner, discount=0.9)
    changed = dataclasses.replace(config, map="cave", learner=learner)
    assert changed_settings(changed) == (
        "quick",
        [("map", "cave", "maze"), ("learner.discount", 0.9, 0.985)],
    )
    assert changed_settings(PRESETS["paper"]) == ("paper", [])


def picture(kind: str) -> Illustration:
    file = io.BytesIO()
    Image.new("P", (3, 2)).save(file, format=kind)
    return Illustration(file.getvalue(), EVIL, EVIL)


def test_hostile_names_are_text_and_nothing_else() -> None:
    pictures = Illustrations([picture("PNG")], [], [picture("PNG")], 3, picture("GIF"))
    html = to_html(evil_content(), pictures)
    page = Page(html)
    needs_nothing(page)
    assert [image.format for image in page.images()] == ["PNG", "PNG", "GIF"]
    assert html.count("<img ") == 3
    assert "<script" not in html
    # Title, heading, first sentence, worst episode twice, table twice, captions, settings.
    assert page.text.count(EVIL) >= 11
    assert "3 more pictures are left out" in page.text
    whole = re.search(r"<pre>(.*?)</pre>", html, re.DOTALL)
    assert whole is not None
    assert json.loads(unescape(whole[1]))["map"] == EVIL


def test_hostile_names_are_inert_in_the_page_to_play_on_and_in_the_link_to_it() -> None:
    content = evil_content()
    playable = worst_to_play(content, f"{EVIL}-play.html")
    (link,) = playable.links
    assert re.fullmatch(r"[\w%.,#=&-]+", str(link), re.ASCII)
    assert unquote(str(link)).startswith(f"{EVIL}-play.html#map={EVIL}&start=1.05")
    page = Page(
        to_html(content, Illustrations([picture("PNG")], [], [], 0, picture("GIF")), [link])
    )
    needs_nothing(page, str(link))
    tags = [tag for tag, _ in Page(playable.html).tags]
    assert tags.count("script") == 2
    assert "img" not in tags


def test_the_first_sentence_tells_success_and_steps_of_each_map() -> None:
    content = dataclasses.replace(
        evil_content(),
        agents=[TrainedAgent("sqn", ())],
        evaluation={"results": RESULTS},
        settings=Settings(maps=("maze", "hall")),
    )
    assert (
        lead(content) == "sqn has success 0.75 in maze (123 steps) and 0.25 in hall (1,234 steps)."
    )
