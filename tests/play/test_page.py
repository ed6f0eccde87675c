"""The page as a file: what it may do, what is in it, and what `sqn play` refuses."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rooms import write_empty_room

from sqn_jax.cli import main
from sqn_jax.config import TrainConfig
from sqn_jax.maps import OccupancyMap, load_map
from sqn_jax.play.page import maps_of_page, play_page, script_of
from sqn_jax.policies.run_policies import Policy

WEB = Path(__file__).resolve().parents[2] / "sqn_jax" / "play" / "web"
MODULES = sorted(WEB.glob("*.js"))
HOSTILE = "</script><!--<script><img src=x onerror=alert(1)>&\"'$(touch x)"


class Elements(HTMLParser):
    """Start tags with their attributes, and the text in elements that hold text alone."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self.inside = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.inside = dict(attrs).get("type") or tag

    def handle_endtag(self, tag: str) -> None:
        self.inside = ""

    def handle_data(self, data: str) -> None:
        self.texts[self.inside] = self.texts.get(self.inside, "") + data


def small_map(name: str = "small") -> OccupancyMap:
    occupied = np.zeros((20, 30), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    points = np.array([[0.5, 0.5], [1.0, 0.5]])
    return OccupancyMap(name, occupied, 0.05, points, points)


def small_page(name: str = "tiny") -> str:
    """A page without a network in it."""
    return play_page(Policy(name, TrainConfig(), ({},)), [small_map(name)], source=name)


def test_its_policy_lets_one_script_and_one_style_in_and_nothing_out() -> None:
    page = Elements(small_page())
    (policy,) = (
        str(attributes["content"])
        for tag, attributes in page.tags
        if tag == "meta" and attributes.get("http-equiv") == "Content-Security-Policy"
    )
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules.pop("default-src") == "'none'"
    assert rules.pop("img-src") == "data: blob:"
    for name, element in (("script-src", "module"), ("style-src", "style")):
        digest = hashlib.sha256(page.texts[element].encode()).digest()
        assert rules.pop(name) == f"'sha256-{base64.b64encode(digest).decode()}'"
    assert set(rules.values()) == {"'none'"}
    for tag, attributes in page.tags:
        assert tag not in ("iframe", "object", "embed", "base", "img"), tag
        assert "style" not in attributes
        assert not any(name.startswith("on") for name in attributes), attributes
        links = [attributes.get(name) for name in ("src", "href", "action")]
        assert not [link for link in links if link and not link.startswith("data:")], attributes


def test_hostile_names_are_data_and_nothing_else() -> None:
    ours, theirs = Elements(small_page()), Elements(small_page(HOSTILE))
    assert [tag for tag, _ in ours.tags] == [tag for tag, _ in theirs.tags]
    data = json.loads(theirs.texts["application/json"])
    assert data["policy"]["name"] == data["maps"][0]["name"] == HOSTILE
    assert theirs.texts["title"].startswith(HOSTILE)
    # In a command that one copies, a shell takes it for one word.
    assert data["source"] == "'" + HOSTILE.replace("'", "'\"'\"'") + "'"


def test_the_same_policy_and_maps_give_the_same_page() -> None:
    assert small_page() == small_page()


def test_the_script_holds_every_module_once_after_those_that_it_needs() -> None:
    script = script_of("main")
    assert not re.search(r"^(import|export)\b", script, re.MULTILINE)
    for module in MODULES:
        text = module.read_text(encoding="utf-8")
        body = re.sub(r"^import .*\n", "", text, flags=re.MULTILINE)
        place = script.find(re.sub(r"^export ", "", body, flags=re.MULTILINE).strip())
        assert place >= 0, module.name
        for needed in re.findall(r"from '\./(\w+)\.js'", text):
            own = (WEB / f"{needed}.js").read_text(encoding="utf-8")
            name = re.findall(r"^export (?:class|function|const) (\w+)", own, re.MULTILINE)
            assert not name or 0 <= script.find(f" {name[0]}") < place, (module.name, needed)


def top_level_names(text: str) -> list[str]:
    simple = re.findall(r"^(?:export )?(?:async )?(?:function|class|const|let) (\w+)", text, re.M)
    lists = re.findall(r"^(?:export )?(?:const|let) [\[{]([^\]}]*)[\]}]", text, re.M)
    return simple + [name.strip() for names in lists for name in names.split(",")]


def test_no_two_modules_have_a_name_in_common() -> None:
    names = [name for module in MODULES for name in top_level_names(module.read_text())]
    assert len(names) > 50
    assert [name for name, count in Counter(names).items() if count > 1] == []


@pytest.mark.parametrize(
    "what",
    [
        *(r"\beval\b", r"\bFunction\(", "innerHTML", "outerHTML", "document.write"),
        *("insertAdjacent", r"\bfetch\(", "XMLHttpRequest", "WebSocket", r"\bimport\("),
        *("localStorage", "sessionStorage", "indexedDB", r"document\.cookie", "sendBeacon"),
        *("https?://", r"setTimeout\(['\"`]"),
    ],
)
def test_no_module_evaluates_stores_or_fetches_anything(what: str) -> None:
    found = [module.name for module in MODULES if re.search(what, module.read_text())]
    assert found == []


def test_a_page_has_the_map_of_the_user_first_and_then_the_project_s(tmp_path: Path) -> None:
    own = load_map(write_empty_room(tmp_path))
    names = [each.name for each in maps_of_page(own, 0.1)]
    assert names == [own.name, "cave", "column", "forest", "maze"]
    assert maps_of_page(load_map("maze"), 0.1)[0].name == "maze"
    mine = dataclasses.replace(own, name="maze")
    assert maps_of_page(mine, 0.1)[0] is mine
    assert len(maps_of_page(mine, 0.1)) == 4


def test_play_writes_one_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_empty_room(tmp_path).rename(tmp_path / "my_map.yaml")
    before = {path.name for path in tmp_path.iterdir()}
    assert main(["play", "pretrained:dqn", "--map", "my_map.yaml"]) == 0
    assert {path.name for path in tmp_path.iterdir()} - before == {"play.html"}
    assert "play.html" in capsys.readouterr().out
    html = Path("play.html").read_text(encoding="utf-8")
    data = json.loads(Elements(html).texts["application/json"])
    assert (data["policy"]["algo"], data["source"]) == ("dqn", "pretrained:dqn")
    assert data["maps"][data["task"]["map"]]["name"] == "my_map"


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        ([], ["POLICY"]),
        (["pretrained:nobody"], ["pretrained:nobody", "no such policy"]),
        (["nowhere"], ["nowhere", "holds no run"]),
        (["pretrained:sqn", "--map", "nowhere"], ["nowhere", "maze"]),
        (["pretrained:sqn", "--map", "maze:0-3"], ["--map maze:0-3", "one map"]),
        (["pretrained:sqn", "--seed", "99"], ["no training seed 99"]),
        (["pretrained:sqn", "--out", "page.htm"], ["--out", "page.htm", ".html"]),
        (["pretrained:sqn", "--out", "no/such/page.html"], ["--out", "existing folder"]),
        (["pretrained:sqn", "--out", "/proc/page.html"], ["/proc/page.html", "cannot be written"]),
    ],
)
def test_wrong_arguments_of_play_are_named_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    names: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["play", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith("sqn: ")
    assert said.count("\n") == 1
    for name in names:
        assert name in said, (name, said)
    assert list(tmp_path.iterdir()) == []


def test_weights_too_large_for_half_precision_are_refused() -> None:
    huge: Any = {"params": {"layer": {"kernel": np.full((2, 2), 1e9, np.float32)}}}
    with pytest.raises(ValueError, match="1e\\+09"):
        play_page(Policy("big", TrainConfig(), (huge,)), [small_map()], source="x")
