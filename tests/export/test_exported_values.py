"""Exported policies have the values of the network."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from compiling import compiling_quickly
from refusals import refusal
from tiny_policies import random_policy, tiny

from sqn_jax import load_policy
from sqn_jax.agent.networks import initial_carry
from sqn_jax.config import TrainConfig
from sqn_jax.env import Observation
from sqn_jax.export import sqn_policy
from sqn_jax.export.description import describe_robot
from sqn_jax.export.folder import flat_arrays
from sqn_jax.policies.pretrained import write_policy
from sqn_jax.training.motion import MotionObservation
from sqn_jax.training.state import network_of

onnx = pytest.importorskip("onnx", reason="the extra `export` is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra `export` is not installed")

from sqn_jax.export.check import compare  # noqa: E402
from sqn_jax.export.network_graph import policy_graph  # noqa: E402

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


def test_an_array_that_no_node_takes_is_refused() -> None:
    policy = random_policy(tiny("r2d2"))
    arrays = flat_arrays(policy.params[0])
    more = arrays | {"params/world_model/kernel": np.zeros((2, 2), np.float32)}
    assert "params/world_model/kernel" in refusal(lambda: policy_graph(policy.config, more, {}))
    del arrays["params/perception/candidate_bias"]
    assert "candidate_bias is missing" in refusal(lambda: policy_graph(policy.config, arrays, {}))


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
