"""The docs: links lead somewhere, the README is short, and what a reader is told to type works.

Every command of README and docs/USAGE.md is parsed, up to where it would begin to compute. The long
test runs them, at the small size that `SMALLER` says.
"""

from __future__ import annotations

import importlib
import re
import runpy
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from compiling import compiling_quickly
from rooms import write_empty_room

from experiments import robustness, table1
from sqn_jax import report
from sqn_jax import tasks as suites_of_tasks
from sqn_jax.cli import main
from sqn_jax.config.map_names import MapFile, ProjectMap, parse
from sqn_jax.config.presets import PRESETS
from sqn_jax.export import check, folder
from sqn_jax.figures import style
from sqn_jax.maps import known_maps
from sqn_jax.play import page as play_page
from sqn_jax.policies import pretrained
from sqn_jax.policies.run_policies import Policy, require_same_network, with_bumper
from sqn_jax.report import render
from sqn_jax.runs import evaluate, train
from sqn_jax.storage.run_folder import RunFolder

ROOT = Path(__file__).resolve().parents[1]
README, USAGE = ROOT / "README.md", ROOT / "docs" / "USAGE.md"
DEPLOYMENT = ROOT / "docs" / "DEPLOYMENT.md"
RECORDS = ROOT / "experiments" / "results"
PAGES = sorted(
    [
        *(README, ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")),
        *(ROOT / "experiments" / "README.md", RECORDS / "README.md"),
        *(
            ROOT / "examples" / "ros2" / "README.md",
            ROOT / "notebooks" / "README.md",
            ROOT / "sqn_jax" / "policies" / "weights" / "README.md",
        ),
    ]
)
MOST_WORDS = 900

TRAIN = ["--preset", "smoke", "--env.max-steps", "30", "--eval.episodes", "2"]
EVALUATE = ["--episodes", "2", "--eval-seeds", "1"]
SMALLER = {
    # For each command what replaces an option with its values, or is put in.
    "train": {"--preset": TRAIN, "--total-episodes": ["--total-episodes", "128"]}
    | {"--num-seeds": ["--num-seeds", "2"], "--map": ["--map", "maze*2,maze:0"]},
    "evaluate": {"--episodes": EVALUATE, "--eval-seeds": [], "--max-steps": ["--max-steps", "20"]}
    | {"--maps": ["--maps", "my_map.yaml"]},
    "report": {"--episodes": EVALUATE, "--eval-seeds": [], "--maps": ["--maps", "my_map.yaml"]},
    "render": {"--episodes": ["--episodes", "1"], "--max-steps": ["--max-steps", "20"]}
    | {"--animations": ["--animations", "1"], "--map": ["--map", "maze"]},
    "map": {},
    "tasks": {"--count": ["--count", "1"]},
    "export": {},
    "play": {},
}


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def without_code(text: str) -> str:
    """A page without its code, within lines and between fences."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S))


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub makes of the headings of a page."""
    text = re.sub(r"^```.*?^```$", "", text_of(page), flags=re.M | re.S)
    found: list[str] = []
    for heading in re.findall(r"^#+ (.*)$", text, flags=re.M):
        slug = re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")
        found.append(slug + (f"-{found.count(slug)}" if slug in found else ""))
    return set(found)


def prose_words(text: str) -> int:
    """Words of a page but for code blocks, tables, comments and addresses of links."""
    text = re.sub(r"^```.*?^```$|^\|[^\n]*$|<!--.*?-->", "", text, flags=re.M | re.S)
    return len(re.findall(r"\w[\w'.,:/-]*", re.sub(r"\]\([^)]*\)", "]", text)))


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a page in a language."""
    fences = re.findall(r"^```(\w*)\n(.*?)^```$", text_of(page), flags=re.M | re.S)
    return [block for found, block in fences if found == language]


def commands(page: Path) -> list[str]:
    """The lines of the shell blocks of a page."""
    whole = [block.replace("\\\n", " ") for block in blocks(page, "sh")]
    return [line for block in whole for line in block.splitlines() if line.strip()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_something_that_exists(page: Path) -> None:
    links = re.findall(r"\[[^\]]*\]\(([^)\s]+)\)", without_code(text_of(page)))
    broken = []
    for link in links:
        if re.match(r"https?://", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        within = target == ROOT or ROOT in target.parents
        if not (within and target.exists()) or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert not broken


def test_every_record_that_is_named_exists_and_every_record_is_described() -> None:
    files = {path.name for path in RECORDS.iterdir()} - {"README.md"}
    described = set(re.findall(r"`([\w.]+\.(?:json|md))`", text_of(RECORDS / "README.md")))
    assert described == files
    notes = set(re.findall(r"`(\w+\.json)`", text_of(ROOT / "docs" / "LAB_NOTES.md")))
    assert notes <= files


def test_the_lab_notes_have_an_index_of_all_titles() -> None:
    text = text_of(ROOT / "docs" / "LAB_NOTES.md")
    titles = [title for title in re.findall(r"^## (.*)$", text, flags=re.M) if title != "Index"]
    index = re.findall(r"^- \[(.*)\]\(#", text, flags=re.M)
    assert sorted(index) == sorted(titles)
    notes = re.split(r"^## ", text, flags=re.M)[2:]
    for note in notes:
        parts = re.findall(r"^\*\*(Question|Setting|Conclusion)\.\*\*", note, flags=re.M)
        assert parts == ["Question", "Setting", "Conclusion"], note.splitlines()[0]


def test_words_of_prose_are_counted_but_no_code_table_or_address() -> None:
    page = (
        "# One two\n\n| a | b |\n|---|---|\n\nThree [four](https://x.y/z).\n```sh\ncd\n```\nfive\n"
    )
    assert prose_words(page) == 5


def test_the_readme_is_read_in_five_minutes() -> None:
    assert prose_words(text_of(README)) <= MOST_WORDS


def test_the_readme_names_every_package() -> None:
    (structure,) = (block for block in blocks(README, "") if "sqn_jax/config" in block)
    named = re.findall(r"(?<![\w/])(?:sqn_jax/)?(\w+)/(?= )", structure.split("\nmaps/")[0])
    packages = {path.parent.name for path in (ROOT / "sqn_jax").glob("*/__init__.py")}
    assert sorted(named) == sorted(packages)


@pytest.mark.parametrize("page", [README, USAGE], ids=lambda page: page.stem)
def test_python_blocks_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for number, block in enumerate(blocks(page, "python")):
        script = tmp_path / f"block_{number}.py"
        script.write_text(block, encoding="utf-8")
        with compiling_quickly():
            runpy.run_path(str(script))
    if page == README:
        said = re.fullmatch(
            r"(\d\.\d+) m from the goal after (\d+) steps\n", capsys.readouterr().out
        )
        assert said
        assert float(said[1]) < 0.3
        assert int(said[2]) < 400


class Begun(Exception):
    """A command has been read, and would now begin to compute."""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that holds what the commands name: a map, and the folder of a run."""
    write_empty_room(tmp_path).rename(tmp_path / "my_map.yaml")
    RunFolder.create(tmp_path / "runs" / "mine", PRESETS["quick"])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def named_maps_exist(*names: str) -> None:
    for name in (each for text in names for each in parse(text).names):
        if isinstance(name, ProjectMap):
            assert str(name) in known_maps()
        if isinstance(name, MapFile):
            assert Path(name.path).is_file()


@pytest.fixture
def _only_read(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put an end to every command where it would begin to compute."""
    policy_of = pretrained.find_policy

    def find_policy(name: str, checkpoint: int | str = "newest", params: str = "shipped") -> Policy:
        if not pretrained.names_a_run(name):
            return policy_of(name, checkpoint)
        RunFolder.open(Path(name))
        return policy_of("pretrained:sqn")

    def train_session(config: Any, run_dir: Path, *, resume: bool, **_: Any) -> None:
        named_maps_exist(config.map)
        if config.start_from:
            require_same_network(policy_of(config.start_from), config)
        assert (run_dir / "config.json").is_file() == resume or run_dir == Path("runs/mine")
        raise Begun

    def evaluate_session(agents: Any, settings: Any, out: Path | None) -> None:
        named_maps_exist(*settings.maps)
        raise Begun

    def read_suite(file: Path) -> None:
        raise Begun

    def render_session(policies: Any, out: Path, *, map_name: str, **_: Any) -> None:
        named_maps_exist(map_name)
        raise Begun

    def write_report(runs: Any, settings: Any, out: Path, **_: Any) -> None:
        named_maps_exist(*settings.maps)
        raise Begun

    def prepare(options: Any, settings: Any) -> None:
        raise Begun

    def read_runs(names: list[str], checkpoint: Any, params: Any, bumper: Any) -> list[Any]:
        read = [with_bumper(find_policy(name, checkpoint, params), bumper) for name in names]
        return [type("Run", (), {"policy": policy}) for policy in read]

    def begin(*_: Any, **options: Any) -> None:
        raise Begun

    cli_tasks = importlib.import_module("sqn_jax.cli.tasks")
    for name in ("_convert", "_generate", "_pairs", "_check"):
        monkeypatch.setattr(cli_tasks, name, begin)
    for module, name in (
        *((folder, "export_policy"), (check, "check_export")),
        (play_page, "play_page"),
    ):
        monkeypatch.setattr(module, name, begin)
    for module, function in (
        *((pretrained, find_policy), (train, train_session), (evaluate, evaluate_session)),
        *((render, render_session), (report, write_report), (report, read_runs)),
        *((table1, prepare), (robustness, prepare), (suites_of_tasks, read_suite)),
    ):
        monkeypatch.setattr(module, function.__name__, function)


SCRIPTS: dict[str, Callable[[], None]] = {"table": table1.main, "robustness": robustness.main}
"""What a target of the Makefile runs, besides `sqn`."""


@pytest.mark.usefixtures("_only_read")
@pytest.mark.parametrize("line", [*commands(README), *commands(USAGE), *commands(DEPLOYMENT)])
def test_every_command_is_one_that_can_be_given(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program, *words = shlex.split(line, comments=True)
    if program == "make":
        target, *more = words
        assert re.search(rf"^{target}:", text_of(ROOT / "Makefile"), flags=re.M)
        given = [shlex.split(word.removeprefix("ARGS=")) for word in more]
        options = given[0] if given else []
        if target in SCRIPTS:
            monkeypatch.setattr(sys, "argv", [target, *options])
            with pytest.raises(Begun):
                SCRIPTS[target]()
            return
        if target == "test":
            assert not options
            return
        program, words = "sqn", [target, *options]
    if program == "sqn":
        if words[0] == "map":
            assert main(words) == 0
        else:
            with pytest.raises(Begun):
                main(words)
    elif program == ".venv/bin/python":
        files = [word for word in words if word.endswith((".py", ".txt"))]
        assert files, "neither a script nor a list of versions: how is this checked?"
        assert all((ROOT / file).is_file() for file in files)
    else:
        pytest.fail(f"{program}: how is this checked?")


def smaller(words: list[str]) -> list[str]:
    """The arguments of `sqn`, for as little as shows that it works."""
    command, *rest = words
    table = dict(SMALLER[command])
    kept = []
    if "--resume" in rest:
        del table["--preset"]
    if "--tasks" in rest and rest[rest.index("--tasks") + 1].endswith(".json"):
        del table["--maps"], table["--max-steps"]  # The suite says both.
    if command == "train" and "my_map.yaml" in rest:
        table["--map"] = ["--map", "my_map.yaml"]
    while rest:
        option, *rest = rest
        if option not in table:
            kept.append(option)
            continue
        while rest and not rest[0].startswith("-"):
            rest.pop(0)
        kept += table.pop(option)
    put_in = ("--preset", "--episodes", "--max-steps", "--maps")
    return [command, *kept, *(word for name in put_in for word in table.get(name, []))]


@pytest.fixture
def _quick_and_coarse(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(style, "DPI", 40)
    with compiling_quickly():
        yield


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.usefixtures("_quick_and_coarse")
@pytest.mark.parametrize("page", [README, USAGE], ids=lambda page: page.stem)
def test_every_command_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_empty_room(tmp_path).rename(tmp_path / "my_map.yaml")
    assert main(["train", *TRAIN, "--run-dir", "runs/mine"]) == 0
    for number, line in enumerate(commands(page)):
        program, *words = shlex.split(line, comments=True)
        if program == "make" and words[0] == "train":
            words = ["train", *shlex.split(" ".join(words[1:]).removeprefix("ARGS="))]
        elif program != "sqn":
            continue
        if words[0] == "tasks" and words[1] != "generate":
            continue  # The benchmarks are not here; tests/tasks has some made by hand.
        words = smaller(words)
        if words[0] == "train" and "--resume" not in words:
            words = [w.replace("runs/mine", f"runs/mine_{number}") for w in words]
            if "--run-dir" not in words:
                words += ["--run-dir", f"runs/{number}"]
        assert main(words) == 0, (line, words, capsys.readouterr().err)
