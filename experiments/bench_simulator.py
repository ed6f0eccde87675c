"""Steps a second of many robots with random actions, beside JaxNav where that is installed.

Rays, coverage, reward and observation for ours; rays, reward and observation for JaxNav
(`pip install jaxmarl`), with one robot, 71 beams of 5 m, with and without its reset in every step.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
from jax import Array

from experiments.timing import Program, time_in_turns
from sqn_jax.env import NUM_ACTIONS, EnvParams, make_env, reset, step
from sqn_jax.scores import markdown_table


@partial(jax.jit, static_argnames=("num_envs", "num_steps"))
def drive_ours(key: Array, params: EnvParams, num_envs: int, num_steps: int) -> Any:
    """Observations and rewards of robots with random actions."""
    start_key, action_key, step_key = jax.random.split(key, 3)
    _, states = jax.vmap(reset, in_axes=(0, None))(jax.random.split(start_key, num_envs), params)

    def body(states: Any, chance: tuple[Array, Array]) -> tuple[Any, Any]:
        actions, keys = chance
        obs, states, reward, _, _, info = jax.vmap(step, in_axes=(0, 0, 0, None))(
            keys, states, actions, params
        )
        return states, (obs, reward, info["reached"])

    chance = draw_actions(action_key, step_key, num_steps, num_envs)
    return jax.lax.scan(body, states, chance)[1]


def draw_actions(
    action_key: Array, step_key: Array, num_steps: int, num_envs: int
) -> tuple[Array, Array]:
    """Random actions and keys for the steps, [T, N] each; drawn alike for both simulators."""
    shape = (num_steps, num_envs)
    actions = jax.random.randint(action_key, shape, 0, NUM_ACTIONS)
    return actions, jax.random.split(step_key, shape)


def ours(params: EnvParams, num_envs: int, num_steps: int) -> Program:
    """Our robots in one world."""
    return lambda turn: drive_ours(jax.random.key(turn), params, num_envs, num_steps)


def jaxnav(num_envs: int, num_steps: int, *, resets: bool) -> Program | None:
    """The same for JaxNav; None where it is not installed."""
    try:
        from jaxmarl.environments.jaxnav import JaxNav
    except ImportError:
        return None
    world = JaxNav(num_agents=1, act_type="Discrete", lidar_num_beams=71, lidar_max_range=5.0)
    advance = world.step if resets else world.step_env

    @jax.jit
    def drive(key: Array) -> Any:
        start_key, action_key, step_key = jax.random.split(key, 3)
        _, states = jax.vmap(world.reset)(jax.random.split(start_key, num_envs))

        def body(states: Any, chance: tuple[Array, Array]) -> tuple[Any, Any]:
            actions, keys = chance
            obs, states, reward, *_ = jax.vmap(advance)(keys, states, {"agent_0": actions})
            return states, (obs["agent_0"], reward["agent_0"])

        return jax.lax.scan(body, states, draw_actions(action_key, step_key, num_steps, num_envs))[
            1
        ]

    return lambda turn: drive(jax.random.key(turn))


def programs(
    maps: Sequence[str], counts: Sequence[int], num_steps: int
) -> dict[tuple[str, int], Program]:
    """What is timed, by name and number of robots."""
    found: dict[tuple[str, int], Program] = {}
    for name in maps:
        params = make_env(name)
        for count in counts:
            found[f"sqn_jax, {name}", count] = ours(params, count, num_steps)
    for resets, name in ((False, "JaxNav"), (True, "JaxNav, reset in every step")):
        for count in counts:
            theirs = jaxnav(count, num_steps, resets=resets)
            if theirs is not None:
                found[name, count] = theirs
    return found


def measure(
    maps: Sequence[str], counts: Sequence[int], num_steps: int, repeats: int
) -> list[dict[str, Any]]:
    """One entry a program: steps a second, the slowest and fastest turn, seconds to compile.

    Args:
        maps: names or files of maps.
        counts: numbers of robots.
        num_steps: steps that each robot makes in one call.
        repeats: turns.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # JaxNav's.
        timings = time_in_turns(programs(maps, counts, num_steps), repeats)
    return [
        {"program": name, "num_envs": count}
        | timing.rates(count * num_steps, unit="steps_per_second")
        for (name, count), timing in timings.items()
    ]


def table(entries: Sequence[dict[str, Any]]) -> str:
    """Steps a second, and how many times those of JaxNav with as many robots."""
    base = {e["num_envs"]: e["steps_per_second"] for e in entries if e["program"] == "JaxNav"}
    rows = []
    for entry in entries:
        ratio = entry["steps_per_second"] / base.get(entry["num_envs"], float("nan"))
        told = f"{ratio:.1f}" if entry["num_envs"] in base else "-"
        speed = f"{entry['steps_per_second']:,}"
        rows.append([entry["program"], str(entry["num_envs"]), speed, told])
    return markdown_table(["program", "robots", "steps a second", "times JaxNav"], rows)
