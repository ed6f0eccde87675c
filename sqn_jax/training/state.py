"""The state of a run: how it begins, and what shape, size and place its arrays have."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jax.sharding import PartitionSpec

from sqn_jax.agent import r2d2, replay
from sqn_jax.agent.learner import LearnerState, init_learner
from sqn_jax.agent.networks import Params, QNetwork, initial_carry, make_network
from sqn_jax.agent.program import Program
from sqn_jax.agent.replay import ReplayState
from sqn_jax.agent.shards import AXIS
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.config import TrainConfig
from sqn_jax.env import NUM_ACTIONS, Observation
from sqn_jax.training.curriculum import initial_success
from sqn_jax.training.devices import REPLICATED
from sqn_jax.training.motion import first_observation

MAX_SKILLS = 256
"""Skills of a network: each is a module of its own in the program."""

MAX_PARAMETERS = 2**27
"""Parameters of all seeds of a run; those of the paper's SQN are 242,060."""


@struct.dataclass
class RunnerState:
    """Everything a run needs to go on; with several seeds, each array has a leading axis [K]."""

    learner: LearnerState
    """Parameters, optimizer, replay and counters."""
    key: Array
    """Randomness still to come."""
    map_success: Array | None = None
    """[MAX_MAPS] recent success on each map; None with `task_sampling` uniform."""


def init_runner(key: Array, program: Program) -> RunnerState:
    """The state of one run before its first round; the key is consumed."""
    # The second is not used: with two children, a seed would give another run than it always has.
    learner_key, _, run_key = jax.random.split(key, 3)
    memory = None
    if program.config.method == "r2d2":
        memory = r2d2.init_memory(trajectory_shapes(program), program)
    learner = init_learner(learner_key, example_obs(program.config), program, memory)
    return RunnerState(learner, run_key, initial_success(program.config))


def example_obs(config: TrainConfig) -> Observation:
    """Zeros in the shape of what the network sees of one step of one robot, [1, 1, ...]."""
    goal_size = 2 if config.env.heading_encoding == "linear" else 3
    obs = Observation(
        ranges=jnp.zeros((1, 1, config.env.num_beams)), goal=jnp.zeros((1, 1, goal_size))
    )
    return first_observation(obs, config.network)


def network_of(config: TrainConfig) -> QNetwork:
    """The network that a run trains."""
    return make_network(config.algo, config.network, NUM_ACTIONS, config.env)


def params_shapes(config: TrainConfig) -> Params:
    """Shapes of the parameters of a run, with a leading axis of seeds where there are several.

    They follow from the config alone: the map need not be at hand.

    Raises:
        ValueError: the network is larger than any that is trained here.
    """
    _require_sensible(config)

    def init() -> Params:
        obs, carry = example_obs(config), initial_carry(config.network, 1)
        params: Params = network_of(config).init(jax.random.key(0), obs, carry)
        return params

    shapes = jax.eval_shape(init)
    seeds = () if config.num_seeds == 1 else (config.num_seeds,)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*seeds, *x.shape), x.dtype), shapes)


def _require_sensible(config: TrainConfig) -> None:
    """Refuse, by arithmetic alone, a network whose description already would take gigabytes."""
    network, beams = config.network, config.env.num_beams
    if network.num_skills > MAX_SKILLS:
        raise ValueError(
            f"network.num_skills is {network.num_skills}, expected at most {MAX_SKILLS}"
        )
    size = network.hidden_size
    width = size * (network.dqn_width_factor if config.algo == "dqn" else 1)
    heads_of = {"sqn": network.num_skills + 1, "r2d2": network.r2d2_width_factor, "dqn": 1}
    heads = heads_of[config.algo]
    count = config.num_seeds * ((beams + 2 * size) * size + 2 * size * width + heads * width**2)
    if count > MAX_PARAMETERS:
        raise ValueError(
            f"network.hidden_size {size}, network.num_skills {network.num_skills}, "
            f"network.dqn_width_factor {network.dqn_width_factor}, network.r2d2_width_factor "
            f"{network.r2d2_width_factor}, env.num_beams {beams} and num_seeds "
            f"{config.num_seeds} are {count:,} parameters or more, expected at most "
            f"{MAX_PARAMETERS:,}"
        )


def trajectory_shapes(program: Program) -> Trajectory:
    """Shapes and dtypes of what `learn` is given.

    Written down, not read off a rollout: to trace the simulator takes a second.
    """
    config, length = program.config, program.window_length
    steps = (length, config.num_envs)
    obs = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((length + 1, config.num_envs, *x.shape[2:]), x.dtype),
        jax.eval_shape(partial(example_obs, config)),
    )
    return Trajectory(
        obs=obs,
        actions=jax.ShapeDtypeStruct(steps, jnp.int32),
        rewards=jax.ShapeDtypeStruct(steps, jnp.float32),
        terminated=jax.ShapeDtypeStruct(steps, jnp.bool_),
        carry=jax.eval_shape(partial(initial_carry, config.network, config.num_envs)),
    )


def memory_bytes(program: Program) -> int:
    """Bytes that the replay of all seeds and the episodes of a round will take, on all devices."""
    config = program.config
    trajectory = trajectory_shapes(program)
    total = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(trajectory))
    if config.method == "r2d2":
        total += replay.num_bytes(r2d2.packed_item(trajectory), config.replay.capacity)
    return config.num_seeds * total


def runner_specs(program: Program) -> RunnerState:
    """How the arrays of a state are divided between devices.

    All of them by seeds, where there are groups of devices for these, and what the replay stores
    by robots.
    """
    seeds = () if program.config.num_seeds == 1 else (program.seed_axis_name,)
    each: Any = REPLICATED if program.seed_axis_name is None else PartitionSpec(*seeds)
    memory: Any = None
    if program.config.method == "r2d2":
        stored: Any = PartitionSpec(*seeds, None, AXIS)
        memory = ReplayState(stored, each, each, each, each)
    learner = LearnerState(
        params=each,
        target_params=each,
        opt_state=each,
        memory=memory,
        round=each,
        num_updates=each,
        num_skipped=each,
    )
    samples_tasks = program.config.task_sampling == "learnability"
    return RunnerState(learner, key=each, map_success=each if samples_tasks else None)
