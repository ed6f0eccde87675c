"""Exported policies: the same values as the network's, and folders that are whole or refused."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import io
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from compiling import compiling_quickly
from flax import traverse_util
from refusals import refusal
from rooms import write_empty_room

from sqn_jax import load_policy
from sqn_jax.agent.networks import initial_carry
from sqn_jax.cli import main
from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig, to_public_dict
from sqn_jax.env import Observation
from sqn_jax.export import folder as folders
from sqn_jax.export import sqn_policy
from sqn_jax.export.description import KNOWN_SETTINGS, describe_robot, require_exportable
from sqn_jax.export.folder import FILES, SUMS, flat_arrays, require_free, sums_text
from sqn_jax.export.model_card import Result, model_card, results_of
from sqn_jax.export.safetensors_file import from_safetensors, to_safetensors
from sqn_jax.policies.pretrained import write_policy
from sqn_jax.policies.run_policies import Policy, of_seed
from sqn_jax.training.motion import MotionObservation
from sqn_jax.training.state import network_of, params_shapes

onnx = pytest.importorskip("onnx", reason="the extra `export` is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra `export` is not installed")

from sqn_jax.export.check import check_export, compare  # noqa: E402
from sqn_jax.export.network_graph import policy_graph  # noqa: E402

ROBOT = {"num_beams": 7, "field_of_view_deg": 270.0, "max_range": 3.0, "max_goal_distance": 10.0}


def tiny(algo: str = "sqn", **changes: Any) -> TrainConfig:
    """A network of 8 units for a robot of 7 beams."""
    names = ("heading_encoding", "goal_distance_encoding", "goal_distance_scale")
    env = EnvConfig(**ROBOT, **{name: changes.pop(name) for name in names if name in changes})
    return TrainConfig(algo=algo, env=env, network=NetworkConfig(hidden_size=8, **changes))


def random_policy(config: TrainConfig, seed: int = 0) -> Policy:
    """Weights of every part, biases and norms among them, large enough to matter."""
    rng = np.random.default_rng(seed)

    def draw(leaf: Any) -> Any:
        return jnp.asarray(rng.normal(size=leaf.shape), jnp.float32)

    return Policy("tiny", config, (jax.tree.map(draw, params_shapes(config)),))


CONFIGS = {
    "sqn": tiny(),
    "sqn with 3 skills, norms, sine and cosine": tiny(
        num_skills=3, layer_norm=True, heading_encoding="sincos"
    ),
    "r2d2 with norms": tiny("r2d2", layer_norm=True),
    "dqn, sine and cosine": tiny("dqn", heading_encoding="sincos"),
    "dqn with norms": tiny("dqn", layer_norm=True),
    "sqn without a largest distance": tiny(
        goal_distance_encoding="rational", goal_distance_scale=3.0
    ),
}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_onnx_and_numpy_say_what_the_network_says(config: TrainConfig, tmp_path: Path) -> None:
    policy = random_policy(config)
    rng = np.random.default_rng(1)
    ranges = rng.uniform(-0.5, 4, (20, 7))
    ranges[3, 2], ranges[3, 3], ranges[4, 0] = np.nan, np.inf, -np.inf
    distances, headings = rng.uniform(0, 12, 20), rng.uniform(-4 * np.pi, 4 * np.pi, 20)
    distances[5:7] = 0, np.inf
    headings[:3] = 0, np.float32(np.pi), -np.float32(np.pi)
    # What the network sees of that, by the words of the docs.
    readings = np.where(np.isnan(ranges), 3.0, ranges)
    scaled = np.minimum(np.maximum(readings, 0), 3) / 3
    goal = [np.minimum(distances / 10, 1)]
    if config.env.goal_distance_encoding == "rational":
        goal = [np.append(distances[:6] / (distances[:6] + 3), [1, *1 / (1 + 3 / distances[7:])])]
    if config.env.heading_encoding == "sincos":
        goal += [(np.sin(headings) + 1) / 2, (np.cos(headings) + 1) / 2]
    else:
        turns = np.angle(np.exp(1j * headings)) / (2 * np.pi) + 0.5
        goal += [np.concatenate([[0.5, 1, 0], turns[3:]])]
    seen = [np.float32(x)[:, None] for x in (scaled, np.stack(goal, axis=1))]
    with compiling_quickly():
        _, output = jax.jit(network_of(config).apply)(
            policy.params[0], Observation(*seen), initial_carry(config.network, 1)
        )
    expected = np.asarray(output.q_values)[:, 0]
    weights = np.asarray(output.skill_weights)[:, 0]

    write_policy(tmp_path, policy, {})
    by_numpy = sqn_policy.Policy(tmp_path / "tiny.npz")
    model = policy_graph(config, flat_arrays(policy.params[0]), {})
    onnx.checker.check_model(model, full_check=True)
    assert model.opset_import[0].version == 17
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    hidden, h_in = None, np.zeros((1, 1, 8), np.float32)
    commands = [[0, 0], [2.5, 0], [-1.25, 0], [0, np.pi], [0, -np.pi]]
    for step in range(20):
        obs = np.float32([*ranges[step], distances[step], headings[step]])
        actions, index, q_values, skill_weights, h_in = session.run(
            None, {"obs": obs[None], "h_in": h_in}
        )
        scale = np.abs(expected[step]).max()
        np.testing.assert_allclose(q_values[0], expected[step], atol=1e-5 * scale)
        np.testing.assert_allclose(skill_weights[0], weights[step], atol=1e-5)
        assert index.tolist() == [q_values.argmax()]
        np.testing.assert_allclose(actions, [commands[index[0]]], rtol=1e-6)
        before = np.zeros(8) if hidden is None else hidden
        np.testing.assert_allclose(by_numpy.step(obs, before)[0], expected[step], atol=1e-5 * scale)
        np.testing.assert_allclose(by_numpy.step(obs, before)[1], weights[step], atol=1e-5)
        command, hidden = by_numpy.act(ranges[step], distances[step], headings[step], hidden)
        np.testing.assert_allclose(command, commands[expected[step].argmax()], rtol=1e-6)
        assert config.algo == "dqn" or hidden.dtype == np.float32  # Without memory: zeros.
    obs[-1] = np.nan
    found, after = session.run(["actions", "h_out"], {"obs": obs[None], "h_in": h_in})
    assert found.tolist() == [[0, 0]]
    np.testing.assert_array_equal(after, h_in)
    command, kept = by_numpy.act(ranges[0], np.nan, 0.0, hidden)
    assert command.tolist() == [0, 0]
    np.testing.assert_array_equal(kept, hidden)  # A gap in the localization is no end.
    assert by_numpy.beam_angles.tolist() == describe_robot(config)["beam_angles_rad"]


@pytest.mark.parametrize(("algo", "seed"), [("sqn", 2), ("dqn", 1)])
def test_with_motion_inputs_a_policy_keeps_its_last_action_itself(
    algo: str, seed: int, tmp_path: Path
) -> None:
    policy = random_policy(tiny(algo, motion_inputs=True), seed)
    smaller = jax.tree.map(lambda x: x / 2, policy.params[0])
    for name in smaller["params"]:
        if name in ("skill_0", "skill_1"):  # So that no action is the best one for ever.
            smaller["params"][name]["output"]["bias"] *= 0
    policy = dataclasses.replace(policy, params=(smaller,))
    write_policy(tmp_path, policy, {})
    by_numpy, by_jax = (
        sqn_policy.Policy(tmp_path / "tiny.npz"),
        load_policy(str(tmp_path / "tiny.npz")),
    )
    model = policy_graph(policy.config, flat_arrays(policy.params[0]), {})
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    network, rng = network_of(policy.config), np.random.default_rng(3)
    carry, h_in = initial_carry(policy.config.network, 1), np.zeros((1, 1, 13), np.float32)
    hidden, state, motion = None, by_jax.start(), np.zeros(6, np.float32)
    taken: list[tuple[int, bool]] = []
    with compiling_quickly():
        for _ in range(60):
            ranges, distance, heading = rng.uniform(0, 4, 7), rng.uniform(0, 12), rng.uniform(-3, 3)
            shown = [np.float32([np.minimum(ranges, 3) / 3]), np.float32([[min(distance / 10, 1)]])]
            shown[1] = np.append(shown[1], [[(heading + np.pi) / (2 * np.pi)]], axis=1)
            refused = bool(rng.integers(2))
            if taken:
                last = taken[-1][0]
                motion = np.float32([*np.eye(5)[last], refused and last in (1, 2)])
            seen = MotionObservation(*(np.float32(x)[None] for x in (*shown, motion[None])))
            carry, output = network.apply(policy.params[0], seen, carry)
            expected = np.asarray(output.q_values)[0, 0]

            obs = np.float32([*ranges, distance, heading, refused])
            index, q_values, h_in = session.run(
                ["action_index", "q_values", "h_out"], {"obs": obs[None], "h_in": h_in}
            )
            tolerance = 1e-5 * np.abs(expected).max()
            np.testing.assert_allclose(q_values[0], expected, atol=tolerance)
            before = np.zeros(13) if hidden is None else hidden
            np.testing.assert_allclose(by_numpy.step(obs, before)[0], expected, atol=tolerance)
            command, hidden = by_numpy.act(ranges, distance, heading, hidden, refused=refused)
            obs_of_env = Observation(shown[0][0], np.float32(shown[1][0]))
            with pytest.raises(ValueError, match="expected refused=False at first"):
                by_jax.act(obs_of_env, state)
            action, state = by_jax.act(obs_of_env, state, refused=refused)
            assert action == index[0] == expected.argmax()
            np.testing.assert_array_equal(command, by_numpy.commands[int(action)])
            for memory in (h_in[0, 0], hidden, state):
                np.testing.assert_array_equal(memory[8:], np.eye(5)[int(action)])
            taken.append((int(action), refused))
    tries = {(action in (1, 2), refused) for action, refused in taken}
    assert len(tries) == 4, "moves and others, refused or not"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all tests, which leave it as it is."""
    place = tmp_path_factory.mktemp("export")
    policy = random_policy(tiny(num_skills=3, layer_norm=True))
    room = str(write_empty_room(place))
    write_policy(place, policy, {"evaluation": []})
    with compiling_quickly():
        arguments = ["export", str(place / "tiny.npz"), "--out", str(place / "robot")]
        assert main([*arguments, "--map", room]) == 0
    return place / "robot"


