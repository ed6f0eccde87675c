"""Export folders are whole, or refused by the name of the file."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from refusals import refusal
from rooms import write_empty_room
from tiny_policies import random_policy, tiny

from sqn_jax.cli import main
from sqn_jax.export import folder as folders
from sqn_jax.export.folder import FILES, SUMS, require_free, sums_text
from sqn_jax.policies.pretrained import write_policy

onnx = pytest.importorskip("onnx", reason="the extra `export` is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra `export` is not installed")

from sqn_jax.export.check import check_export  # noqa: E402


def sign(folder: Path) -> None:
    """List the digests of what is there now, as somebody would who covers up a change."""
    contents = {name: (folder / name).read_bytes() for name in FILES}
    (folder / SUMS).write_text(sums_text(contents))


def test_a_folder_agrees_with_itself(exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "--check", str(exported)]) == 0
    onnx_line, numpy_line = capsys.readouterr().out.splitlines()
    assert onnx_line.startswith("ONNX Runtime")
    assert numpy_line.startswith("NumPy")
    assert "of 400 (ties)" in onnx_line
    reference = np.load(exported / "reference.npz")
    assert reference["observations"].shape == (400, 9)
    assert reference["hidden"].shape == (401, 8)
    assert np.isinf(reference["observations"]).any()
    assert not np.isnan(reference["observations"]).any()
    # The two evaluation points of the room are 3.4 and 2.4 m apart.
    distance = reference["observations"][0, -2]
    assert distance == pytest.approx(np.hypot(3.4, 2.4), rel=1e-5)
    assert np.abs(reference["observations"][:, -1]).max() <= np.float32(np.pi)


def test_a_policy_that_hears_of_refused_moves_agrees_with_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It drives into a wall and goes on pushing."""
    policy = random_policy(tiny(motion_inputs=True, goal_distance_encoding="rational"))
    for skill in ("skill_0", "skill_1"):
        policy.params[0]["params"][skill]["output"]["bias"] = jnp.float32([0, 99, 0, 0, 0])
    write_policy(tmp_path, policy, {"evaluation": []})
    arguments = ["export", str(tmp_path / "tiny.npz"), "--out", str(tmp_path / "robot")]
    with compiling_quickly():
        assert main([*arguments, "--map", str(write_empty_room(tmp_path))]) == 0
    agreements = check_export(tmp_path / "robot")
    assert [agreement.other_actions for agreement in agreements] == [0, 0]
    reference = np.load(tmp_path / "robot" / "reference.npz")
    assert reference["observations"].shape == (400, 10)
    refused = reference["observations"][:, -1]
    assert refused[0] == 0
    assert set(refused[-100:]) == {1.0}
    np.testing.assert_array_equal(reference["hidden"][0], np.zeros(13))
    np.testing.assert_array_equal(reference["hidden"][1:, 8:], np.tile(np.eye(5)[1], (400, 1)))
    card = (tmp_path / "robot" / "README.md").read_text()
    assert "Inputs `obs` [1, 10]" in card
    assert "policy.act(ranges, distance, heading, hidden, refused)" in card
    assert "[1, 1, 13]" in card


@pytest.mark.parametrize("name", FILES)
def test_a_changed_file_is_named(changed: Path, name: str) -> None:
    with (changed / name).open("ab") as file:
        file.write(b" ")
    assert f"{name}: has changed" in refusal(lambda: check_export(changed))
    (changed / name).unlink()
    assert f"{name}: no such file" in refusal(lambda: check_export(changed))


def other_robot(folder: Path) -> None:
    model = onnx.load(folder / "policy.onnx")
    for entry in model.metadata_props:
        if entry.key == "max_range_m":
            entry.value = "5.0"
    onnx.save(model, folder / "policy.onnx")


def other_weights(folder: Path) -> None:
    model = onnx.load(folder / "policy.onnx")
    for array in model.graph.initializer:
        if array.name == "params/skill_1/output/bias":
            numbers = onnx.numpy_helper.to_array(array) + np.float32([0.1, 0, 0, 0, 0])
            array.CopyFrom(onnx.numpy_helper.from_array(numbers, array.name))
    onnx.save(model, folder / "policy.onnx")


