"""The report as a file: what it says of a run; it needs nothing beside it."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from compiling import compiling_quickly
from report_parts import Page, evil_content, needs_nothing
from rooms import write_empty_room

from sqn_jax.cli import main
from sqn_jax.config import Algorithm, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import make_env
from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.maps import load_map
from sqn_jax.policies.run_policies import Policy
from sqn_jax.report import read_runs
from sqn_jax.report.content import Run
from sqn_jax.report.pictures import curves
from sqn_jax.storage.checkpoint import Checkpoints
from sqn_jax.storage.manifest import Origin
from sqn_jax.storage.run_folder import RunFolder
from sqn_jax.training.loop import make_program, start_run


@pytest.fixture(scope="module")
def room_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write_empty_room(tmp_path_factory.mktemp("map"))
    path.write_text(path.read_text() + "max_steps: 30\n")
    return path


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory, room_file: Path) -> Iterator[Path]:
    """A run as it stands before its first update, called as a formula that cannot be set."""
    path = tmp_path_factory.mktemp("runs") / "$x^$<b>"
    smoke = PRESETS["smoke"]
    config = dataclasses.replace(
        smoke,
        map=str(room_file),
        network=dataclasses.replace(smoke.network, hidden_size=8),
        env=dataclasses.replace(smoke.env, max_steps=0),
    )
    folder = RunFolder.create(path, config)
    with compiling_quickly():
        world = make_env(load_map(room_file), config.env)
        runner = start_run(make_program(world, config))
        with Checkpoints(path, Origin(config)) as checkpoints:
            checkpoints.save(1, runner)
        for chunk in (1, 2):
            usage = {"gate_entropy": 0.6 / chunk, "skill_usage": [0.5, 0.5]}
            folder.append_metrics(
                {
                    "chunk": chunk,
                    "episodes": 32 * chunk,
                    "mean_reward": 0.1,
                    "success": 0.5,
                    **usage,
                }
            )
        yield path


def begins_with_the_worst(html: str, page: Page, links: list[str]) -> None:
    """The page beside a report has the task of its first episode; its links say those of all."""
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', html)
    assert data is not None
    task = json.loads(data[1])["task"]
    places = re.findall(r"from \((.*?), (.*?)\) m to the goal at \((.*?), (.*?)\) m", page.text)
    assert len(places) == len(links) == 2
    begun = [*task["start"][:2], *task["goal"]]
    assert [f"{value:.1f}" for value in begun] == list(places[0])
    for link, place in zip(links, places, strict=True):
        file, _, fields = link.partition("#")
        assert file == "my%201-play.html"
        numbers = dict(field.split("=") for field in fields.split("&"))
        assert numbers["map"] in html
        said = [*numbers["start"].split(",")[:2], *numbers["goal"].split(",")]
        assert [f"{float(value):.1f}" for value in said] == list(place)


def test_a_report_on_a_run_is_the_same_twice_and_says_what_an_evaluation_says(
    run_dir: Path, room_file: Path, tmp_path: Path
) -> None:
    arguments = [str(run_dir), "--episodes", "2", "--eval-seeds", "1", "--epsilon", "0.5"]
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert main(["report", *arguments, "--out", str(tmp_path / name / "my 1.html")]) == 0
    files = ["my 1-play.html", "my 1.html"]
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == files
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    html = (tmp_path / "a" / "my 1.html").read_text(encoding="utf-8")
    page = Page(html)
    links = [str(attributes["href"]) for tag, attributes in page.tags if tag == "a"]
    needs_nothing(page, *links)
    plays = (tmp_path / "a" / "my 1-play.html").read_text(encoding="utf-8")
    begins_with_the_worst(plays, page, links)
    images = page.images()
    # Two worst, the learning curve, the paths, the animation.
    assert [image.format for image in images] == ["PNG"] * 4 + ["GIF"]
    assert getattr(images[-1], "n_frames", 1) > 1
    found = tmp_path / "found.json"
    arguments += ["--maps", str(room_file), "--goal-radius", "0.3"]
    assert main(["evaluate", *arguments, "--out", str(found)]) == 0
    sqn = "sqn, epsilon 0.5"
    for name, row in ((sqn, sqn), ("oracle", "oracle (knows the map)")):
        own = next(
            each for each in json.loads(found.read_text())["results"] if each["agent"] == name
        )
        success, steps = page.row(row)
        assert success.startswith(f"{own['success']['mean']:.2f} [")
        assert steps == f"{own['time_steps']['mean']:.1f}"
    assert run_dir.name in page.text
    assert "2 episodes of each trained seed" in page.text
    assert "each action drawn at random with probability 0.5" in page.text


def test_one_run_has_its_curves_several_are_compared_and_one_without_metrics_has_none() -> None:
    def run(name: str, algo: Algorithm, rows: int, **without: Any) -> Run:
        row = {"mean_reward": 0.1, "success": 0.5, "gate_entropy": 0.6, "skill_usage": [0.5, 0.5]}
        remaining = {key: value for key, value in row.items() if key not in without}
        metrics = [{"episodes": 32 * chunk, **remaining} for chunk in range(1, rows + 1)]
        return Run(name, Policy(name, TrainConfig(algo=algo), ({},)), metrics, {})

    def count(*runs: Run) -> int:
        agents = [TrainedAgent(run.policy.config.algo, (run.policy,)) for run in runs]
        found = curves(dataclasses.replace(evil_content(), runs=list(runs), agents=agents))
        assert all(each.data.startswith(b"\x89PNG") for each in found)
        return len(found)

    formula = run("$x^$", "sqn", 3)
    assert count(formula) == 1
    assert count(formula, run("b", "dqn", 2)) == 2  # One has no skill decision.
    assert count(run("a", "sqn", 2, gate_entropy=True), run("b", "dqn", 2)) == 1
    assert count(formula, run("pretrained:b", "dqn", 0)) == 1
    assert count(run("pretrained:b", "sqn", 0)) == 0


def test_folders_of_the_same_name_are_told_apart(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def found(word: str, *_: int | str) -> Policy:
        return Policy(Path(word).name, TrainConfig(), ({},))

    monkeypatch.setattr("sqn_jax.report.content.find_policy", found)
    folders = [str(tmp_path / name) for name in ("a/run", "b/run", "other")]
    for folder in folders:
        RunFolder.create(Path(folder), TrainConfig())
    assert [run.name for run in read_runs(folders)] == [*folders[:2], "other"]


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ([], ["nothing to report on", "run folder"]),
        (["nowhere"], ["nowhere", "holds no run"]),
        (["pretrained:nobody"], ["pretrained:nobody", "no such policy"]),
        (["nowhere", "--out", "page.htm"], ["--out", "page.htm", ".html"]),
        (["nowhere", "--out", "no/such/page.html"], ["--out", "existing folder"]),
        (["nowhere", "--out", "/proc/page.html"], ["/proc/page.html", "cannot be written"]),
        (["RUN", "--maps", "nowhere"], ["nowhere", "maze"]),
        (["RUN", "RUN"], ["the same training seed twice"]),
        (["RUN", "--episodes", "0"], ["episodes", "0", "at least 1"]),
        (["RUN", "--tasks", "all"], ["--tasks", "points", "pairs"]),
        (["RUN", "--epsilon", "2"], ["epsilon is 2.0", "at most 1"]),
        (["RUN", "--params", "target"], ["--params target", "has no target"]),
    ],
)
def test_wrong_words_of_report_are_named_in_one_line(
    capsys: pytest.CaptureFixture[str],
    run_dir: Path,
    tmp_path: Path,
    words: list[str],
    names: list[str],
) -> None:
    capsys.readouterr()
    out = [] if "--out" in words else ["--out", str(tmp_path / "page.html")]
    assert main(["report", *[str(run_dir) if w == "RUN" else w for w in words], *out]) == 2
    stderr = capsys.readouterr().err
    assert stderr.startswith("sqn: ")
    assert stderr.count("\n") == 1, stderr
    for name in names:
        assert name in stderr, (name, stderr)
    assert list(tmp_path.iterdir()) == []