@pytest.fixture
def changed(exported: Path, tmp_path: Path) -> Path:
    """A copy to change."""
    return Path(shutil.copytree(exported, tmp_path / "robot"))


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


def test_a_runtime_that_is_off_is_named_and_a_tie_is_counted() -> None:
    reference = {
        "hidden": np.zeros((3, 1), np.float32),
        "observations": np.zeros((2, 3), np.float32),
        "q_values": np.float32([[1, 2], [3, 3]]),
        "actions": np.array([1, 0]),
    }
    values = iter(np.float32([[1, 2], [3, 3.0001]]))
    found = compare("X", lambda obs, hidden: (next(values), hidden), reference)
    assert (found.other_actions, found.steps) == (1, 2)
    assert found.q_difference == pytest.approx(0.0001 / 3, rel=1e-2)
    for wrong in (2.001, np.nan):
        message = refusal(
            lambda wrong=wrong: compare("X", lambda *_: (np.array([1, wrong]), _[1]), reference)
        )
        assert message.startswith("X: the Q-values of step 0")


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


def test_an_array_that_no_node_takes_is_refused() -> None:
    policy = random_policy(tiny("r2d2"))
    arrays = flat_arrays(policy.params[0])
    more = arrays | {"params/world_model/kernel": np.zeros((2, 2), np.float32)}
    assert "params/world_model/kernel" in refusal(lambda: policy_graph(policy.config, more, {}))
    del arrays["params/perception/candidate_bias"]
    assert "candidate_bias is missing" in refusal(lambda: policy_graph(policy.config, arrays, {}))


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


def test_a_policy_acts_step_by_step_as_the_network_does_on_the_whole(tmp_path: Path) -> None:
    policy = random_policy(tiny())
    write_policy(tmp_path, policy, {})
    acting = load_policy(str(tmp_path / "tiny.npz"))
    rng = np.random.default_rng(0)
    obs = Observation(*(rng.random((6, 1, size), np.float32) for size in (7, 2)))
    network = network_of(policy.config)
    with compiling_quickly():
        carry = initial_carry(policy.config.network, 1)
        _, output = jax.jit(network.apply)(policy.params[0], obs, carry)
        carry = acting.start()
        for step in range(6):
            seen = jax.tree.map(lambda x, step=step: x[step, 0], obs)
            action, carry = acting.act(seen, carry)
            assert action == output.q_values[step, 0].argmax()


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


def test_reference_rollouts_are_the_same_bytes_each_time(exported: Path) -> None:
    arrays = dict(np.load(exported / "reference.npz"))
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    assert file.getvalue() == (exported / "reference.npz").read_bytes()
