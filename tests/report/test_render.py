"""`sqn render` as a user meets it: what it writes, and what it says of words it cannot use."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from compiling import compiling_quickly
from PIL import Image
from rooms import random_params, small_room, write_empty_room

from sqn_jax.agent import make_network
from sqn_jax.cli import main
from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig
from sqn_jax.env import NUM_ACTIONS
from sqn_jax.policies import pretrained
from sqn_jax.policies.run_policies import Policy
from sqn_jax.report.render import agent_names, default_folder
from sqn_jax.report.render_suite import worst_tasks

STEPS = 12
BEAMS = 11  # Few compile sooner.
TINY = TrainConfig(network=NetworkConfig(hidden_size=8), env=EnvConfig(num_beams=BEAMS))


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two policies that were never trained."""
    folder = tmp_path_factory.mktemp("weights")
    room = small_room(STEPS, num_beams=BEAMS)
    for seed, name in enumerate(("one", "two")):
        params = random_params(make_network(TINY.algo, TINY.network, NUM_ACTIONS), room, seed)
        pretrained.write_policy(folder, Policy(name, TINY, (params,)), {})
    return folder


@pytest.fixture(autouse=True)
def _pretrained(monkeypatch: pytest.MonkeyPatch, weights: Path, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setattr(pretrained, "_folder", lambda: weights)
    monkeypatch.chdir(tmp_path)
    with compiling_quickly():
        yield


def test_every_agent_gets_its_films_and_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = write_empty_room(tmp_path)
    words = ["pretrained:one", "pretrained:two", "--map", str(room), "--max-steps", str(STEPS)]
    words += ["--episodes", "2", "--animations", "1", "--out", "deep/pictures"]
    assert main(["render", *words]) == 0
    written = sorted(path.name for path in Path("deep/pictures").iterdir())
    assert written == [
        "sqn_one_episode_1.gif",
        "sqn_one_timeline_1.png",
        "sqn_two_episode_1.gif",
        "sqn_two_timeline_1.png",
        "trajectories.png",
    ]
    lines = capsys.readouterr().out.splitlines()
    said = {line.split()[1] for line in lines if line.startswith("wrote ")}
    assert said == {f"deep/pictures/{name}" for name in written}
    films = []
    for agent in ("one", "two"):
        with Image.open(f"deep/pictures/sqn_{agent}_episode_1.gif") as film:
            assert film.n_frames <= STEPS + 1
            films.append(np.asarray(film.convert("RGB")).astype(int))
    same = np.abs(films[0] - films[1]).max(axis=-1) < 24
    # Before the first step both stand in the same place and have the same goal: a room of 5 x 4 m
    # fills 496 x 397 pixels. Their names differ.
    assert same[94:488, 14:506].mean() > 0.999
    assert not same[:40].all()


def test_one_agent_writes_below_the_current_folder(tmp_path: Path) -> None:
    room = write_empty_room(tmp_path)
    words = ["pretrained:one", "--map", str(room), "--max-steps", str(STEPS)]
    assert main(["render", *words, "--episodes", "2", "--animations", "0"]) == 0
    written = sorted(path.name for path in (tmp_path / "renders" / "one_room").iterdir())
    assert written == ["sqn_timeline_1.png", "trajectories.png"]


def test_the_worst_tasks_have_the_least_success_of_all_agents_then_the_least_spl() -> None:
    def entry(*tasks: tuple[float, float]) -> dict[str, list[dict[str, float]]]:
        return {"tasks": [{"success": success, "spl": spl} for success, spl in tasks]}

    one, other = entry((1, 0.9), (1, 0.2), (0, 0), (1, 0.5)), entry((1, 1), (1, 1), (0, 0), (0, 0))
    assert worst_tasks({"results": [one, other]}, 3) == [2, 3, 1]
    assert worst_tasks({"results": [one]}, 9) == [2, 1, 3, 0]


def test_tasks_of_a_suite_are_drawn_by_number_at_random_actions(tmp_path: Path) -> None:
    room = write_empty_room(tmp_path)
    places = [((0.8, 0.8), (4.2, 3.2)), ((4.2, 3.2), (0.8, 0.8)), ((0.8, 3.2), (4.2, 0.8))]
    suite = tmp_path / "rooms.json"
    tasks = [
        {"map": room.name, "start": [*start, 0.0], "goal": goal, "max_steps": STEPS}
        for start, goal in places
    ]
    suite.write_text(json.dumps({"schema": 1, "name": "rooms", "tasks": tasks}))
    words = ["pretrained:one", "pretrained:two", "--tasks", str(suite), "--pick", "2", "0"]
    assert main(["render", *words, "--animations", "0", "--epsilon", "0.5"]) == 0
    written = sorted(path.name for path in Path("renders/one_and_1_more_rooms").iterdir())
    assert written == [
        "sqn_one_epsilon_0.5_timeline_2.png",
        "sqn_two_epsilon_0.5_timeline_2.png",
        "trajectories.png",
    ]


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["--pick", "1"], "--pick 1: only with --tasks FILE.json"),
        (["--tasks", "S.json", "--map", "maze"], "--map: not with --tasks S.json"),
        (["--tasks", "S.json", "--max-steps", "3"], "--max-steps: not with --tasks S.json"),
        (["--tasks", "S.json", "--pick", "worst", "1"], "--pick worst 1: expected worst alone"),
        (["--tasks", "S.json", "--pick", "-1"], "'-1', expected the number of a task or worst"),
        (["--tasks", "S.json", "--pick", "x"], "'x', expected the number of a task or worst"),
        (["--tasks", "S.json", "--pick", "1", "--episodes", "2"], "--episodes: not with --pick 1"),
        (["--tasks", "S.json", "--pick", "1"], "--pick 1: expected 0 to 0"),
        (["--tasks", "S.json", "--pick", "0", "0"], "--pick 0: comes twice"),
        (["--tasks", "S.json", "--animations", "5"], "animations is 5, expected 0 to the 4"),
        (["--tasks", "none.json"], "none.json: no such file"),
        (["--epsilon", "1.5"], "epsilon is 1.5"),
        (["--params", "target"], "has no target parameters"),
    ],
)
def test_wrong_words_about_tasks_are_named_in_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], fault: str
) -> None:
    tasks = [{"map": "maze", "start": [0, 0, None], "goal": [2, 2]}]
    (tmp_path / "S.json").write_text(json.dumps({"schema": 1, "name": "S", "tasks": tasks}))
    assert main(["render", "pretrained:one", *words]) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["S.json"]


