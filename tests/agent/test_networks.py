"""The three networks against the paper's equations worked out in NumPy, and against each other."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning_oracle import forward
from small_problems import (
    HIDDEN,
    NUM_ACTIONS,
    Seen,
    SeenWithMotion,
    in_float64,
    random_obs,
    random_params,
    small_network,
)

from sqn_jax.agent import initial_carry, make_network
from sqn_jax.config import NetworkConfig

LENGTH, BATCH = 6, 2
ALGOS = ("sqn", "r2d2", "dqn")


def random_carry(rng: np.random.Generator) -> jax.Array:
    return jnp.asarray(rng.normal(size=(BATCH, HIDDEN)), jnp.float32)


def paper_sized(algo: str, **changes: Any) -> Any:
    """Parameter shapes at the paper's sizes: 71 beams, distance and heading, five actions."""
    network = make_network(algo, NetworkConfig(**changes), 5)
    obs = Seen(ranges=jnp.zeros((1, 1, 71)), goal=jnp.zeros((1, 1, 2)))
    return jax.eval_shape(network.init, jax.random.key(0), obs, jnp.zeros((1, 128)))


def count(tree: Any) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize(("algo", "num_skills"), [("sqn", 2), ("sqn", 3), ("r2d2", 2), ("dqn", 2)])
def test_outputs_are_those_of_the_equations(algo: str, num_skills: int, layer_norm: bool) -> None:
    rng = np.random.default_rng(10)
    network = small_network(algo, layer_norm=layer_norm, num_skills=num_skills)
    params, obs, carry = (
        random_params(network, rng),
        random_obs(rng, LENGTH, BATCH),
        random_carry(rng),
    )
    new_carry, output = jax.jit(network.apply)(params, obs, carry)
    expected = forward(
        algo, in_float64(params), in_float64(obs.ranges), in_float64(obs.goal), carry
    )
    heads = num_skills if algo == "sqn" else 1
    assert output.q_values.shape == (LENGTH, BATCH, NUM_ACTIONS)
    assert output.skill_weights.shape == (LENGTH, BATCH, heads)
    assert output.skill_q_values.shape == (LENGTH, BATCH, heads, NUM_ACTIONS)
    np.testing.assert_allclose(output.skill_weights, expected.skill_weights, atol=1e-5)
    np.testing.assert_allclose(output.skill_q_values, expected.skill_q_values, atol=1e-5)
    np.testing.assert_allclose(output.q_values, expected.q_values, atol=1e-5)
    np.testing.assert_allclose(new_carry, expected.carry, atol=1e-5)


@pytest.mark.parametrize("algo", ALGOS)
def test_motion_goes_into_the_perception_as_it_is(algo: str) -> None:
    rng = np.random.default_rng(16)
    network = small_network(algo, motion_inputs=True)
    seen = random_obs(rng, LENGTH, BATCH)
    motion = jnp.asarray(rng.random((LENGTH, BATCH, NUM_ACTIONS + 1)), jnp.float32)
    obs, carry = SeenWithMotion(seen.ranges, seen.goal, motion), random_carry(rng)
    params = random_params(network, rng, obs)
    output = jax.jit(network.apply)(params, obs, carry)[1]
    expected = forward(
        algo,
        in_float64(params),
        in_float64(obs.ranges),
        in_float64(obs.goal),
        carry,
        in_float64(motion),
    )
    np.testing.assert_allclose(output.q_values, expected.q_values, atol=1e-5)


def plain_mlp(block: Any, inputs: jax.Array) -> jax.Array:
    hidden = inputs @ block["hidden"]["kernel"] + block["hidden"]["bias"]
    if "norm" in block:
        hidden = plain_norm(block["norm"], hidden)
    return jnp.maximum(hidden, 0) @ block["output"]["kernel"] + block["output"]["bias"]


def plain_norm(block: Any, hidden: jax.Array) -> jax.Array:
    centered = hidden - hidden.mean(axis=-1, keepdims=True)
    spread = jnp.sqrt((centered**2).mean(axis=-1, keepdims=True) + 1e-6)
    return centered / spread * block["scale"] + block["bias"]


