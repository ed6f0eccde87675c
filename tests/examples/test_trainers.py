"""The trainers of others, at a size that shows that they run."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest
from compiling import compiling_quickly

SMALL = ["--max-steps", "8", "--num-envs", "4", "--rollout-steps", "8", "--eval-episodes", "2"]


def run(name: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with compiling_quickly():
        importlib.import_module(name).main()


@pytest.mark.parametrize("name", ["purejaxrl_ppo", "sb3_recurrent_ppo"])
def test_a_trainer_writes_its_curve(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = [*SMALL, "--steps", "128"]
    if name == "sb3_recurrent_ppo":
        pytest.importorskip("sb3_contrib", reason="needs the extra sb3, which is not part of dev")
        arguments += ["--eval-every", "2"]
    else:
        arguments += ["--eval-points", "2"]
    out = tmp_path / "curve.json"
    run(name, [*arguments, "--out", str(out)], monkeypatch)
    curve = json.loads(out.read_text())["curve"]
    assert [row["env_steps"] for row in curve] == [0, 64, 128]
    assert [row["episodes"] for row in curve] == [0, 8, 16]
    for row in curve:
        assert 0 <= row["eval_success"] <= 1
        assert -0.2 <= row["eval_mean_reward"] < 60


def test_what_is_unusable_is_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, fault in (
        (["--out", str(tmp_path)], f"purejaxrl_ppo: {tmp_path}: "),
        (["--out", str(tmp_path / "no" / "a.json")], f"purejaxrl_ppo: {tmp_path}/no/a.json: "),
        (["--map", "nowhere"], "purejaxrl_ppo: unknown map 'nowhere'"),
        (["--steps", "5"], "purejaxrl_ppo: --steps 5 are 0 updates, expected at least"),
    ):
        with pytest.raises(SystemExit) as stopped:
            run("purejaxrl_ppo", arguments, monkeypatch)
        assert stopped.value.code == 2
        assert capsys.readouterr().err.startswith(fault)