def test_agents_of_one_network_are_told_apart_by_their_runs() -> None:
    one, two, other = (
        Policy(name, dataclasses.replace(TINY, algo=algo), ())
        for name, algo in (("a", "sqn"), ("b", "sqn"), ("c", "dqn"))
    )
    assert list(agent_names([one, two, other])) == ["SQN a", "SQN b", "DQN"]
    accented = [Policy(name, one.config, ()) for name in ("a/run", "\u00e9", "\u00e8", "a_run")]
    names = list(agent_names(accented))
    assert names == ["SQN a/run", "SQN \u00e9", "SQN \u00e8", "SQN a_run (2)"]
    with pytest.raises(ValueError, match="6 policies to render, expected 1 to 5"):
        agent_names([one] * 6)
    several = Policy("s", dataclasses.replace(TINY, seed=7, num_seeds=2), (1, 2))
    assert list(agent_names([several])) == ["SQN seed 7"]
    assert default_folder([one], "maze") == Path("renders/a_maze")
    assert default_folder([one, two, other], "my/maps/attic.yaml") == Path(
        "renders/a_and_2_more_attic"
    )


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ([], ["name a run folder", "pretrained:NAME"]),
        (["nowhere"], ["nowhere", "holds no run"]),
        (["pretrained:three"], ["pretrained:three", "pretrained:one", "pretrained:two"]),
        (["pretrained:one", "pretrained:one"], ["one", "twice"]),
        (["pretrained:one", "--map", "nowhere"], ["nowhere", "maze"]),
        (["pretrained:one", "--episodes", "0"], ["episodes", "0", "1 to 32"]),
        (["pretrained:one", "--animations", "5"], ["animations", "5", "4 episodes"]),
        (["pretrained:one", "--tasks", "all"], ["--tasks", "points", "pairs"]),
        (["pretrained:one", "--range-noise", "-1"], ["noise", "-1"]),
        (["pretrained:one", "--max-steps", "-1"], ["max_steps", "-1"]),
        (["pretrained:one", "--out", ""], ["--out", "empty"]),
        (["pretrained:one", "--out", "/proc/films"], ["/proc/films", "cannot be written"]),
        (["pretrained:one", "--frames", "3"], ["--frames"]),
    ],
)
def test_wrong_words_of_render_are_named_in_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], names: list[str]
) -> None:
    assert main(["render", *words]) == 2
    output = capsys.readouterr()
    assert output.err.startswith("sqn: ")
    assert output.err.count("\n") == 1, output.err
    for name in names:
        assert name in output.err, (name, output.err)
    assert output.out == ""
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_place_of_the_folder_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "taken").touch()
    assert main(["render", "pretrained:one", "--out", "taken"]) == 2
    assert "folder taken: cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("missing", "extra"), [("matplotlib", "sqn_jax[viz]"), ("imageio_ffmpeg", "sqn_jax[video]")]
)
def test_a_missing_library_is_one_line_with_the_name_of_the_extra(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    missing: str,
    extra: str,
) -> None:
    import sqn_jax
    from sqn_jax import report

    ours = ("sqn_jax.report.render", "sqn_jax.figures")
    for module in [name for name in sys.modules if name.startswith((*ours, f"{missing}."))]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.delattr(report, "render", raising=False)
    monkeypatch.delattr(sqn_jax, "figures", raising=False)
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(["render", "pretrained:one", "--mp4"]) == 2
    stderr = capsys.readouterr().err
    assert extra in stderr
    assert stderr.count("\n") == 1, stderr


def test_evaluate_takes_pretrained_policies_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "pretrained:three"]) == 2
    assert "expected one of pretrained:one" in capsys.readouterr().err
    # Found, and so it is the map that is at fault.
    assert main(["evaluate", "pretrained:two", "--maps", "nowhere"]) == 2
    assert capsys.readouterr().err.startswith("sqn: unknown map 'nowhere'")
