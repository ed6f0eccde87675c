"""The switches of the gate and of its loss against NumPy, and what balances the skills."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from learning_oracle import forward, mlp
from small_problems import HIDDEN, NUM_ACTIONS, in_float64, random_obs, random_params

from sqn_jax.agent import QOutput, loss, make_network
from sqn_jax.agent.learner import LearnerState, balanced, gradient_step
from sqn_jax.agent.program import Program
from sqn_jax.agent.reachability import goal_seems_reachable
from sqn_jax.config import EnvConfig, LearnerConfig, NetworkConfig, TrainConfig

LENGTH, BATCH, SKILLS = 4, 3, 2
SENSORS = EnvConfig(num_beams=4, field_of_view_deg=200.0, max_range=9.0, max_goal_distance=12.0)


def program(network: NetworkConfig | None = None, **learner: Any) -> Program:
    settings = TrainConfig(
        network=network or NetworkConfig(), learner=LearnerConfig(burn_in_length=0, **learner)
    )
    return Program(settings, LENGTH, NUM_ACTIONS)


def reachable_by_hand(ranges: Any, distance: float, heading_deg: float, env: EnvConfig) -> bool:
    """In the field of view, and nearer than what the beam of the nearest angle reads."""
    half = env.field_of_view_deg / 2
    angles = np.linspace(-half, half, len(ranges))
    reading = ranges[np.abs(angles - heading_deg).argmin()] * env.max_range
    return bool(abs(heading_deg) <= half and distance < reading)


@pytest.mark.parametrize("heading_encoding", ["linear", "sincos"])
@pytest.mark.parametrize("distance_encoding", ["clipped", "rational"])
def test_a_goal_seems_reachable_where_the_nearest_beam_goes_beyond_it(
    heading_encoding: Any, distance_encoding: Any
) -> None:
    env = EnvConfig(
        num_beams=9,
        field_of_view_deg=300.0,
        max_range=6.0,
        heading_encoding=heading_encoding,
        goal_distance_encoding=distance_encoding,
        goal_distance_scale=4.0,
    )
    rng = np.random.default_rng(0)
    ranges = rng.random((50, 4, 9))
    distance, heading = rng.uniform(0, 8, (50, 4)), rng.uniform(-180, 180, (50, 4))
    near, turn = distance / 24, np.radians(heading)
    shown = [near if distance_encoding == "clipped" else distance / (distance + 4)]
    if heading_encoding == "linear":
        shown += [heading / 360 + 0.5]
    else:
        shown += [(1 + np.sin(turn)) / 2, (1 + np.cos(turn)) / 2]
    goal = np.stack(shown, axis=-1)
    found = goal_seems_reachable(jnp.float32(ranges), jnp.float32(goal), env)
    places = np.ndindex(50, 4)
    expected = [reachable_by_hand(ranges[i], distance[i], heading[i], env) for i in places]
    assert 40 < sum(expected) < 160
    np.testing.assert_array_equal(np.asarray(found).reshape(-1), expected)


def gate_by_hand(tree: Any, perception: Any, obs: Any, config: NetworkConfig) -> Any:
    """Skill weights [T, B, K] of perceptions [T, B, H] and observations."""
    if config.gate == "equal":
        return np.full((LENGTH, BATCH, config.num_skills), 1 / config.num_skills)
    weights = np.zeros((LENGTH, BATCH, config.num_skills))
    for t, b in np.ndindex(LENGTH, BATCH):
        if config.gate == "reachable":
            distance, heading = np.asarray(obs.goal[t, b], float) * [12, 360] - [0, 180]
            skill = 0 if reachable_by_hand(obs.ranges[t, b], distance, heading, SENSORS) else 1
            weights[t, b, skill] = 1
            continue
        seen = perception[t, b] + tree.get("decision_embedding", 0)
        logits = (mlp(tree["decision"], seen) + tree.get("decision_balance", 0)) / (
            config.gate_temperature
        )
        weights[t, b] = np.exp(logits) / np.exp(logits).sum()
    return weights


@pytest.mark.parametrize(
    "changes",
    [
        {"gate": "equal", "num_skills": 3},
        {"gate": "reachable"},
        {"gate_temperature": 0.3, "embeddings": False},
        {"gate_balance_rate": 0.1, "gate_temperature": 2.0},
    ],
    ids=str,
)
def test_a_network_has_the_gate_that_its_settings_name(changes: Any) -> None:
    config = NetworkConfig(hidden_size=HIDDEN, **changes)
    network = make_network("sqn", config, NUM_ACTIONS, SENSORS)
    rng = np.random.default_rng(1)
    params, obs = random_params(network, rng), random_obs(rng, LENGTH, BATCH)
    carry = jnp.asarray(rng.normal(size=(BATCH, HIDDEN)), jnp.float32)
    with compiling_quickly():
        output = jax.jit(network.apply)(params, obs, carry)[1]
    tree = in_float64(params)["params"]
    assert ("decision" in tree) == (config.gate == "learned")
    assert ("decision_balance" in tree) == (config.gate_balance_rate > 0)
    assert any("embedding" in name for name in tree) == config.embeddings

    # What the GRU says, step by step, from the oracle.
    perception = []
    state = np.asarray(carry, float)
    for t in range(LENGTH):
        seen = (in_float64(x[t : t + 1]) for x in (obs.ranges, obs.goal))
        state = forward("r2d2", {"params": tree}, *seen, state).carry
        perception.append(state)
    weights = gate_by_hand(tree, np.array(perception), obs, config)
    skills = np.zeros((LENGTH, BATCH, config.num_skills, NUM_ACTIONS))
    for t, b, k in np.ndindex(skills.shape[:3]):
        seen = perception[t][b] + tree.get(f"skill_{k}_embedding", 0)
        skills[t, b, k] = mlp(tree[f"skill_{k}"], seen)
    assert np.ptp(weights, axis=(0, 1)).max() > 0.02 or config.gate == "equal"
    np.testing.assert_allclose(output.skill_weights, weights, atol=1e-5)
    np.testing.assert_allclose(output.skill_q_values, skills, atol=1e-5)
    np.testing.assert_allclose(output.q_values, (weights[..., None] * skills).sum(2), atol=1e-5)


def test_networks_that_do_not_read_the_sensors_are_equal_whatever_these_are() -> None:
    plain, by_hand = NetworkConfig(), NetworkConfig(gate="reachable")
    assert make_network("sqn", plain, 5, SENSORS) == make_network("sqn", plain, 5)
    assert make_network("sqn", by_hand, 5, SENSORS) != make_network("sqn", by_hand, 5)


def test_a_wide_head_of_r2d2_is_as_wide_as_two_skills_and_their_decision() -> None:
    shapes = {}
    for factor in (1, 3):
        network = make_network("r2d2", NetworkConfig(r2d2_width_factor=factor), 5)
        obs = random_obs(np.random.default_rng(0), 1, 1)
        tree = jax.eval_shape(network.init, jax.random.key(0), obs, jnp.zeros((1, 128)))["params"]
        shapes[factor] = tree["skill_0"]["hidden"]["kernel"].shape
        assert tree["perception"]["hidden_kernel"].shape == (128, 384)
        assert tree["skill_0"]["output"]["kernel"].shape == (128 * factor, 5)
    assert shapes == {1: (128, 128), 3: (128, 384)}


def made_up_outputs(seed: int) -> tuple[QOutput, Any, Any, Any]:
    """Outputs [T + 1, B, ...], targets and actions [T, B], importance weights [B]."""
    rng = np.random.default_rng(seed)
    skills = rng.normal(size=(LENGTH + 1, BATCH, SKILLS, NUM_ACTIONS))
    weights = rng.dirichlet(np.ones(SKILLS), (LENGTH + 1, BATCH))
    numbers = ((weights[..., None] * skills).sum(axis=2), weights, skills)
    output = QOutput(*(jnp.float32(x) for x in numbers))
    actions = rng.integers(0, NUM_ACTIONS, (LENGTH, BATCH))
    return output, rng.normal(size=(LENGTH, BATCH)), actions, rng.random(BATCH)


def loss_by_hand(
    output: QOutput, targets: Any, actions: Any, weights: Any, config: LearnerConfig
) -> float:
    total, entropies = 0.0, []
    for t, b in np.ndindex(LENGTH, BATCH):
        eta, q, action = output.skill_weights[t, b], output.q_values[t, b], actions[t, b]
        target = targets[t, b] - config.advantage_learning * (max(q) - q[action])
        if config.skill_loss == "each":
            errors = [target - output.skill_q_values[t, b, k, action] for k in range(SKILLS)]
            error = sum(float(w) * float(e) ** 2 for w, e in zip(eta, errors, strict=True))
        else:
            error = float(target - q[action]) ** 2
        total += 0.5 * weights[b] * error / (LENGTH * BATCH)
    for eta in np.asarray(output.skill_weights, float).reshape(-1, SKILLS):
        entropies.append(-(eta * np.log(eta)).sum())
    used = np.asarray(output.skill_weights, float).reshape(-1, SKILLS).mean(axis=0)
    entropy_of_mean = -(used * np.log(used)).sum()
    return total + config.gate_entropy_weight * float(np.mean(entropies) - entropy_of_mean)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"skill_loss": "each"},
        {"skill_loss": "each", "advantage_learning": 0.8},
        {"gate_entropy_weight": 0.7},
        {"skill_loss": "each", "gate_entropy_weight": 0.2},
    ],
    ids=str,
)
def test_the_loss_has_the_terms_that_the_settings_name(changes: Any) -> None:
    given, made = program(**changes), made_up_outputs(2)
    value, output = loss._loss(*(jax.tree.map(jnp.asarray, x) for x in made), given)
    config = given.config.learner
    np.testing.assert_allclose(value, loss_by_hand(*made, config), rtol=1e-5)
    # Priorities go by the mixture, whatever is compared.
    plain = loss._loss(*(jax.tree.map(jnp.asarray, x) for x in made), program())[1]
    if "advantage_learning" not in changes:
        np.testing.assert_array_equal(output.td_errors, plain.td_errors)
    np.testing.assert_allclose(output.skill_load, np.mean(made[0].skill_weights, axis=(0, 1)))


@pytest.mark.parametrize("changes", [{"skill_loss": "each"}, {"gate_entropy_weight": 0.7}], ids=str)
def test_both_losses_move_the_gate_as_their_differences_say(changes: Any) -> None:
    given, (output, *others) = program(**changes), made_up_outputs(3)
    others = [jnp.asarray(x) for x in others]
    rng = np.random.default_rng(4)
    # Weights that go on adding up to 1.
    moved = rng.normal(size=output.skill_weights.shape)
    moved -= moved.mean(axis=-1, keepdims=True)

    def value(step: Any) -> Any:
        return output.replace(skill_weights=output.skill_weights + step * jnp.float32(moved))

    slope = jax.grad(lambda step: loss._loss(value(step), *others, given)[0])(0.0)
    ends = [loss_by_hand(value(h), *others, given.config.learner) for h in (-1e-3, 1e-3)]
    assert abs(float(slope)) > 1e-3
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 2e-3, rtol=5e-3)


def test_the_entropy_of_the_load_is_that_over_all_devices() -> None:
    loads = np.array([[0.9, 0.1], [0.2, 0.8], [0.4, 0.6]])
    of_shards = jax.vmap(lambda load: loss.load_entropy(load, "devices"), axis_name="devices")
    used = loads.mean(axis=0)
    expected = -(used * np.log(used)).sum()
    np.testing.assert_allclose(of_shards(jnp.float32(loads)).mean(), expected, rtol=1e-6)


def test_the_balance_moves_against_the_load_and_nothing_else_moves() -> None:
    params = {"params": {"decision_balance": jnp.array([0.5, 0.0, -0.5]), "skill_0": jnp.ones(2)}}
    after = balanced(params, jnp.array([0.5, 1 / 3, 1 / 6]), 0.25)["params"]
    np.testing.assert_allclose(after["decision_balance"], [0.25, 0.0, -0.25])
    assert after["skill_0"] is params["params"]["skill_0"]
    plain = {"params": {"skill_0": jnp.ones(2)}}
    assert balanced(plain, jnp.array([1.0, 0.0]), 0.25) is plain


@pytest.mark.parametrize("scale", [1.0, np.nan])
def test_an_update_that_is_left_out_does_not_move_the_balance(scale: float) -> None:
    given = program(NetworkConfig(gate_balance_rate=0.1))
    params = {"params": {"decision_balance": jnp.zeros(2), "weight": jnp.float32(3.0)}}
    state = LearnerState(
        params=params,
        target_params=None,
        opt_state=given.optimizer.init(params),
        memory=None,
        round=jnp.int32(0),
        num_updates=jnp.int32(0),
        num_skipped=jnp.int32(0),
    )
    load = jnp.array([0.7, 0.3])
    by_product = loss.LossOutput(load, load[0], load[0], load[0], load)

    def of_params(params: Any) -> Any:
        return scale * params["params"]["weight"] ** 2, by_product

    after = gradient_step(state, of_params, given)[0].params["params"]
    is_taken = scale == 1.0
    np.testing.assert_allclose(after["decision_balance"], [-0.1, 0.1] if is_taken else [0, 0])
    assert (float(after["weight"]) < 3) == is_taken
