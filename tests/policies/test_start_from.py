"""A run that starts from a trained policy has its parameters, and only one it can take."""

from __future__ import annotations

import dataclasses
import importlib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from tiny_runs import TinyRuns

from sqn_jax.cli import main
from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.policies.pretrained import write_policy
from sqn_jax.policies.run_policies import Policy, load_policy, require_same_network
from sqn_jax.runs.train import _starting_policy
from sqn_jax.training.state import params_shapes

same = partial(np.testing.assert_allclose, rtol=0, atol=1e-20)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> TinyRuns:
    runs = TinyRuns(tmp_path_factory.mktemp("runs"), chunks=2)
    code, _, err = runs.call("first")
    assert code == 0, err
    return runs


def test_a_run_starts_where_the_other_ended(
    runs: TinyRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With steps too small to count it ends there, too, whatever its own seed; for every seed of
    several, and named by a path from where it was started."""
    monkeypatch.chdir(runs.folder)
    still = ["--seed", "5", "--learner.learning-rate", "1e-30", "--start-from", "first"]
    code, out, err = runs.call("second", *still, "--num-seeds", "2")
    assert code == 0, err
    assert f"starting from {runs.folder / 'first'}" in out
    (expected,) = load_policy(runs.folder / "first").params
    for found in load_policy(runs.folder / "second").params:
        jax.tree.map(same, found, expected)
    monkeypatch.chdir("/")
    code, out, err = runs.call("second", "--total-episodes", "12", resume=True)
    assert code == 0, err
    jax.tree.map(same, load_policy(runs.folder / "second").params[1], expected)


def test_it_learns_on_from_there(runs: TinyRuns) -> None:
    code, _, err = runs.call("third", "--start-from", str(runs.folder / "first"))
    assert code == 0, err
    (before,) = load_policy(runs.folder / "first").params
    (after,) = load_policy(runs.folder / "third").params
    moves = jax.tree.map(lambda x, y: float(np.abs(x - y).max()), before, after)
    assert all(move > 0 for move in jax.tree.leaves(moves))
    assert max(jax.tree.leaves(moves)) < 0.1  # A few updates, not another beginning.


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--algo", "r2d2"], "its algo is sqn, here it is r2d2"),
        (
            ["--network.hidden-size", "16"],
            "its network.hidden_size is 8, here it is 16 (--network.hidden-size)",
        ),
        (["--env.num-beams", "31"], "its env.num_beams is 71, here it is 31"),
        (["--env.heading-encoding", "sincos"], "its env.heading_encoding is linear, here"),
        (["--env.goal-distance-encoding", "rational"], "its env.goal_distance_encoding is clipped"),
    ],
)
def test_another_network_is_refused_before_anything_is_written(
    words: list[str], told: str, runs: TinyRuns
) -> None:
    code, _, err = runs.call("refused", *words, "--start-from", str(runs.folder / "first"))
    assert code == 2
    assert told in err
    assert err.count("\n") == 1
    assert not Path(runs.folder / "refused").exists()


def test_a_run_with_motion_inputs_starts_from_a_policy_without(runs: TinyRuns) -> None:
    """But not the other way round."""
    policy = load_policy(runs.folder / "first")
    network = dataclasses.replace(policy.config.network, motion_inputs=True)
    config = dataclasses.replace(
        policy.config, network=network, start_from=str(runs.folder / "first")
    )
    start = _starting_policy(config)
    assert start is not None
    assert jax.tree.map(lambda x: x.shape, start.params[0]) == jax.tree.map(
        lambda x: x.shape, params_shapes(config)
    )
    with pytest.raises(ValueError, match=r"its network\.motion_inputs is True, here it is False"):
        require_same_network(start, policy.config)


def test_what_is_no_policy_is_refused(runs: TinyRuns) -> None:
    for start, told in (("nowhere", "holds no run"), ("pretrained:nobody", "no such policy")):
        code, _, err = runs.call("refused", "--start-from", start)
        assert code == 2
        assert told in err
        assert not (runs.folder / "refused").exists()


def test_agent_network_and_what_it_sees_are_those_of_the_policy_where_none_are_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(
        algo="r2d2",
        env=EnvConfig(
            num_beams=31,
            goal_distance_encoding="rational",
            goal_distance_scale=7.0,
            max_goal_distance=60.0,
        ),
        network=NetworkConfig(hidden_size=8, motion_inputs=True),
    )
    params = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), params_shapes(config))
    write_policy(tmp_path, Policy("mine", config, (params,)), {})
    started: list[TrainConfig] = []

    def note(config: TrainConfig, *_: Any) -> int:
        started.append(config)
        return 0

    monkeypatch.setattr(importlib.import_module("sqn_jax.cli.train"), "_run_training", note)
    start = ["train", "--start-from", str(tmp_path / "mine.npz")]
    assert main([*start, "--env.max-range", "4"]) == 0
    assert main([*start, "--preset", "paper", "--network.hidden-size", "16"]) == 0
    assert main([*start, "--env.goal-distance-scale", "9"]) == 0
    quick, paper, scaled = started
    found = (quick.algo, quick.network, quick.env.num_beams, quick.env.goal_distance_encoding)
    assert found == ("r2d2", config.network, 31, "rational")
    assert (quick.env.goal_distance_scale, quick.env.max_goal_distance) == (7.0, 60.0)
    assert quick.env.max_range == 4.0
    assert quick.learner == PRESETS["quick"].learner
    assert (paper.network.hidden_size, paper.network.motion_inputs) == (16, True)
    assert _starting_policy(quick) is not None
    assert scaled.env.goal_distance_scale == 9.0
    assert _starting_policy(scaled) is not None
    with pytest.raises(ValueError, match=r"its network\.hidden_size is 8, here it is 16"):
        _starting_policy(paper)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[]", "lacks config"),
        ('{"config": 5}', "config is 5"),
        ('{"config": {"map": "nope:::"}}', "nope:::"),
        ('{"config"', "JSON"),
    ],
)
def test_settings_that_cannot_be_read_are_named(
    text: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.json").write_text(text)
    assert main(["train", "--start-from", str(tmp_path / "mine.npz")]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "mine.npz: cannot be read (" in line
    assert told in line
