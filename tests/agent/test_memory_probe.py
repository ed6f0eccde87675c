"""A task that needs memory, learned with the project's own learn functions.

At one step a lamp shows 0 or 1. Six steps later the robot is asked; the action that names what the
lamp showed earns 1, the other -1. A clock tells when, nothing else tells what.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from small_problems import Seen, random_params

from sqn_jax.agent import Trajectory, initial_carry, pqn, r2d2
from sqn_jax.agent.learner import LearnerState
from sqn_jax.agent.program import Program
from sqn_jax.config import LearnerConfig, NetworkConfig, ReplayConfig, TrainConfig

LENGTH, NUM_ROBOTS, LAMP_STEP, ASKED_STEP = 9, 32, 2, 8
HIDDEN = 12
ROUNDS = 250


def observations(lamps: Array) -> Seen:
    """What robots with these lamps [N] see: ranges [T + 1, N, 2] and a clock [T + 1, N, 1]."""
    steps = jnp.arange(LENGTH + 1)[:, None]
    lit = (steps == LAMP_STEP) & jnp.ones_like(lamps, bool)[None]
    shown = jnp.stack([lit & (lamps == 0)[None], lit & (lamps == 1)[None]], axis=-1)
    clock = jnp.broadcast_to(steps == ASKED_STEP, lit.shape)[..., None]
    return Seen(ranges=shown.astype(jnp.float32), goal=clock.astype(jnp.float32))


def random_round(key: Array) -> Trajectory:
    """Episodes of robots that act at random: which is enough to learn what would be right."""
    lamp_key, action_key = jax.random.split(key)
    lamps = jax.random.randint(lamp_key, (NUM_ROBOTS,), 0, 2)
    actions = jax.random.randint(action_key, (LENGTH, NUM_ROBOTS), 0, 2)
    asked = (jnp.arange(LENGTH) == ASKED_STEP)[:, None]
    earned = jnp.where(actions == lamps[None], 1.0, -1.0)
    return Trajectory(
        obs=observations(lamps),
        actions=actions,
        rewards=jnp.where(asked, earned, 0.0),
        terminated=jnp.broadcast_to(asked, actions.shape),
        carry=jnp.zeros((NUM_ROBOTS, HIDDEN)),
    )


def config_for(algo: str, method: str) -> TrainConfig:
    return TrainConfig(
        algo=algo,
        method=method,
        num_envs=NUM_ROBOTS,
        updates_per_round=2,
        total_episodes=ROUNDS * NUM_ROBOTS,
        network=NetworkConfig(hidden_size=HIDDEN),
        replay=ReplayConfig(capacity=4 * NUM_ROBOTS, min_episodes=NUM_ROBOTS),
        learner=LearnerConfig(
            batch_size=16,
            learning_rate=0.01,
            discount=0.9,
            value_rescaling=False,
            burn_in_length=LAMP_STEP,
            target_update_rate=0.1,
        ),
    )


def answers_after_training(algo: str, method: str, seed: int = 0) -> list[int]:
    """Greedy answers to the lamps 0 and 1 after learning."""
    program = Program(config_for(algo, method), LENGTH, num_actions=2)
    network = program.network
    example = random_round(jax.random.key(seed))
    params = random_params(network, np.random.default_rng(seed), example.obs)
    state = LearnerState(
        params=params,
        target_params=params,
        opt_state=program.optimizer.init(params),
        memory=r2d2.init_memory(example, program) if method == "r2d2" else None,
        round=jnp.int32(0),
        num_updates=jnp.int32(0),
        num_skipped=jnp.int32(0),
    )
    learn = r2d2.learn if method == "r2d2" else pqn.learn

    def one_round(state: LearnerState, key: Array) -> tuple[LearnerState, None]:
        round_key, learn_key = jax.random.split(key)
        return learn(learn_key, state, random_round(round_key), program)[0], None

    @jax.jit
    def train_and_ask(state: LearnerState, key: Array) -> Array:
        state, _ = jax.lax.scan(one_round, state, jax.random.split(key, ROUNDS))
        obs = observations(jnp.arange(2))
        _, output = network.apply(state.params, obs, initial_carry(program.config.network, 2))
        return jnp.argmax(output.q_values[ASKED_STEP], axis=-1)

    return np.asarray(train_and_ask(state, jax.random.key(seed))).tolist()


@pytest.mark.parametrize(("algo", "method"), [("sqn", "r2d2"), ("r2d2", "pqn")])
def test_a_recurrent_network_learns_to_remember(algo: str, method: str) -> None:
    assert answers_after_training(algo, method) == [0, 1]


def test_a_feed_forward_network_answers_both_lamps_alike() -> None:
    """The same answer to both is right half of the time: chance."""
    answers = answers_after_training("dqn", "pqn")
    assert answers[0] == answers[1]
