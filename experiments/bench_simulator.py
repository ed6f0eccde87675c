"""Steps a second of many robots with random actions, beside JaxNav where that is installed.

Rays, coverage, reward and observation for ours; rays, reward and observation for JaxNav
(`pip install jaxmarl`), with one robot, 71 beams of 5 m, with and without its reset in every step.
Where there are several devices (the cores of a CPU are some: `devices.use_cores`), both are timed
on one and on all of them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from experiments.timing import Timed, time_in_turns
from sqn_jax.agent.shards import AXIS
from sqn_jax.env import NUM_ACTIONS, EnvParams, make_env, reset, step
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.training import devices

Rollout = Callable[[Array, Any, int], Any]
"""Takes a key, what a world is made of, and a number of robots N; returns arrays [T, N, ...]."""


def program(rollout: Rollout, world: Any, num_envs: int, mesh: Mesh | None) -> Timed:
    """Robots on one device, or as many on each of several, with random draws of their own."""
    if mesh is None:
        alone = jax.jit(rollout, static_argnums=2)
        return lambda turn: alone(jax.random.key(turn), world, num_envs)

    def on_one_device(key: Array, world: Any) -> Any:
        own_key = jax.random.fold_in(key, jax.lax.axis_index(AXIS))
        return rollout(own_key, world, num_envs // mesh.size)

    together = jax.jit(
        jax.shard_map(
            on_one_device,
            mesh=mesh,
            in_specs=(PartitionSpec(), PartitionSpec()),
            out_specs=PartitionSpec(None, AXIS),
            check_vma=False,
        )
    )
    placed = devices.place(world, mesh)
    return lambda turn: together(jax.random.key(turn), placed)


def rollout_ours(key: Array, params: EnvParams, num_envs: int, *, num_steps: int) -> Any:
    """Observations and rewards of robots with random actions."""
    start_key, action_key, step_key = jax.random.split(key, 3)
    _, states = jax.vmap(reset, in_axes=(0, None))(jax.random.split(start_key, num_envs), params)

    def body(states: Any, draws: tuple[Array, Array]) -> tuple[Any, Any]:
        actions, keys = draws
        obs, states, reward, _, _, info = jax.vmap(step, in_axes=(0, 0, 0, None))(
            keys, states, actions, params
        )
        return states, (obs, reward, info["reached"])

    draws = draw_actions(action_key, step_key, num_steps, num_envs)
    return jax.lax.scan(body, states, draws)[1]


def draw_actions(
    action_key: Array, step_key: Array, num_steps: int, num_envs: int
) -> tuple[Array, Array]:
    """Random actions and keys for the steps, [T, N] each; drawn alike for both simulators."""
    shape = (num_steps, num_envs)
    actions = jax.random.randint(action_key, shape, 0, NUM_ACTIONS)
    return actions, jax.random.split(step_key, shape)


def jaxnav(num_steps: int, *, resets: bool) -> Rollout | None:
    """The same for JaxNav, whose world is its own; None where it is not installed."""
    try:
        from jaxmarl.environments.jaxnav import JaxNav
    except ImportError:
        return None
    world = JaxNav(num_agents=1, act_type="Discrete", lidar_num_beams=71, lidar_max_range=5.0)
    advance = world.step if resets else world.step_env

    def rollout(key: Array, _: Any, num_envs: int) -> Any:
        start_key, action_key, step_key = jax.random.split(key, 3)
        _, states = jax.vmap(world.reset)(jax.random.split(start_key, num_envs))

        def body(states: Any, draws: tuple[Array, Array]) -> tuple[Any, Any]:
            actions, keys = draws
            obs, states, reward, *_ = jax.vmap(advance)(keys, states, {"agent_0": actions})
            return states, (obs["agent_0"], reward["agent_0"])

        draws = draw_actions(action_key, step_key, num_steps, num_envs)
        return jax.lax.scan(body, states, draws)[1]

    return rollout


def programs(
    maps: Sequence[str], counts: Sequence[int], num_steps: int
) -> dict[tuple[str, int], Timed]:
    """What is timed, by name and number of robots."""
    ours = partial(rollout_ours, num_steps=num_steps)
    rollouts: dict[str, tuple[Rollout | None, Any]] = {
        f"sqn_jax, {name}": (ours, make_env(name)) for name in maps
    }
    for resets, name in ((False, "JaxNav"), (True, "JaxNav, reset in every step")):
        rollouts[name] = (jaxnav(num_steps, resets=resets), None)
    timed: dict[tuple[str, int], Timed] = {}
    for name, (rollout, world) in rollouts.items():
        for mesh in devices.one_and_all():
            for count in counts:
                if rollout is not None and (mesh is None or count % mesh.size == 0):
                    label = name if mesh is None else f"{name}, {mesh.size} devices"
                    timed[label, count] = program(rollout, world, count, mesh)
    return timed


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
        for category in (FutureWarning, UserWarning):  # JaxNav's.
            warnings.simplefilter("ignore", category)
        timings = time_in_turns(programs(maps, counts, num_steps), repeats)
    return [
        {"program": name, "num_envs": count}
        | timing.rates(count * num_steps, unit="steps_per_second")
        for (name, count), timing in timings.items()
    ]


def table(entries: Sequence[dict[str, Any]]) -> str:
    """Steps a second, and how many times those of JaxNav at its best with as many robots."""
    base: dict[int, float] = {}
    for entry in entries:
        if entry["program"].startswith("JaxNav"):
            count, speed = entry["num_envs"], entry["steps_per_second"]
            base[count] = max(speed, base.get(count, 0.0))
    rows = []
    for entry in entries:
        ratio = entry["steps_per_second"] / base.get(entry["num_envs"], float("nan"))
        ratio_text = f"{ratio:.1f}" if entry["num_envs"] in base else "-"
        speed = f"{entry['steps_per_second']:,}"
        rows.append([entry["program"], str(entry["num_envs"]), speed, ratio_text])
    return markdown_table(["program", "robots", "steps a second", "times JaxNav"], rows)
