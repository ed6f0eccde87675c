"""What an export says of its robot, its parameters, and the command."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from flax import traverse_util
from refusals import refusal
from tiny_policies import random_policy, tiny

from sqn_jax.cli import main
from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig, to_public_dict
from sqn_jax.export import folder as folders
from sqn_jax.export import sqn_policy
from sqn_jax.export.description import KNOWN_SETTINGS, require_exportable
from sqn_jax.export.model_card import Result, model_card, results_of
from sqn_jax.export.safetensors_file import from_safetensors, to_safetensors
from sqn_jax.policies.run_policies import Policy, of_seed

onnx = pytest.importorskip("onnx", reason="the extra `export` is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra `export` is not installed")


def test_the_graph_describes_its_robot(exported: Path) -> None:
    model = onnx.load(exported / "policy.onnx")
    described = {entry.key: entry.value for entry in model.metadata_props}
    angles = json.loads(described["beam_angles_rad"])
    np.testing.assert_allclose(np.degrees(angles), [-135, -90, -45, 0, 45, 90, 135])
    assert json.loads(described["commands_m_s_rad_s"])[2] == [-1.25, 0.0]
    assert json.loads(described["robot_radius_m"]) == 0.1
    assert "right to left" in described["beam_order"]
    params = (exported / "params.safetensors").read_bytes()
    assert described["params_sha256"] == hashlib.sha256(params).hexdigest()


def test_every_setting_of_robot_and_network_is_known_or_refused_by_name() -> None:
    """One that is new stands in neither list: whoever adds it decides here."""
    refused = {
        NetworkConfig: {
            **{"cell": "refined_gru", "gate": "equal"},
            **{"gate_temperature": 2.0, "gate_balance_rate": 0.1, "embeddings": False},
            "r2d2_width_factor": 3,
        },
        EnvConfig: {"scan_margin": 0.2},
    }
    require_exportable(TrainConfig())
    for group, known in KNOWN_SETTINGS.items():
        assert {field.name for field in dataclasses.fields(group)} == known | refused[group].keys()
        name = "network" if group is NetworkConfig else "env"
        for field, value in refused[group].items():
            changed = dataclasses.replace(getattr(TrainConfig(), name), **{field: value})
            other = dataclasses.replace(TrainConfig(), **{name: changed})
            expected = getattr(group(), field)
            assert refusal(partial(require_exportable, other)) == (
                f"{name}.{field} is {value!r}, which cannot be exported, expected {expected!r}"
            )


def test_the_file_for_robots_is_short_and_old_pythons_and_numpy_alone_read_it() -> None:
    source = Path(sqn_policy.__file__).read_text()
    assert len(source.splitlines()) <= 80
    imported = set()
    for node in ast.walk(ast.parse(source, feature_version=(3, 8))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names]
            imported |= {node.module} if isinstance(node, ast.ImportFrom) else set(names)
    assert imported == {"json", "pathlib", "numpy"}


def test_another_library_reads_the_parameters(exported: Path) -> None:
    library = pytest.importorskip("safetensors.numpy", reason="safetensors is not installed")
    config = tiny(num_skills=3, layer_norm=True)
    expected = traverse_util.flatten_dict(random_policy(config).params[0], sep="/")
    found = library.load_file(exported / "params.safetensors")
    assert found.keys() == expected.keys()
    for path, array in expected.items():
        np.testing.assert_array_equal(found[path], array)


def test_parameters_come_back_and_other_bytes_do_not() -> None:
    arrays = {"b": np.float32([[1, 2, 3]]), "a": np.float32(7)}
    data, shapes = to_safetensors(arrays), {"a": (), "b": (1, 3)}
    found = from_safetensors(data, shapes)
    assert (found["a"], found["b"].tolist()) == (7, [[1, 2, 3]])
    for other in (data[:-1], data + b"\0", b"", data.replace(b"F32", b"F16")):
        assert "does not hold" in refusal(lambda other=other: from_safetensors(other, shapes))
    assert "expected float32" in refusal(lambda: to_safetensors({"a": np.zeros(2)}))


def test_the_card_says_what_robot_it_is_for_and_what_is_known() -> None:
    policy = random_policy(tiny())
    text = model_card(policy, [Result("maze, random pairs", 500, 0.3, 0.98)], "mit")
    _, header, body = text.split("---\n", 2)
    facts = yaml.safe_load(header)
    assert facts["license"] == "mit"
    assert facts["model-index"][0]["results"][0]["metrics"][0]["value"] == 0.98
    for part in ("Not safety rated", "270 degrees", "up to 3 m", "90 degrees behind it", "2.0%"):
        assert part in body
    config = dataclasses.replace(policy.config, map="/home/me/secret/hall.yaml*2,maze:0-1")
    private = dataclasses.replace(policy, config=config)
    assert "on `hall.yaml*2,maze:0-1`" in model_card(private, [])
    assert to_public_dict(config)["map"] == "hall.yaml*2,maze:0-1"
    bare = yaml.safe_load(model_card(policy, []).split("---\n", 2)[1])
    assert not {"license", "model-index"} & bare.keys()


def test_results_of_a_run_are_those_of_its_seed_without_noise(tmp_path: Path) -> None:
    entry = {
        **{"algorithm": "sqn", "map": "maze", "tasks": "random pairs", "goal_radius": 0.3},
        **{"training_seeds": [4, 5], "eval_seeds": [1, 2], "episodes": 10},
        **{"success_per_seed": [0.25, 0.75], "velocity_noise": 0.0, "range_noise": 0.0},
    }
    others = [entry | {"algorithm": "oracle"}, entry | {"range_noise": 0.2}]
    path = tmp_path / "evaluation.json"
    path.write_text(json.dumps({"results": [entry, *others]}))
    policy = random_policy(dataclasses.replace(tiny(), seed=5))
    assert results_of(str(tmp_path), policy) == [Result("maze, random pairs", 20, 0.3, 0.75)]
    path.write_text(json.dumps({"results": [{}]}))
    assert "lacks 'algorithm'" in refusal(lambda: results_of(str(tmp_path), policy))
    assert [result.episodes for result in results_of("pretrained:best", policy)] == [500] * 4


def test_one_seed_of_several_must_be_named() -> None:
    first, second = (random_policy(tiny(), seed).params[0] for seed in (0, 1))
    config = dataclasses.replace(tiny(), seed=3, num_seeds=2)
    several = Policy("run", config, (first, second))
    assert refusal(lambda: of_seed(several, None)) == (
        "run: has the training seeds 3 to 4, expected --seed with one of them"
    )
    assert "has no training seed 5, expected 3 to 4" in refusal(lambda: of_seed(several, 5))
    chosen = of_seed(several, 4)
    assert (chosen.config.seed, chosen.config.num_seeds) == (4, 1)
    assert chosen.params == (second,)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["pretrained:best"], "--out DIR is missing"),
        ([], "a policy is missing"),
        (["--check", "x", "--out", "y"], "--out: not with --check"),
        (["pretrained:no", "--out", "x"], "pretrained:no: no such policy"),
        (["pretrained:best", "--out", "x", "--seed", "9"], "has no training seed 9, expected 0"),
        (["pretrained:best", "--out", "x", "--map", "maze:0-1"], "expected one map"),
        (["--check", "x"], "x: no such folder"),
    ],
)
def test_bad_arguments_are_refused_in_a_line(
    arguments: list[str],
    part: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", *arguments]) == 2
    assert part in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_the_extra_a_line_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(folders, "find_spec", lambda name: None)
    assert main(["export", "pretrained:best", "--out", "x"]) == 2
    assert "pip install 'sqn_jax[export]'" in capsys.readouterr().err
