"""The learner that the benchmark times: PyTorch does the same update, arithmetic is counted right.

What needs PyTorch is left out where it is not installed.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly

from experiments import operations
from sqn_jax.agent import Trajectory, make_network, r2d2, replay
from sqn_jax.agent.learner import LearnerState
from sqn_jax.agent.loss import r2d2_loss
from sqn_jax.agent.program import Program
from sqn_jax.config import LearnerConfig, NetworkConfig, ReplayConfig, TrainConfig
from sqn_jax.env import Observation

LENGTH, BATCH, BEAMS, ACTIONS = 9, 3, 4, 5
SIZES = NetworkConfig(hidden_size=6, num_skills=3)
LEARNER = LearnerConfig(burn_in_length=3, n_step=2, discount=0.9, max_grad_norm=0.05)
PRIORITY_WEIGHT = 0.9


def random_batch(rng: np.random.Generator) -> tuple[Trajectory, jax.Array]:
    """Episodes with true ends and a recurrent state at their start, and weights."""
    episodes = Trajectory(
        obs=Observation(
            ranges=jnp.asarray(rng.random((LENGTH + 1, BATCH, BEAMS)), jnp.float32),
            goal=jnp.asarray(rng.random((LENGTH + 1, BATCH, 2)), jnp.float32),
        ),
        actions=jnp.asarray(rng.integers(0, ACTIONS, (LENGTH, BATCH)), jnp.int32),
        rewards=jnp.asarray(rng.normal(size=(LENGTH, BATCH)), jnp.float32),
        terminated=jnp.asarray(rng.random((LENGTH, BATCH)) < 0.2),
        carry=jnp.asarray(rng.normal(size=(BATCH, SIZES.hidden_size)), jnp.float32),
    )
    return episodes, jnp.asarray(rng.uniform(0.2, 1.0, BATCH), jnp.float32)


def random_params(rng: np.random.Generator, algo: str, episodes: Trajectory) -> Any:
    """Every parameter random, those too that start at zero."""
    network = make_network(algo, SIZES, ACTIONS)
    shapes = jax.eval_shape(network.init, jax.random.key(0), episodes.obs, episodes.carry)
    return jax.tree.map(
        lambda x: jnp.asarray(rng.normal(size=x.shape) / np.sqrt(x.shape[0]), jnp.float32), shapes
    )


def program_for(learner: LearnerConfig, algo: Any = "sqn", **changes: Any) -> Program:
    config = TrainConfig(algo=algo, network=SIZES, learner=learner, **changes)
    return Program(config, LENGTH, ACTIONS)


def fresh_state(params: Any, target_params: Any, program: Program) -> LearnerState:
    return LearnerState(
        params=params,
        target_params=target_params,
        opt_state=program.optimizer.init(params),
        memory=None,
        round=jnp.int32(0),
        num_updates=jnp.int32(0),
        num_skipped=jnp.int32(0),
    )


@pytest.fixture
def torch_sqn() -> Any:
    pytest.importorskip("torch")
    from experiments import torch_sqn

    return torch_sqn


def torch_learner(torch_sqn: Any, params: Any, target_params: Any, config: LearnerConfig) -> Any:
    """A PyTorch learner with these parameters."""
    learner = torch_sqn.Learner(
        torch_sqn.SkillQNetwork(SIZES, BEAMS, 2, ACTIONS), config, PRIORITY_WEIGHT
    )
    torch_sqn.copy_params(learner.online, params)
    torch_sqn.copy_params(learner.target, target_params)
    return learner


@pytest.mark.parametrize(
    "changes", [{}, {"burn_in_length": 0}, {"n_step": 1}, {"n_step": 20, "discount": 1.0}], ids=str
)
def test_pytorch_finds_the_same_loss_errors_and_gradients(
    torch_sqn: Any, changes: dict[str, Any]
) -> None:
    config = dataclasses.replace(LEARNER, **changes)
    rng = np.random.default_rng(3)
    episodes, weights = random_batch(rng)
    params, target_params = (random_params(rng, "sqn", episodes) for _ in range(2))
    (loss, output), gradient = jax.value_and_grad(r2d2_loss, has_aux=True)(
        params, target_params, episodes, weights, config.discount, program_for(config)
    )

    learner = torch_learner(torch_sqn, params, target_params, config)
    batch = torch_sqn.to_torch(episodes, weights)
    their_loss, their_errors = torch_sqn.r2d2_loss(learner.online, learner.target, batch, config)
    their_loss.backward()

    np.testing.assert_allclose(their_loss.item(), loss, rtol=1e-5)
    np.testing.assert_allclose(their_errors.numpy(), output.td_errors, atol=1e-5)
    pairs = list(torch_sqn.counterparts(learner.online, gradient))
    assert len(pairs) == len(list(learner.online.parameters()))
    for parameter, ours in pairs:
        assert np.abs(ours).max() > 1e-5, "nothing flows here"
        np.testing.assert_allclose(parameter.grad.numpy(), ours, rtol=1e-4, atol=1e-6)
    assert all(parameter.grad is None for parameter in learner.target.parameters())


def test_pytorch_goes_the_same_way_in_several_updates(torch_sqn: Any) -> None:
    rng = np.random.default_rng(4)
    batches = [random_batch(rng) for _ in range(3)]
    params, target_params = (random_params(rng, "sqn", batches[0][0]) for _ in range(2))
    program = program_for(LEARNER, replay=ReplayConfig(max_priority_weight=PRIORITY_WEIGHT))
    state = fresh_state(params, target_params, program)
    learner = torch_learner(torch_sqn, params, target_params, LEARNER)
    theirs = learner.updates([torch_sqn.to_torch(*batch) for batch in batches])
    for batch, their_priorities in zip(batches, theirs, strict=True):
        state, priorities, metrics = r2d2.learn_from(state, *batch, program)
        assert metrics["gradient_norm"] > LEARNER.max_grad_norm, "nothing is clipped"
        np.testing.assert_allclose(their_priorities.numpy(), priorities, rtol=1e-4)
    for found, expected, start in (
        (learner.online, state.params, params),
        (learner.target, state.target_params, target_params),
    ):
        starts = [ours for _, ours in torch_sqn.counterparts(found, start)]
        pairs = torch_sqn.counterparts(found, expected)
        for (parameter, ours), before in zip(pairs, starts, strict=True):
            moved = np.abs(ours - before).max()
            assert moved > 0
            values = parameter.detach().numpy()
            np.testing.assert_allclose(values, ours, rtol=1e-6, atol=0.01 * moved)


def test_pytorch_refuses_settings_that_it_does_not_know(torch_sqn: Any) -> None:
    with pytest.raises(ValueError, match=r"network\.layer_norm is True"):
        torch_sqn.SkillQNetwork(NetworkConfig(layer_norm=True), BEAMS, 2, ACTIONS)
    network = torch_sqn.SkillQNetwork(SIZES, BEAMS, 2, ACTIONS)
    with pytest.raises(ValueError, match=r"learner\.double_q is False, expected True"):
        torch_sqn.Learner(network, LearnerConfig(double_q=False), PRIORITY_WEIGHT)


def test_an_update_from_drawn_episodes_is_that_of_the_learner() -> None:
    """One episode fills the replay: whatever is drawn, it is that one, with weights of 1."""
    rng = np.random.default_rng(5)
    first = jax.tree.map(
        lambda x: x[:, :1] if x.ndim > 1 else x, random_batch(rng)[0].replace(carry=None)
    )
    first = first.replace(carry=jnp.zeros((1, SIZES.hidden_size)))
    program = program_for(
        dataclasses.replace(LEARNER, batch_size=2),
        num_envs=1,
        replay=ReplayConfig(capacity=1, min_episodes=1),
    )
    params = random_params(rng, "sqn", first)
    state = fresh_state(params, params, program)
    memory = replay.add(r2d2.init_memory(first, program), r2d2.pack(first))
    twice = jax.tree.map(lambda x: jnp.repeat(x[0], 2, axis=0), memory.storage)
    batch = (r2d2.unpack(twice, SIZES.hidden_size), jnp.ones(2))
    with compiling_quickly():
        whole = jax.jit(partial(r2d2.update, program=program))
        expected, _ = whole(jax.random.key(0), dataclasses.replace(state, memory=memory))
        update = jax.jit(partial(r2d2.learn_from, program=program))
        found, priorities, _ = update(state, *batch)
    np.testing.assert_allclose(priorities, jnp.repeat(expected.memory.priorities, 2), rtol=1e-6)
    expected = dataclasses.replace(expected, memory=None)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6), found, expected)


def test_operations_of_an_update_are_those_counted_by_hand() -> None:
    # One episode of 4 steps and 5 observations, of which 1 is burn-in; 3 beams, 2 goal numbers,
    # 5 actions, 2 hidden units, 2 skills.
    shapes = {"num_beams": 3, "goal_size": 2, "num_actions": 5}
    shapes |= {"num_steps": 4, "batch_size": 1, "burn_in_length": 1}
    network = NetworkConfig(hidden_size=2, num_skills=2, dqn_width_factor=3)
    first = 3 * 2 + 2 * 2
    features = 2 * 2 + 2 * 2
    gru = 4 * 6 + 2 * 6
    head = 2 * 2 + 2 * 5
    decision = 2 * 2 + 2 * 2

    def products(after: int, warmed: int) -> int:
        forward = 4 * (first + after)
        backward = 4 * (first + 2 * after)
        return forward + backward + forward + 2 * warmed  # Online twice, then the target.

    sqn = products(features + gru + decision + 2 * head, first + features + gru)
    assert operations.update_operations("sqn", network, **shapes) == 2 * sqn
    assert sqn == 1508
    single = products(features + gru + head, first + features + gru)
    assert operations.update_operations("r2d2", network, **shapes) == 2 * single
    wide = products(features + 4 * 6 + 6 * 6 + 6 * 5, 0)
    assert operations.update_operations("dqn", network, **shapes) == 2 * wide


def operations_in(jaxpr: Any) -> int:
    """Operations of all matrix products in a program as JAX traced it, without dead code."""
    needed = {id(variable) for variable in jaxpr.outvars}
    total = 0
    for equation in reversed(jaxpr.eqns):
        if not any(id(variable) in needed for variable in equation.outvars):
            continue
        needed |= {id(variable) for variable in equation.invars}
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left = equation.invars[0].aval.shape
            inner = np.prod([left[axis] for axis in contracted])
            right = equation.invars[1].aval.shape
            # A product with a row of ones is a sum, one with a vector makes a bias.
            is_other = (left[0] == 1 and len(left) == 2) or min(len(left), len(right)) < 2
            total += 0 if is_other else int(2 * np.prod(equation.outvars[0].aval.shape) * inner)
        for value in equation.params.values():
            for inside in value if isinstance(value, tuple | list) else (value,):
                program = getattr(inside, "jaxpr", inside)
                if hasattr(program, "eqns"):
                    total += equation.params.get("length", 1) * operations_in(program)
    return total


@pytest.mark.parametrize("algo", ["sqn", "r2d2", "dqn"])
@pytest.mark.parametrize("burn_in_length", [0, 3])
def test_operations_of_an_update_are_those_of_the_traced_program(
    algo: Any, burn_in_length: int
) -> None:
    config = dataclasses.replace(LEARNER, burn_in_length=burn_in_length)
    rng = np.random.default_rng(6)
    episodes, weights = random_batch(rng)
    params = random_params(rng, algo, episodes)
    program = program_for(config, algo)
    traced = jax.make_jaxpr(
        lambda params, target: jax.value_and_grad(r2d2_loss, has_aux=True)(
            params, target, episodes, weights, config.discount, program
        )
    )(params, params)
    assert operations_in(traced.jaxpr) == operations.update_operations(
        algo,
        SIZES,
        num_beams=BEAMS,
        goal_size=2,
        num_actions=ACTIONS,
        num_steps=LENGTH,
        batch_size=BATCH,
        burn_in_length=burn_in_length,
    )
