"""The options of `sqn train`: one for every setting, and one listing of all."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sqn_jax import config as configs
from sqn_jax.cli import main, settings
from sqn_jax.config import TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.storage.run_folder import RunFolder


def leaves(cls: type = TrainConfig, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and type of every setting."""
    for name, hint in typing.get_type_hints(cls).items():
        if dataclasses.is_dataclass(hint):
            yield from leaves(typing.cast(type, hint), f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", hint


LEAVES = dict(leaves())
OWN = [
    *("--help", "--preset", "--run-dir", "--resume", "--device", "--num-devices"),
    *("--distributed", "--coordinator", "--num-processes", "--process-id", "--process-timeout"),
    "--tensorboard",
]


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[tuple[TrainConfig, Path, argparse.Namespace]]:
    """What runs were started with; none is trained."""
    calls: list[tuple[TrainConfig, Path, argparse.Namespace]] = []

    def note(config: TrainConfig, run_dir: Path, given: argparse.Namespace) -> int:
        calls.append((config, run_dir, given))
        return 0

    # The package has a function of the same name.
    monkeypatch.setattr(importlib.import_module("sqn_jax.cli.train"), "_run_training", note)
    return calls


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that `sqn train` refuses arguments with."""
    assert main(["train", *arguments]) == 2
    message = capsys.readouterr().err
    assert message.startswith("sqn: ")
    assert message.count("\n") == 1
    return message


@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_help_lists_every_option_with_its_description_and_the_default_of_the_preset(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    for arguments, preset in [([], "quick"), (["--preset", "paper"], "paper")]:
        assert main(["train", "--help", *arguments]) == 0
        text = capsys.readouterr().out
        assert max(map(len, text.splitlines())) <= width
        entries = dict(re.findall(r"^  (?:-h, )?(--[\w.-]+)(.*?)(?=\n  -|\n\n)", text, re.M | re.S))
        names = [f"--{name.replace('_', '-')}" for name in LEAVES]
        assert list(entries) == OWN + names
        defaults = configs.flat(configs.to_dict(PRESETS[preset]))
        for name, option in zip(LEAVES, names, strict=True):
            entry = " ".join(entries[option].split())
            shown = repr(defaults[name]) if LEAVES[name] is str else defaults[name]
            assert entry.endswith(f" (default: {shown})"), (option, entry)
            assert len(entry) > len(f"TEXT (default: {shown})") + 10, (option, entry)
        assert "(paper sections III-A" in " ".join(text.split())


def test_every_setting_is_an_option_with_dashes_or_underscores(
    started: list[tuple[TrainConfig, Path, argparse.Namespace]],
) -> None:
    preset = configs.flat(configs.to_dict(PRESETS["quick"]))
    for name, hint in LEAVES.items():
        old = preset[name]
        group, dot, field = name.rpartition(".")
        if hint is bool:
            options = [f"--{group}{dot}{'no-' if old else ''}{field}"]
            new: Any = not old
        elif typing.get_origin(hint) is typing.Literal:
            new = next(choice for choice in typing.get_args(hint) if choice != old)
            options = [f"--{name}={new}"]
        elif hint is str:
            new = "pretrained:sqn" if name == "start_from" else "cave"
            options = [f"--{name}", new]
        else:
            new = old * 2 if hint is int and old else old / 2 if old else 1
            options = [f"--{name}", str(new)]
        if name == "method":  # Whose own setting has to fit.
            options += ["--replay.capacity", "256"]
        option, *value = options[0].partition("=")
        for spelled in (options[0], "".join([option.replace("_", "-"), *value])):
            assert main(["train", spelled, *options[1:]]) == 0, name
            config, _, _ = started.pop()
            assert configs.flat(configs.to_dict(config))[name] == new
            changed = {name} | ({"replay.capacity"} if name == "method" else set())
            found = configs.flat(configs.to_dict(config))
            assert {each for each in found if found[each] != preset[each]} == changed


def test_own_options_reach_the_run(
    started: list[tuple[TrainConfig, Path, argparse.Namespace]],
) -> None:
    assert main(["train", "--run_dir", "my_runs/a_b", "--num_devices", "2", "--device", "cpu"]) == 0
    config, run_dir, given = started.pop()
    assert config == PRESETS["quick"]
    assert run_dir == Path("my_runs/a_b")
    assert (given.num_devices, given.device, given.tensorboard) == (2, "cpu", False)
    assert main(["train", "--map", "x_y/my_map.yaml,maze:0-2", "--tensorboard"]) == 0
    config, run_dir, given = started.pop()
    assert config.map == "x_y/my_map.yaml,maze:0-2"
    assert re.fullmatch(r"runs/[\d_-]+_sqn_my_map_maze_0-2_quick_seed0", str(run_dir))
    assert given.tensorboard
    assert main(["train", "--preset", "best", "--seed=3", "--seed", "4"]) == 0
    assert started.pop()[0] == dataclasses.replace(PRESETS["best"], seed=4)


def test_runs_that_start_in_one_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    new_folder = importlib.import_module("sqn_jax.cli.train")._new_folder
    with new_folder(Path("runs/a")) as first:
        pass
    assert not Path("runs").exists()
    with new_folder(Path("runs/a")) as first, new_folder(Path("runs/a")) as second:
        (first / "config.json").touch()
        with new_folder(Path("runs/a")) as third:
            assert [str(path) for path in (first, second, third)] == [
                "runs/a",
                "runs/a_2",
                "runs/a_3",
            ]
    assert [path.name for path in Path("runs").iterdir()] == ["a"]


@pytest.mark.parametrize("value", ["-1", "-1e-3", "-.5"])
def test_a_negative_number_is_a_value(
    started: list[tuple[TrainConfig, Path, argparse.Namespace]], value: str
) -> None:
    assert main(["train", "--env.reward-time", value]) == 0
    assert started.pop()[0].env.reward_time == float(value)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--learner.n-stepp", "3"], ["--learner.n-stepp", "did you mean --learner.n-step?"]),
        (["--n-step", "3"], ["did you mean --learner.n-step?"]),
        (["--total-episode", "3"], ["did you mean --total-episodes?"]),
        (["--see", "3"], ["unrecognized", "--see"]),
        (["--no-env.mirror"], ["did you mean --randomization.no-mirror?"]),
        (["--learner.no-double-qq"], ["did you mean --learner.no-double-q?"]),
        (["--no-tensorboard"], ["unrecognized arguments: --no-tensorboard\n"]),
        (["--num-envs", "1_0"], ["--num-envs", "'1_0'", "integer"]),
        (["--num-envs", "\u0661\u0662"], ["--num-envs", "integer"]),
        (["--total-episodes", "1e18"], ["--total-episodes", "'1e18'", "integer"]),
        (["--learner.learning-rate", "1_0e-5"], ["--learner.learning-rate", "number"]),
        (["--env.max-range", "\u0663"], ["--env.max-range", "number"]),
        (["maze"], ["unrecognized", "maze"]),
        (["--map"], ["--map", "expected one argument"]),
        (["--learner.double-q", "yes"], ["unrecognized", "yes"]),
        (["--network.layer-norm=yes"], ["--network.layer-norm", "yes"]),
        (["--num-envs", "2.5"], ["--num-envs", "2.5", "int"]),
        (["--env.max-range", "-inf"], ["env.max_range", "-inf", "positive"]),
        (["--learner.learning-rate-schedule", "cosine"], ["cosine", "constant", "linear"]),
        (["--map", "ocean:3"], ["map 'ocean:3'", "maze, column, forest, cave"]),
        (["--map", "maze*0,maze:1"], ["map 'maze*0'", "1 to 100"]),
        (["--map", "maze:3-1"], ["map 'maze:3-1'", "FIRST-LAST"]),
        (["--map", "maze,"], ["map 'maze,'", "missing"]),
        (["--num-devices", "two"], ["--num-devices", "two"]),
    ],
)
def test_a_wrong_option_is_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], parts: list[str]
) -> None:
    message = refused(capsys, *arguments)
    for part in parts:
        assert part in message


def test_resume_takes_the_settings_from_the_folder_and_says_so(
    capsys: pytest.CaptureFixture[str],
    started: list[tuple[TrainConfig, Path, argparse.Namespace]],
    tmp_path: Path,
) -> None:
    saved = dataclasses.replace(PRESETS["smoke"], seed=5, map="maze:1,maze:2")
    RunFolder.create(tmp_path / "run", saved)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["map"] == "maze:1-2"
    resume = ["--resume", "--run-dir", str(tmp_path / "run")]
    assert main(["train", *resume]) == 0
    assert started.pop()[0] == saved
    more = ["--total_episodes", "960", "--device", "cpu", "--num-devices", "1", "--tensorboard"]
    assert main(["train", *resume, *more]) == 0
    config, _, given = started.pop()
    assert config == dataclasses.replace(saved, total_episodes=960)
    assert (given.resume, given.device, given.num_devices, given.tensorboard) == (
        *(True, "cpu", 1, True),
    )
    for excess, named in (
        (["--seed", "5"], "--seed 5"),
        (["--learner.no_double_q"], "--learner.no-double-q"),
        (["--preset", "smoke"], "--preset smoke"),
        (["--bogus", "1"], "--bogus 1"),
        (["extra"], "extra"),
    ):
        message = refused(capsys, *resume, "--total-episodes", "960", *excess)
        assert "--run-dir, --total-episodes, --device, --num-devices and --tensorboard" in message
        assert message.endswith(f" and --tensorboard, got {named}\n")
    assert not started


def test_a_field_is_described_by_the_docstring_below_it() -> None:
    described = settings.field_docstrings(configs.LearnerConfig)
    assert described["n_step"] == "r2d2: steps of reward before the bootstrap."
    assert set(described) == set(typing.get_type_hints(configs.LearnerConfig))
