"""Where the time goes: the pieces of a simulator's step, the halves of a training window."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from experiments.bench_simulator import draw_actions
from experiments.timing import Timed, four_digits, time_in_turns
from sqn_jax.agent import pqn
from sqn_jax.config import TrainConfig
from sqn_jax.env import EnvParams, EnvState, coverage, navigation, true_ranges
from sqn_jax.env.dynamics import move
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.training import loop
from sqn_jax.training.rollout import random_draws, start_actors, unroll

Piece = Callable[[EnvState, Array, EnvParams], tuple[EnvState, Any]]
"""One part of a step of one robot: state, action and world to the next state and a result."""


def whole_step(state: EnvState, action: Array, params: EnvParams) -> tuple[EnvState, Any]:
    """All of it, as the benchmark of the simulator has it."""
    obs, state, reward, *_ = navigation.step(jax.random.key(0), state, action, params)
    return state, (obs, reward)


def motion(state: EnvState, action: Array, params: EnvParams) -> tuple[EnvState, Any]:
    """Only drive, with the collision check."""
    pose, refused = move(
        state.pose,
        params.commands[action],
        params.body,
        time_step=params.time_step,
        iterations=navigation.MOTION_ITERATIONS,
    )
    return dataclasses.replace(state, pose=pose), refused


def rays(state: EnvState, action: Array, params: EnvParams) -> tuple[EnvState, Any]:
    """Move and look."""
    state, _ = motion(state, action, params)
    return state, true_ranges(state.pose, params)


def rays_and_coverage(state: EnvState, action: Array, params: EnvParams) -> tuple[EnvState, Any]:
    """Move, look, and mark what is seen."""
    state, ranges = rays(state, action, params)
    covered, fresh = coverage.add_scan(
        state.covered,
        state.pose,
        ranges,
        field_of_view=navigation.field_of_view(params),
        lattice=params.lattice,
    )
    return dataclasses.replace(state, covered=covered), (ranges, fresh)


PIECES: dict[str, Piece] = {
    "motion": motion,
    "motion, rays": rays,
    "motion, rays, coverage": rays_and_coverage,
    "whole step": whole_step,
}


def piece_program(piece: Piece, params: EnvParams, num_envs: int, num_steps: int) -> Timed:
    """A piece for N robots with random actions, T steps in one compiled scan."""
    start_key, action_key, step_key = jax.random.split(jax.random.key(0), 3)
    _, states = jax.jit(jax.vmap(navigation.reset, in_axes=(0, None)))(
        jax.random.split(start_key, num_envs), params
    )
    actions, _ = draw_actions(action_key, step_key, num_steps, num_envs)

    @jax.jit
    def rollout(states: EnvState, actions: Array, params: EnvParams) -> Any:
        one_step = jax.vmap(piece, in_axes=(0, 0, None))
        return jax.lax.scan(
            lambda states, action: one_step(states, action, params), states, actions
        )

    return lambda turn: rollout(states, actions, params)


def window_programs(config: TrainConfig, params: EnvParams) -> dict[str, Timed]:
    """The two halves of a window of recurrent PQN: roll it out, learn from it."""
    program = loop.make_program(params, config)
    network = program.network
    learner = loop.start_run(program).learner
    key = jax.random.key(1)
    keys = jax.random.split(key, config.num_envs)
    actors = jax.jit(lambda keys, params: start_actors(keys, params, network))(keys, params)
    epsilon = jnp.zeros(config.num_envs)

    @jax.jit
    def rollout(learner: Any, actors: Any, params: EnvParams) -> Any:
        draws = random_draws(key, program.window_length, config.num_envs)
        return unroll(draws, learner.params, actors, epsilon, params, network)[1].for_learning()

    @jax.jit
    def learn(learner: Any, trajectory: Any) -> Any:
        return pqn.learn(key, learner, trajectory, program)[0]

    trajectory = rollout(learner, actors, params)
    return {
        "roll out a window": lambda turn: rollout(learner, actors, params),
        "learn from a window": lambda turn: learn(learner, trajectory),
    }


def measure(
    config: TrainConfig, params: EnvParams, num_steps: int, repeats: int
) -> list[dict[str, Any]]:
    """Microseconds a robot and step of each piece; all take turns.

    Args:
        config: a run by the method `pqn`; its robots are those of all pieces.
        params: its world.
        num_steps: steps of the simulator's pieces in one call.
        repeats: turns.
    """
    programs: dict[str, Timed] = {
        name: piece_program(piece, params, config.num_envs, num_steps)
        for name, piece in PIECES.items()
    }
    windows = window_programs(config, params)
    window_steps = loop.make_program(params, config).window_length
    timings = time_in_turns(programs | windows, repeats)
    entries = []
    for name, timing in timings.items():
        steps = config.num_envs * (window_steps if name in windows else num_steps)
        microseconds = {
            "microseconds": four_digits(timing.median / steps * 1e6),
            "fastest": four_digits(min(timing.seconds) / steps * 1e6),
            "slowest": four_digits(max(timing.seconds) / steps * 1e6),
        }
        entries.append({"piece": name, "num_envs": config.num_envs} | microseconds)
    return entries


def table(entries: list[dict[str, Any]]) -> str:
    """Microseconds a robot and step."""
    rows = [[entry["piece"], f"{entry['microseconds']:.2f}"] for entry in entries]
    return markdown_table(["piece", "us a robot and step"], rows)