def plain_gru(block: Any, features: jax.Array, carry: jax.Array) -> jax.Array:
    states = []
    for inputs in features @ block["input_kernel"] + block["input_bias"]:
        from_inputs = jnp.split(inputs, 3, axis=-1)
        from_hidden = jnp.split(carry @ block["hidden_kernel"], 3, axis=-1)
        reset = jax.nn.sigmoid(from_inputs[0] + from_hidden[0])
        update = jax.nn.sigmoid(from_inputs[1] + from_hidden[1])
        inner = reset * (from_hidden[2] + block["candidate_bias"])
        carry = (1 - update) * jnp.tanh(from_inputs[2] + inner) + update * carry
        states.append(carry)
    return jnp.stack(states)


def plain_q_values(algo: str, params: Any, obs: Seen, carry: jax.Array) -> jax.Array:
    """Q-values [T, B, A] in plain array operations, for automatic differentiation."""
    tree = params["params"]
    parts = [plain_mlp(tree["features"][name], getattr(obs, name)) for name in ("ranges", "goal")]
    features = jnp.concatenate(parts, axis=-1)
    if algo == "dqn":
        hidden = features @ tree["perception"]["kernel"] + tree["perception"]["bias"]
        hidden = plain_norm(tree["norm"], hidden) if "norm" in tree else hidden
        return plain_mlp(tree["skill_0"], jnp.maximum(hidden, 0))
    perception = plain_gru(tree["perception"], features, carry)
    if algo == "r2d2":
        return plain_mlp(tree["skill_0"], perception)
    decision = jax.nn.softmax(plain_mlp(tree["decision"], perception + tree["decision_embedding"]))
    skills = [
        plain_mlp(tree[name], perception + tree[f"{name}_embedding"])
        for name in ("skill_0", "skill_1")
    ]
    return decision[..., :1] * skills[0] + decision[..., 1:] * skills[1]


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("algo", ALGOS)
def test_gradients_are_those_of_plain_array_operations(algo: str, layer_norm: bool) -> None:
    rng = np.random.default_rng(15)
    network = small_network(algo, layer_norm=layer_norm)
    params, obs, carry = (
        random_params(network, rng),
        random_obs(rng, LENGTH, BATCH),
        random_carry(rng),
    )
    weights = jnp.asarray(rng.normal(size=(LENGTH, BATCH, NUM_ACTIONS)), jnp.float32)

    def ours(params: Any, carry: jax.Array) -> jax.Array:
        return (weights * network.apply(params, obs, carry)[1].q_values).sum()

    def plain(params: Any, carry: jax.Array) -> jax.Array:
        return (weights * plain_q_values(algo, params, obs, carry)).sum()

    found = jax.jit(jax.grad(ours, argnums=(0, 1)))(params, carry)
    with jax.numpy_rank_promotion("allow"):
        expected = jax.jit(jax.grad(plain, argnums=(0, 1)))(params, carry)
    pairs = zip(jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(expected), strict=True)
    for (path, got), wanted in pairs:
        name = jax.tree_util.keystr(path)
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_one_skill_is_the_r2d2_network(layer_norm: bool) -> None:
    rng = np.random.default_rng(11)
    one_skill = small_network("sqn", layer_norm=layer_norm, num_skills=1)
    single_head = small_network("r2d2", layer_norm=layer_norm)
    params = random_params(one_skill, rng)
    tree = params["params"]
    # W (z + e) + b = W z + (b + W e): the embedding becomes a part of the bias.
    kernel, bias = tree["skill_0"]["hidden"]["kernel"], tree["skill_0"]["hidden"]["bias"]
    folded = {**tree["skill_0"], "hidden": {"kernel": kernel}}
    folded["hidden"]["bias"] = bias + tree["skill_0_embedding"] @ kernel
    same = {"features": tree["features"], "perception": tree["perception"], "skill_0": folded}

    obs, carry = random_obs(rng, LENGTH, BATCH), random_carry(rng)
    carry_1, sqn = jax.jit(one_skill.apply)(params, obs, carry)
    carry_2, r2d2 = jax.jit(single_head.apply)({"params": same}, obs, carry)
    np.testing.assert_allclose(carry_1, carry_2, atol=1e-6)
    np.testing.assert_allclose(sqn.q_values, r2d2.q_values, atol=2e-6)
    np.testing.assert_allclose(sqn.skill_q_values, r2d2.skill_q_values, atol=2e-6)
    np.testing.assert_array_equal(sqn.skill_weights, np.ones((LENGTH, BATCH, 1)))