def edit_config(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    description = json.loads((folder / "config.json").read_text())
    change(description)
    (folder / "config.json").write_text(json.dumps(description))


def other_speed(folder: Path) -> None:
    edit_config(folder, lambda data: data["config"]["env"].update(forward_speed=9.0))


def other_network(folder: Path) -> None:
    edit_config(folder, lambda data: data["config"]["network"].update(num_skills=2))


def unknown_setting(folder: Path) -> None:
    edit_config(folder, lambda data: data["config"]["env"].update(lidar_height=1.0))


def code(folder: Path) -> None:
    (folder / "sqn_policy.py").write_text("raise SystemExit('executed')\n")


def an_older_version(folder: Path) -> None:
    """It described its robot in fewer words."""
    code(folder)
    edit_config(folder, lambda data: data["robot"].pop("motion_inputs"))


def no_graph(folder: Path) -> None:
    (folder / "policy.onnx").write_bytes(b"\x0a" * 100)


def other_params(folder: Path) -> None:
    data = bytearray((folder / "params.safetensors").read_bytes())
    data[-4] ^= 1  # So little that no Q-value tells.
    (folder / "params.safetensors").write_bytes(data)


def other_actions(folder: Path) -> None:
    arrays = dict(np.load(folder / "reference.npz"))
    actions = arrays["q_values"].argmin(axis=1)
    np.savez(folder / "reference.npz", **(arrays | {"actions": actions}))


def short_rollout(folder: Path) -> None:
    arrays = dict(np.load(folder / "reference.npz"))
    np.savez(folder / "reference.npz", **(arrays | {"actions": arrays["actions"][:-1]}))


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (other_robot, "policy.onnx: is of another robot or policy: max_range_m is 5.0"),
        (other_weights, "ONNX Runtime: the Q-values of step 0 are"),
        (other_speed, "config.json: robot: commands_m_s_rad_s is"),
        (other_network, "params.safetensors: does not hold the"),
        (unknown_setting, "env.lidar_height is 1.0"),
        (code, "sqn_policy.py: is not that of this version"),
        (an_older_version, "expected an export of this version"),
        (no_graph, "policy.onnx: no sound ONNX file"),
        (other_params, "params.safetensors: is of another policy"),
        (other_actions, "reference.npz: action "),
        (short_rollout, "reference.npz: expected observations, hidden"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_was_changed_and_signed_is_refused(
    changed: Path, change: Callable[[Path], None], part: str
) -> None:
    change(changed)
    sign(changed)
    assert part in refusal(lambda: check_export(changed))


def test_only_an_export_is_replaced(exported: Path, changed: Path, tmp_path: Path) -> None:
    require_free(changed)
    require_free(tmp_path / "new")
    (tmp_path / "empty").mkdir()
    require_free(tmp_path / "empty")
    assert f"no {SUMS}" in refusal(lambda: require_free(Path(shutil.copytree(
        exported, tmp_path / "unsigned", ignore=shutil.ignore_patterns(SUMS)
    ))))  # fmt: skip
    (changed / "thesis.tex").write_text("precious")
    assert "holds thesis.tex" in refusal(lambda: require_free(changed))
    (tmp_path / "link").symlink_to(exported)
    assert "is no folder" in refusal(lambda: require_free(tmp_path / "link"))


def test_a_disk_that_fills_up_leaves_the_old_export(
    changed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in changed.iterdir()}
    written = []

    def write(path: Path, data: bytes) -> None:
        written.append(path)
        if len(written) == 3:
            raise OSError(28, "No space left on device", str(path))
        path.write_bytes(data)

    monkeypatch.setattr(folders, "write_whole", write)
    monkeypatch.setattr(folders, "export_contents", lambda *_: dict.fromkeys(before, b"new"))
    with pytest.raises(OSError, match="cannot be written"):
        folders.export_policy(random_policy(tiny()), changed)
    assert {path.name: path.read_bytes() for path in changed.iterdir()} == before
    assert [path.name for path in changed.parent.iterdir()] == ["robot"]
    monkeypatch.setattr(folders, "write_whole", lambda path, data: path.write_bytes(data))
    folders.export_policy(random_policy(tiny()), changed)
    assert {path.read_bytes() for path in changed.iterdir()} == {b"new"}


def test_a_move_that_fails_brings_the_old_export_back(
    changed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in changed.iterdir()}
    rename = Path.rename

    def move(path: Path, target: Path) -> Path:
        if path.name.endswith(".partial"):
            raise OSError(5, "Input/output error", str(path))
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", move)
    monkeypatch.setattr(folders, "write_whole", lambda path, data: path.write_bytes(data))
    monkeypatch.setattr(folders, "export_contents", lambda *_: dict.fromkeys(before, b"new"))
    with pytest.raises(OSError, match="cannot be written"):
        folders.export_policy(random_policy(tiny()), changed)
    assert {path.name: path.read_bytes() for path in changed.iterdir()} == before
    assert [path.name for path in changed.parent.iterdir()] == ["robot"]


def test_reference_rollouts_are_the_same_bytes_each_time(exported: Path) -> None:
    arrays = dict(np.load(exported / "reference.npz"))
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    assert file.getvalue() == (exported / "reference.npz").read_bytes()
