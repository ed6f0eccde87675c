"""Train PPO in the simulator, all of it in one compiled program: the shape of PureJaxRL.

python examples/purejaxrl_ppo.py --out curve.json

The environment has the interface of gymnax 1.x (`sqn_jax.adapters.gymnax`); the loop is one to
start from for an algorithm of one's own. The network has no memory. The policy is evaluated from
the evaluation points of the map, in the same tasks every time, with actions drawn as in training:
one without memory that takes the likeliest action turns to and fro for ever.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax.training.train_state import TrainState
from jax import Array

from sqn_jax.adapters.gymnax import Navigation
from sqn_jax.storage.files import probe_file

FOUR_ROOMS = f"{Path(__file__).with_name('four_rooms.map')}@0.25"
"""A map of 6 x 6 m, and its scale in m a cell."""

DISCOUNT, TRACE_DECAY, CLIP, ENTROPY, VALUE = 0.99, 0.95, 0.2, 0.01, 0.5
EPOCHS, MINIBATCHES, LEARNING_RATE = 4, 8, 1e-3


class ActorCritic(nn.Module):
    """Logits [..., A] and value [...] of observations [..., R + G]."""

    num_actions: int

    @nn.compact
    def __call__(self, obs: Array) -> tuple[Array, Array]:
        hidden = obs
        for _ in range(2):
            hidden = nn.relu(nn.Dense(128)(hidden))
        logits = nn.Dense(self.num_actions, kernel_init=nn.initializers.orthogonal(0.01))(hidden)
        return logits, nn.Dense(1)(hidden)[..., 0]


class Transition(NamedTuple):
    """One step of N envs, [N, ...]; a rollout is [T, N, ...]."""

    obs: Array
    action: Array
    log_prob: Array
    value: Array
    reward: Array
    """With the value of what comes after a time limit, which ends nothing."""
    done: Array


class Runner(NamedTuple):
    """All that one update hands to the next."""

    learner: TrainState
    env_state: Any
    obs: Array
    key: Array


def advantages(rollout: Transition, last_value: Array) -> Array:
    """Generalized advantage estimates [T, N]."""

    def body(carry: tuple[Array, Array], step: Transition) -> tuple[tuple[Array, Array], Array]:
        advantage, next_value = carry
        going_on = 1.0 - step.done
        error = step.reward + DISCOUNT * next_value * going_on - step.value
        advantage = error + DISCOUNT * TRACE_DECAY * going_on * advantage
        return (advantage, step.value), advantage

    start = (jnp.zeros_like(last_value), last_value)
    return jax.lax.scan(body, start, rollout, reverse=True)[1]


def loss(
    params: Any, learner: TrainState, batch: Transition, advantage: Array, target: Array
) -> Array:
    """PPO's clipped loss of transitions [B]."""
    logits, value = learner.apply_fn(params, batch.obs)
    log_probs = jax.nn.log_softmax(logits)
    log_prob = jnp.take_along_axis(log_probs, batch.action[:, None], axis=1)[:, 0]
    ratio = jnp.exp(log_prob - batch.log_prob)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    entropy = -(jnp.exp(log_probs) * log_probs).sum(axis=1)
    value_loss = 0.5 * jnp.square(value - target)
    return (VALUE * value_loss - gain - ENTROPY * entropy).mean()


def learn(key: Array, learner: TrainState, rollout: Transition, last_value: Array) -> TrainState:
    """A few epochs over the minibatches of a rollout."""
    advantage = advantages(rollout, last_value)
    data = (rollout, advantage, advantage + rollout.value)
    data = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)

    def minibatch(learner: TrainState, indices: Array) -> tuple[TrainState, None]:
        batch, advantage, target = jax.tree.map(lambda x: x[indices], data)
        gradient = jax.grad(loss)(learner.params, learner, batch, advantage, target)
        return learner.apply_gradients(grads=gradient), None

    def epoch(learner: TrainState, key: Array) -> tuple[TrainState, None]:
        order = jax.random.permutation(key, advantage.size).reshape(MINIBATCHES, -1)
        return jax.lax.scan(minibatch, learner, order)

    return jax.lax.scan(epoch, learner, jax.random.split(key, EPOCHS))[0]