@pytest.mark.parametrize("algo", ALGOS)
def test_a_sequence_gives_what_its_steps_give_one_by_one(algo: str) -> None:
    rng = np.random.default_rng(12)
    network = small_network(algo)
    params, obs, carry = (
        random_params(network, rng),
        random_obs(rng, LENGTH, BATCH),
        random_carry(rng),
    )
    apply = jax.jit(network.apply)
    last, whole = apply(params, obs, carry)
    for t in range(LENGTH):
        carry, single = apply(params, jax.tree.map(lambda x, t=t: x[t : t + 1], obs), carry)
        np.testing.assert_allclose(single.q_values[0], whole.q_values[t], atol=2e-6)
        np.testing.assert_allclose(single.skill_weights[0], whole.skill_weights[t], atol=2e-6)
    np.testing.assert_allclose(carry, last, atol=2e-6)


@pytest.mark.parametrize("algo", ALGOS)
def test_only_the_recurrent_networks_remember_and_none_foresees(algo: str) -> None:
    rng = np.random.default_rng(13)
    network = small_network(algo)
    params, obs, carry = (
        random_params(network, rng),
        random_obs(rng, LENGTH, BATCH),
        random_carry(rng),
    )
    apply = jax.jit(network.apply)
    _, before = apply(params, obs, carry)
    # Robot 0 sees something else at step 2; robot 1 sees the same as before.
    other = Seen(ranges=obs.ranges.at[2, 0].set(1 - obs.ranges[2, 0]), goal=obs.goal)
    _, after = apply(params, other, carry)
    changed = np.abs(np.asarray(after.q_values - before.q_values)).max(axis=-1) > 1e-6
    assert not changed[:, 1].any()
    remembers = algo != "dqn"
    assert changed[:, 0].tolist() == [False, False, True, *([remembers] * (LENGTH - 3))]

    new_carry, elsewhere = apply(params, obs, carry + 1)
    moved = np.abs(np.asarray(elsewhere.q_values - before.q_values)).max() > 1e-6
    assert moved == remembers
    if not remembers:
        np.testing.assert_array_equal(new_carry, carry + 1)


def test_the_recurrent_state_starts_at_zero() -> None:
    carry = initial_carry(NetworkConfig(hidden_size=7), 3)
    assert carry.shape == (3, 7)
    assert not carry.any()


def test_parameter_counts_are_those_worked_out_by_hand() -> None:
    # Linear layers of a in and b out have a b + b parameters.
    features = (71 * 128 + 128) + (128 * 128 + 128) + (2 * 128 + 128) + (128 * 128 + 128)
    assert features == 42_624
    # Three gates: 256 inputs and a bias each, 128 recurrent inputs each, one bias in the candidate.
    gru = 3 * (256 * 128 + 128 + 128 * 128) + 128
    assert gru == 147_968
    hidden = 128 * 128 + 128
    decision = 128 + hidden + (128 * 2 + 2)
    skill = 128 + hidden + (128 * 5 + 5)
    assert count(paper_sized("sqn")) == features + gru + decision + 2 * skill == 242_060
    assert count(paper_sized("r2d2")) == features + gru + hidden + (128 * 5 + 5) == 207_749
    wide = (256 * 384 + 384) + (384 * 384 + 384) + (384 * 5 + 5)
    assert count(paper_sized("dqn")) == features + wide == 291_077
    # Scale and bias before each ReLU after the features: in three MLPs, in one, in two wide layers.
    assert count(paper_sized("sqn", layer_norm=True)) == 242_060 + 3 * 2 * 128
    assert count(paper_sized("r2d2", layer_norm=True)) == 207_749 + 2 * 128
    assert count(paper_sized("dqn", layer_norm=True)) == 291_077 + 2 * 2 * 384


