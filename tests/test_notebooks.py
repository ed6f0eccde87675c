"""The notebooks run; what is kept of them has the same cells, no error, no path of a machine."""

from __future__ import annotations

import ast
import base64
import io
import json
import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from compiling import compiling_quickly
from PIL import Image

from sqn_jax.figures import style

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
SOURCES = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
MARKDOWN = "markdown"
BY_NAME = pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)


@pytest.fixture(autouse=True, scope="module")
def quick_compilation() -> Iterator[None]:
    with compiling_quickly():
        yield


def cells_of(text: str) -> list[tuple[str, str]]:
    """The cells of a script in py:percent form: kind and source."""
    body = re.sub(r"\A# ---\n.*?^# ---\n", "", text, flags=re.MULTILINE | re.DOTALL)
    cells: list[tuple[str, list[str]]] = []
    for line in body.splitlines():
        if re.match(r"# %%( \[markdown\])?$", line):
            cells.append((MARKDOWN if line.endswith("]") else "code", []))
        elif cells:
            cells[-1][1].append(line)
        else:
            assert not line, "text before the first cell"
    return [
        (kind, "\n".join(re.sub("^# ?", "", x) if kind == MARKDOWN else x for x in lines).strip())
        for kind, lines in cells
    ]


def executed(source: Path) -> list[dict[str, Any]]:
    """The cells of the notebook beside a script."""
    cells: list[dict[str, Any]] = json.loads(source.with_suffix(".ipynb").read_text("utf-8"))[
        "cells"
    ]
    return cells


def outputs(source: Path) -> list[dict[str, Any]]:
    return [output for cell in executed(source) for output in cell.get("outputs", [])]


def texts(source: Path) -> str:
    """All that the cells printed and showed as text."""
    told = []
    for output in outputs(source):
        shown = [output.get("text", []), *output.get("data", {}).values()]
        told += ["".join(each) for each in shown if "base64" not in "".join(each)[:200]]
    return "\n".join(each for each in told if not each.startswith("iVBORw0KGgo"))


def test_there_are_four_notebooks() -> None:
    assert [source.stem[:2] for source in SOURCES] == ["01", "02", "03", "04"]
    assert [path.stem for path in sorted(FOLDER.glob("*.ipynb"))] == [s.stem for s in SOURCES]


@pytest.mark.parametrize(
    "source",
    [SOURCES[0], *(pytest.param(source, marks=pytest.mark.long) for source in SOURCES[1:])],
    ids=lambda source: source.stem,
)
def test_a_notebook_runs_as_plain_python(
    source: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SQN_NOTEBOOKS", "small")
    # Pictures of few pixels; in one process the notebooks share what they compile.
    monkeypatch.setattr(style, "DPI", 40)
    runpy.run_path(str(source), run_name="__main__")
    assert len(capsys.readouterr().out.splitlines()) > 10


@BY_NAME
def test_a_notebook_finds_what_it_imports(source: Path) -> None:
    """The short form of running them all: a name that has moved."""
    imports = [
        node
        for node in ast.parse(source.read_text("utf-8")).body
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    assert len(imports) > 3
    for each in imports:
        exec(ast.unparse(each), {})


@BY_NAME
def test_what_is_kept_has_exactly_the_cells_of_the_script(source: Path) -> None:
    kept = [(cell["cell_type"], "".join(cell["source"])) for cell in executed(source)]
    assert kept == cells_of(source.read_text("utf-8"))


@BY_NAME
def test_every_cell_was_run_in_order_and_none_failed(source: Path) -> None:
    code = [cell for cell in executed(source) if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert {output["output_type"] for output in outputs(source)} <= {"stream", "execute_result"}
    assert not [output for output in outputs(source) if output.get("name") == "stderr"]


@BY_NAME
def test_it_shows_pictures_that_are_not_blank_and_stays_small(source: Path) -> None:
    shown = [output["data"] for output in outputs(source) if "image/png" in output.get("data", {})]
    assert len(shown) >= 2
    for data in shown:
        picture = Image.open(io.BytesIO(base64.b64decode("".join(data["image/png"]))))
        assert picture.format == "PNG"
        assert picture.width == 1440  # 9 inches of 160 pixels.
        colours = picture.convert("RGB").getcolors(maxcolors=2**24)
        assert colours is not None
        assert len(colours) > 50
    assert source.with_suffix(".ipynb").stat().st_size < 1.5e6


def test_the_film_is_an_animation() -> None:
    (film,) = [
        "".join(output["data"]["text/html"])
        for output in outputs(SOURCES[0])
        if "text/html" in output.get("data", {})
    ]
    found = re.search(r'src="data:image/gif;base64,([^"]+)"', film)
    assert found
    picture = Image.open(io.BytesIO(base64.b64decode(found[1])))
    assert picture.format == "GIF"
    assert picture.size[0] == 500
    assert 20 <= getattr(picture, "n_frames", 1) <= 80


@BY_NAME
def test_nothing_of_the_machine_stands_in_an_output(source: Path) -> None:
    told = texts(source)
    assert len(told) > 500
    absolute = r"(?<![\w./])/(home|Users|root|tmp|work|var|usr|opt|private|mnt|etc)/"
    assert not re.search(absolute, told)
    assert not re.search(r"[A-Z]:\\", told)
    assert not re.search(r"\bat 0x[0-9a-f]+", told), "an address of an object"


@BY_NAME
def test_it_opens_with_what_is_learnt_and_ends_with_a_finding(source: Path) -> None:
    cells = cells_of(source.read_text("utf-8"))
    assert cells[0][1].startswith("# ")
    assert len(re.findall("^- ", cells[0][1], flags=re.MULTILINE)) >= 3
    assert "You will" in cells[0][1]
    last = [text for kind, text in cells if kind == MARKDOWN][-1]
    assert "## Finding" in last


def numbers(text: str) -> set[str]:
    """The numbers in a text as they are written, without separators of thousands."""
    return set(re.findall(r"\d+(?:\.\d+)?", re.sub(r"(?<=\d),(?=\d{3})", "", text)))


@BY_NAME
def test_every_number_of_the_finding_stands_in_an_output_or_in_the_text_above(
    source: Path,
) -> None:
    cells = cells_of(source.read_text("utf-8"))
    places = [
        i for i, (kind, text) in enumerate(cells) if kind == MARKDOWN and "## Finding" in text
    ]
    before, finding = cells[places[-1]][1].split("## Finding")
    above = numbers("\n".join([texts(source), before, *(text for _, text in cells[: places[-1]])]))
    said = numbers(finding)
    assert said, "a finding without a number"
    # Whole numbers up to ten count things in the sentence itself.
    unfounded = {n for n in said - above if "." in n or int(n) > 10}
    assert not unfounded
