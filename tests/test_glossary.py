"""The package is written in the words of the glossary in CONTRIBUTING.md.

The table there is the only list of words: what its last column marks as code may be no part of a
name in `sqn_jax/`, and what it marks bold may not stand in docstrings and comments either. The
source is read, not imported.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
PACKAGE = ROOT / "sqn_jax"

FORBIDDEN_AT_LEAST = {
    *("told", "heeded", "kept", "ways", "lanes", "coins", "chance", "fleet", "drive", "driven"),
    *("driver", "words", "held", "colour", "colours", "optimiser", "normalise", "randomised"),
    *("neighbours", "centre", "centred", "grey", "behaviour"),
}


class Glossary(NamedTuple):
    """Forbidden words (a trailing hyphen: all words that begin so), with the term to use."""

    names: dict[str, str]
    """Not in names; includes those of `prose`."""
    prose: dict[str, str]
    """Not in docstrings and comments."""


def read_glossary(text: str) -> Glossary:
    """The forbidden words of the table under the heading Glossary."""
    glossary = Glossary({}, {})
    section = text.partition("\n## Glossary\n")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    for row in rows[2:]:
        term, _, _, forbidden = (cell.strip() for cell in row.strip("|").split("|"))
        for bold, code in re.findall(r"\*\*([a-z]+-?)\*\*|`([a-z]+-?)`", forbidden):
            terms = [glossary.names[bold or code]] if (bold or code) in glossary.names else []
            glossary.names[bold or code] = " or ".join([*terms, term])
            if bold:
                glossary.prose[bold] = glossary.names[bold]
    return glossary


def term_for(word: str, forbidden: dict[str, str]) -> str | None:
    """The term to use instead of `word`, None where the word is allowed."""
    if word in forbidden:
        return forbidden[word]
    stems = (f"{word[:end]}-" for end in range(len(word), 2, -1))
    return next((forbidden[stem] for stem in stems if stem in forbidden), None)


def words_of(text: str) -> list[str]:
    """The words of a name or of prose, in lower case: `GreyImage`, `grey_image` -> grey, image."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", text)]


def names_of(node: ast.AST) -> Iterator[str]:
    """The names that the node itself makes or uses."""
    for field in ("id", "arg", "attr", "name", "asname", "rest", "kwd_attrs", "names"):
        value = getattr(node, field, None)
        for name in value if isinstance(value, list) else [value]:
            if isinstance(name, str):
                yield name


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Strings that stand as statements, also those below a constant or field: (line, text)."""
    for node in ast.walk(tree):
        text = getattr(node.value, "value", None) if isinstance(node, ast.Expr) else None
        if isinstance(text, str):
            for offset, line in enumerate(text.splitlines()):
                yield node.lineno + offset, line


def comments(source: str) -> Iterator[tuple[int, str]]:
    """(line, text) of each comment."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def faults_of(path: str, source: str, glossary: Glossary) -> list[str]:
    """Forbidden words of one file, a line each: where, which word, what to use instead."""
    tree = ast.parse(source, filename=path)
    faults = set()
    for module_word in words_of(path):
        if term := term_for(module_word, glossary.names):
            faults.add((1, path, module_word, term))
    for node in ast.walk(tree):
        for name in names_of(node):
            for word in words_of(name):
                if term := term_for(word, glossary.names):
                    faults.add((getattr(node, "lineno", 1), name, word, term))
    for line, text in (*docstrings(tree), *comments(source)):
        for word in words_of(text):
            if term := term_for(word, glossary.prose):
                faults.add((line, "prose", word, term))
    return [
        f"{path}:{line}: {where}: not '{word}' but {term}"
        for line, where, word, term in sorted(faults)
    ]


GLOSSARY = read_glossary(CONTRIBUTING.read_text(encoding="utf-8"))

# (source, line of the fault, forbidden word)
PLANTED = {
    "variable": ("x = 1\ntold = 2\n", 2, "told"),
    "part of a variable": ("num_lanes = 2\n", 1, "lanes"),
    "constant": ("LINE_COLOURS = 2\n", 1, "colours"),
    "argument": ("def f(x, *, chance):\n    return x\n", 1, "chance"),
    "keyword": ("f(kept=1)\n", 1, "kept"),
    "attribute": ("x.held\n", 1, "held"),
    "field": ("class A:\n    ways: int\n", 2, "ways"),
    "function": ("def _drive():\n    return 1\n", 1, "drive"),
    "class in camel case": ("class GreyImage:\n    pass\n", 1, "grey"),
    "import": ("from a import (\n    b as words,\n)\n", 2, "words"),
    "global": ("def f():\n    global coins\n", 2, "coins"),
    "exception": ("try:\n    pass\nexcept E as told:\n    pass\n", 3, "told"),
    "docstring": ('def f():\n    """One.\n\n    The neighbours.\n    """\n', 4, "neighbours"),
    "docstring of a field": ('x = 1\n"""Normalised."""\n', 2, "normalised"),
    "comment": ("x = 1  # of the fleet\n", 1, "fleet"),
}
ALLOWED = {
    "longer words": "fleeting = healed = colorful = forkept = driveway = x_wayside\n",
    "strings": "x = {'told': 'colour'}\n",
    "words of prose that are no jargon": 'x = 1  # kept by chance\n"""Driven that way."""\n',
    "American spelling": "class ColorNormalizer:\n    gray_center = 1  # neighbor, meters\n",
}


@pytest.mark.parametrize(("source", "line", "word"), PLANTED.values(), ids=PLANTED)
def test_a_planted_word_is_named_with_its_line_and_the_term_to_use(source, line, word):
    faults = faults_of("a.py", source, GLOSSARY)
    assert len(faults) == 1, faults
    assert faults[0].startswith(f"a.py:{line}: ")
    assert faults[0].endswith(f"not '{word}' but {term_for(word, GLOSSARY.names)}")


def test_the_name_of_a_module_is_a_name_too():
    (fault,) = faults_of("sqn_jax/env/drive.py", "", GLOSSARY)
    assert fault.startswith("sqn_jax/env/drive.py:1: ")


@pytest.mark.parametrize("source", ALLOWED.values(), ids=ALLOWED)
def test_other_words_are_allowed(source):
    assert faults_of("a.py", source, GLOSSARY) == []


def test_the_table_is_read_by_its_marks():
    table = (
        "# A\n\n## Glossary\n\nText.\n\n"
        "| Term | Meaning | Symbol or type | Not |\n|---|---|---|---|\n"
        "| env | one | `lanes` | `lane`, plain |\n| gray | | | **grey-** |\n| move | | | `lane` |\n"
        "\n## B\n\n| b | | | `b` |\n"
    )
    expected = Glossary({"lane": "env or move", "grey-": "gray"}, {"grey-": "gray"})
    assert read_glossary(table) == expected


@pytest.mark.parametrize("word", sorted(FORBIDDEN_AT_LEAST))
def test_the_table_has_a_term_for_each_word_of_the_old_dialect(word):
    assert term_for(word, GLOSSARY.names)


def test_the_package_keeps_to_the_glossary():
    paths = sorted(PACKAGE.rglob("*.py"))
    assert len(paths) > 50, "the source was not found"
    faults = []
    for path in paths:
        name = path.relative_to(ROOT).as_posix()
        faults += faults_of(name, path.read_text(encoding="utf-8"), GLOSSARY)
    assert not faults, "\n" + "\n".join(faults)