def make_train(options: argparse.Namespace) -> Callable[[Array], tuple[Array, Array]]:
    """The whole training as a function of a random key; returns the points of the curve.

    Raises:
        ValueError: the map is unusable.
    """
    env = Navigation(options.map, max_steps=options.max_steps)
    tests = Navigation(options.map, spawn="evaluation", max_steps=options.max_steps)
    network = ActorCritic(env.num_actions)
    over_envs = (0, 0, 0, None)
    num_updates = options.steps // (options.num_envs * options.rollout_steps)
    per_point = num_updates // options.eval_points
    if per_point < 1 or options.num_envs * options.rollout_steps % MINIBATCHES:
        raise ValueError(
            f"--steps {options.steps} are {num_updates} updates, expected at least --eval-points "
            f"({options.eval_points}), each on a multiple of {MINIBATCHES} steps"
        )

    def act_and_step(runner: Runner, key: Array, params: Any) -> tuple[Runner, Transition]:
        action_key, step_key = jax.random.split(key)
        logits, value = network.apply(runner.learner.params, runner.obs)
        action = jax.random.categorical(action_key, logits)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], axis=1)[:, 0]
        keys = jax.random.split(step_key, options.num_envs)
        obs, env_state, reward, terminated, truncated, info = jax.vmap(env.step, over_envs)(
            keys, runner.env_state, action, params
        )
        _, after = network.apply(runner.learner.params, info["final_observation"])
        reward = reward + DISCOUNT * after * truncated
        done = terminated | truncated
        transition = Transition(runner.obs, action, log_prob, value, reward, done)
        return runner._replace(env_state=env_state, obs=obs), transition

    def update(runner: Runner) -> Runner:
        key, rollout_key, learn_key = jax.random.split(runner.key, 3)
        keys = jax.random.split(rollout_key, options.rollout_steps)
        runner, rollout = jax.lax.scan(
            lambda runner, key: act_and_step(runner, key, env.default_params), runner, keys
        )
        _, last_value = network.apply(runner.learner.params, runner.obs)
        learner = learn(learn_key, runner.learner, rollout, last_value)
        return runner._replace(learner=learner, key=key)

    def evaluate(params: Any) -> tuple[Array, Array]:
        world = tests.default_params
        keys = jax.random.split(jax.random.key(1_000), options.eval_episodes)
        start = jax.vmap(tests.reset, (0, None))(keys, world)

        def body(carry: Any, key: Array) -> tuple[Any, Any]:
            obs, state = carry
            action = jax.random.categorical(key, network.apply(params, obs)[0])
            obs, state, reward, _, info = jax.vmap(tests.step_env, over_envs)(
                keys, state, action, world
            )
            return (obs, state), (info["reached"], reward)

        draws = jax.random.split(jax.random.key(2_000), world.max_steps)
        _, (reached, rewards) = jax.lax.scan(body, start, draws)
        return reached.any(axis=0).mean(), rewards.mean()

    def block(runner: Runner, updates: Array) -> tuple[Runner, tuple[Array, Array]]:
        runner = jax.lax.fori_loop(0, updates, lambda _, runner: update(runner), runner)
        return runner, evaluate(runner.learner.params)

    def train(key: Array) -> tuple[Array, Array]:
        network_key, env_key, key = jax.random.split(key, 3)
        keys = jax.random.split(env_key, options.num_envs)
        obs, env_state = jax.vmap(env.reset, (0, None))(keys, env.default_params)
        gradient_steps = per_point * options.eval_points * EPOCHS * MINIBATCHES
        schedule = optax.linear_schedule(LEARNING_RATE, 0.0, gradient_steps)
        optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule, eps=1e-5))
        learner = TrainState.create(
            apply_fn=network.apply, params=network.init(network_key, obs), tx=optimizer
        )
        runner = Runner(learner, env_state, obs, key)
        before_each_point = jnp.full(options.eval_points + 1, per_point).at[0].set(0)
        return jax.lax.scan(block, runner, before_each_point)[1]

    return train


def main() -> None:
    """Parse the arguments, train, write the curve."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--map", default=FOUR_ROOMS, help="as for sqn train")
    parser.add_argument("--max-steps", type=int, default=200, help="of an episode")
    parser.add_argument("--steps", type=int, default=819_200, help="of all envs together")
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--rollout-steps", type=int, default=64, help="steps between updates")
    parser.add_argument("--eval-episodes", type=int, default=100)
    parser.add_argument("--eval-points", type=int, default=10, help="over the run")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="write the curve here, as JSON")
    options = parser.parse_args()
    for name, value in vars(options).items():
        if isinstance(value, int) and name != "seed" and value < 1:
            option = name.replace("_", "-")
            parser.exit(2, f"purejaxrl_ppo: --{option} is {value}, expected 1 or more\n")
    try:
        if options.out is not None:
            probe_file(options.out)
        train = make_train(options)
    except ValueError as error:
        parser.exit(2, f"purejaxrl_ppo: {error}\n")
    key = jax.random.key(options.seed)
    compiled = jax.jit(train).lower(key).compile()
    started = time.perf_counter()
    successes, rewards = jax.device_get(compiled(key))
    seconds = time.perf_counter() - started
    rows, per_update = [], options.num_envs * options.rollout_steps
    for point, (success, reward) in enumerate(zip(successes, rewards, strict=True)):
        steps = point * (options.steps // per_update // options.eval_points) * per_update
        row = {"episodes": steps / options.max_steps, "env_steps": steps}
        rows.append(row | {"eval_success": float(success), "eval_mean_reward": float(reward)})
        print(f"{steps:>9,} steps  success {success:.2f}  reward {reward:.3f}")
    print(f"{seconds:.1f} s")
    if options.out is not None:
        command = " ".join(["python examples/purejaxrl_ppo.py", *sys.argv[1:]])
        data = {"command": command, "trainer": "PPO", "seconds": round(seconds, 1), "curve": rows}
        options.out.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