def test_layers_are_128_wide_and_those_of_the_dqn_after_the_features_three_times_that() -> None:
    sqn = paper_sized("sqn")["params"]
    assert sqn["features"]["ranges"]["hidden"]["kernel"].shape == (71, 128)
    assert sqn["features"]["goal"]["output"]["kernel"].shape == (128, 128)
    assert sqn["perception"]["hidden_kernel"].shape == (128, 3 * 128)
    assert sqn["decision"]["hidden"]["kernel"].shape == (128, 128)
    assert sqn["decision"]["output"]["kernel"].shape == (128, 2)
    assert sqn["decision_embedding"].shape == sqn["skill_1_embedding"].shape == (128,)
    assert sqn["skill_1"]["output"]["kernel"].shape == (128, 5)
    dqn = paper_sized("dqn")["params"]
    assert dqn["features"] == paper_sized("r2d2")["params"]["features"] == sqn["features"]
    assert dqn["perception"]["kernel"].shape == (256, 384)
    assert dqn["skill_0"]["hidden"]["kernel"].shape == (384, 384)


@pytest.mark.parametrize("algo", ALGOS)
def test_layers_start_at_their_scales(algo: str) -> None:
    """Times sqrt(D): 4 where the goal comes in, 0.1 where a decision or Q-values come out."""
    network = make_network(algo, NetworkConfig(), 5)
    obs = Seen(ranges=jnp.zeros((1, 1, 71)), goal=jnp.zeros((1, 1, 2)))
    params = jax.jit(network.init)(jax.random.key(2), obs, jnp.zeros((1, 128)))["params"]
    heads = ("decision", "skill_0", "skill_1") if algo == "sqn" else ("skill_0",)
    expected = {("features", "goal", "hidden"): 4.0}
    expected |= {("features", "goal", "output"): 1.0}
    expected |= {("features", "ranges", layer): 1.0 for layer in ("hidden", "output")}
    expected |= {(head, "hidden"): 1.0 for head in heads}
    expected |= {(head, "output"): 0.1 for head in heads}
    if algo == "dqn":
        expected[("perception",)] = 1.0
    for path, scale in expected.items():
        layer = params
        for name in path:
            layer = layer[name]
        fan_in = layer["kernel"].shape[0]
        assert float(layer["kernel"].std()) == pytest.approx(scale / fan_in**0.5, rel=0.15), path
        largest = float(np.abs(layer["bias"]).max())
        assert 0.2 * scale < largest * fan_in**0.5 <= scale, path
    for name in heads if algo == "sqn" else ():
        assert float(params[f"{name}_embedding"].std()) == pytest.approx(0.02, rel=0.3)


def test_a_fresh_network_prefers_no_skill_and_expects_nothing() -> None:
    network = small_network("sqn")
    rng = np.random.default_rng(14)
    obs = random_obs(rng, 20, 4)
    carry = initial_carry(network.config, 4)
    params = jax.jit(network.init)(jax.random.key(1), obs, carry)
    _, output = jax.jit(network.apply)(params, obs, carry)
    assert np.abs(np.asarray(output.skill_weights) - 0.5).max() < 0.1
    assert np.abs(np.asarray(output.q_values)).max() < 0.3
    # The skills and their embeddings are drawn apart, or they would stay one.
    tree = params["params"]
    assert np.abs(np.asarray(tree["skill_0_embedding"] - tree["skill_1_embedding"])).max() > 0
    skills = np.asarray(output.skill_q_values)
    assert np.abs(skills[:, :, 0] - skills[:, :, 1]).max() > 0
