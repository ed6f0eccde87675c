"""Updates a second of the R2D2 learner, beside PyTorch and beside what the machine can multiply.

An update is that of `sqn_jax.agent.r2d2`: the loss of a batch of whole episodes with burn-in, the
gradient, clipping, Adam, target network, priorities. It is timed from episodes already drawn, and
with drawing them from a replay; several in one compiled scan, as in training. Where PyTorch is
installed, `torch_sqn.py` makes updates of the first kind too, from the same parameters and
episodes, and large float32 matrix products are timed in both libraries. All programs take turns.
Where there are several devices, updates on one and on all of them are timed.
"""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from experiments.operations import update_operations
from experiments.timing import Timed, Timing, four_digits, time_in_turns
from sqn_jax.agent import Trajectory, r2d2, replay
from sqn_jax.agent.learner import LearnerState
from sqn_jax.agent.loss import r2d2_loss
from sqn_jax.agent.program import Program
from sqn_jax.agent.shards import AXIS
from sqn_jax.config import Algorithm, TrainConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.training import devices, loop
from sqn_jax.training.devices import REPLICATED
from sqn_jax.training.state import runner_specs, trajectory_shapes

Name = tuple[str, str]
"""What is timed, an agent or PRODUCT, and in which program."""

PRODUCT = "matrix product"
JAX, SAMPLING = "JAX", "JAX, with sampling"
STORED_BATCHES = 4
"""The replay that is drawn from holds this many times an update's episodes."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """What an agent is timed on: U updates of B episodes."""

    program: Program
    learner: LearnerState
    """With a full replay of random episodes."""
    episodes: Trajectory
    """[U, ...] a batch for each update."""
    weights: Array
    """[U, B] their importance weights."""

    def batch(self, index: int) -> tuple[Trajectory, Array]:
        """Episodes and weights of one update."""
        batch: tuple[Trajectory, Array] = jax.tree.map(
            lambda x: x[index], (self.episodes, self.weights)
        )
        return batch


def make_problem(config: TrainConfig, env_params: EnvParams, num_updates: int) -> Problem:
    """Fresh parameters and random episodes of the shapes that a run with these settings has."""
    batch_size = config.learner.batch_size
    capacity = STORED_BATCHES * batch_size
    settings = dataclasses.replace(config.replay, capacity=capacity, min_episodes=batch_size)
    config = dataclasses.replace(config, method="r2d2", num_envs=batch_size, replay=settings)
    program = loop.make_program(env_params, config)
    learner = loop.start_run(program).learner
    shapes = trajectory_shapes(program)
    rng = np.random.default_rng(config.seed)
    memory = learner.memory
    for _ in range(STORED_BATCHES):
        memory = replay.add(memory, r2d2.pack(random_episodes(rng, shapes)))
    batches = [random_episodes(rng, shapes) for _ in range(num_updates)]
    return Problem(
        program=program,
        learner=dataclasses.replace(learner, memory=memory),
        episodes=jax.tree.map(lambda *x: jnp.stack(x), *batches),
        weights=jnp.asarray(rng.uniform(0.1, 1.0, (num_updates, batch_size)), jnp.float32),
    )


def random_episodes(rng: np.random.Generator, shapes: Trajectory) -> Trajectory:
    """Observations in 0..1, all actions, rewards around 0, no true end."""
    return Trajectory(
        obs=jax.tree.map(lambda x: jnp.asarray(rng.random(x.shape), x.dtype), shapes.obs),
        actions=jnp.asarray(rng.integers(NUM_ACTIONS, size=shapes.actions.shape), jnp.int32),
        rewards=jnp.asarray(rng.normal(size=shapes.rewards.shape), jnp.float32),
        terminated=jnp.zeros(shapes.terminated.shape, bool),
        carry=jnp.zeros(shapes.carry.shape),
    )


def drawn_program(problem: Problem, mesh: Mesh | None) -> Timed:
    """U updates from the problem's batches, in one compiled scan: no drawing, no storing."""
    program = dataclasses.replace(problem.program, mesh=mesh)

    def update(state: LearnerState, batch: tuple[Trajectory, Array]) -> Any:
        state, priorities, metrics = r2d2.learn_from(state, *batch, program)
        return state, (priorities, metrics)

    robots: Any = PartitionSpec(None, AXIS)
    steps: Any = PartitionSpec(None, None, AXIS)
    specs = (Trajectory(steps, steps, steps, steps, robots), robots)
    scan = _scan(update, program, REPLICATED, specs, (robots, REPLICATED))
    batches = devices.place((problem.episodes, problem.weights), mesh, specs)
    learner = devices.place(dataclasses.replace(problem.learner, memory=None), mesh)
    return _carried_on(lambda state, turn: scan(state, batches), learner)


def sampling_program(problem: Problem, mesh: Mesh | None) -> Timed:
    """U whole updates: draw by priority, learn, store the priorities."""
    program = dataclasses.replace(problem.program, mesh=mesh)

    def update(state: LearnerState, key: Array) -> Any:
        return r2d2.update(key, state, program)

    specs = runner_specs(program).learner
    scan = _scan(update, program, specs, REPLICATED, REPLICATED)
    num_updates = problem.weights.shape[0]
    return _carried_on(
        lambda state, turn: scan(state, jax.random.split(jax.random.key(turn), num_updates)),
        devices.place(problem.learner, mesh, specs),
    )


def _scan(update: Any, program: Program, state: Any, inputs: Any, outputs: Any) -> Any:
    """A compiled scan of updates; specs say how state, inputs and outputs are divided."""
    scan = partial(jax.lax.scan, update)
    if program.mesh is not None:
        scan = jax.shard_map(
            scan,
            mesh=program.mesh,
            in_specs=(state, inputs),
            out_specs=(state, outputs),
            check_vma=False,
        )
    return jax.jit(scan, donate_argnums=0)


def _carried_on(update: Callable[[Any, int], tuple[Any, Any]], state: Any) -> Timed:
    """What goes on each time from the state it left; the state is donated."""
    state = jax.tree.map(jnp.copy, state)

    def next_updates(turn: int) -> Any:
        nonlocal state
        state, outputs = update(state, turn)
        return outputs

    return next_updates


def product_program(size: int) -> Timed:
    """A product of two float32 matrices [size, size] in JAX."""
    left, right = jax.random.normal(jax.random.key(0), (2, size, size))
    multiply = jax.jit(jnp.matmul)
    return lambda turn: multiply(left, right)


def torch_programs(
    problem: Problem | None, threads: Sequence[int], product_size: int
) -> dict[Name, Timed]:
    """The same in PyTorch: products and, given a problem of the SQN, U updates from its batches."""
    import torch

    from experiments import torch_sqn

    left, right = torch.randn(2, product_size, product_size)
    found: dict[Name, Timed] = {}
    for count in threads:
        name = torch_name(count)
        found[PRODUCT, name] = _with_threads(count, lambda: left @ right)
        if problem is not None:
            settings = problem.program.config
            learner = torch_sqn.Learner(
                torch_network(problem), settings.learner, settings.replay.max_priority_weight
            )
            batches = [
                torch_sqn.to_torch(*problem.batch(index))
                for index in range(problem.weights.shape[0])
            ]
            found["sqn", name] = _with_threads(count, partial(learner.updates, batches))
    return found


def torch_name(threads: int) -> str:
    """How a program of PyTorch is called."""
    return f"PyTorch, {threads} thread{'s' if threads > 1 else ''}"


def _with_threads(count: int, work: Callable[[], Any]) -> Timed:
    import torch

    def program(turn: int) -> Any:
        torch.set_num_threads(count)
        return work()

    return program


def torch_network(problem: Problem) -> Any:
    """A PyTorch network with the problem's parameters."""
    from experiments import torch_sqn

    obs = problem.episodes.obs
    sizes = (obs.ranges.shape[-1], obs.goal.shape[-1], NUM_ACTIONS)
    network = torch_sqn.SkillQNetwork(problem.program.config.network, *sizes)
    torch_sqn.copy_params(network, problem.learner.params)
    return network


def torch_difference(problem: Problem) -> float:
    """How far the first TD errors of both libraries are apart at most, over the largest of them."""
    import torch

    from experiments import torch_sqn

    params, config = problem.learner.params, problem.program.config.learner
    episodes, weights = problem.batch(0)
    loss = jax.jit(r2d2_loss, static_argnames="program")
    _, output = loss(params, params, episodes, weights, config.discount, problem.program)
    network = torch_network(problem)
    with torch.no_grad():
        batch = torch_sqn.to_torch(episodes, weights)
        _, theirs = torch_sqn.r2d2_loss(network, network, batch, config)
    ours = np.asarray(output.td_errors)
    return float(np.abs(theirs.numpy() - ours).max() / np.abs(ours).max())


def missing_torch() -> str | None:
    """Why there is no comparison with PyTorch; None if there is one."""
    if importlib.util.find_spec("torch") is None:
        return "torch is not installed: no comparison with PyTorch"
    if jax.default_backend() != "cpu":
        return "JAX does not run on the CPU: no comparison with PyTorch, which would"
    return None


def measure(
    config: TrainConfig,
    env_params: EnvParams,
    algos: Sequence[Algorithm],
    repeats: int,
    *,
    torch_threads: Sequence[int],
    num_updates: int = 4,
    product_size: int = 2048,
) -> dict[str, Any]:
    """Time updates of several agents and large matrix products in turns.

    Args:
        config: shapes and settings; the method is `r2d2`, whatever it says.
        env_params: what fits the config's map and robot.
        algos: agents.
        repeats: turns.
        torch_threads: numbers of threads to try PyTorch with; none leaves it out.
        num_updates: U, updates in one call.
        product_size: of the matrices; large enough for the best rate.

    Returns:
        `updates`, one entry an agent and program; `products_gflops`, the rates of the products;
        with PyTorch, how far its first TD errors are from ours.
    """
    problems = {
        algo: make_problem(dataclasses.replace(config, algo=algo), env_params, num_updates)
        for algo in algos
    }
    programs: dict[Name, Timed] = {(PRODUCT, JAX): product_program(product_size)}
    for algo, problem in problems.items():
        for mesh in devices.one_and_all():
            suffix = "" if mesh is None else f", {mesh.size} devices"
            programs[algo, JAX + suffix] = drawn_program(problem, mesh)
            programs[algo, SAMPLING + suffix] = sampling_program(problem, mesh)
    results: dict[str, Any] = {"updates_in_a_call": num_updates, "products_size": product_size}
    if torch_threads:
        programs |= torch_programs(problems.get("sqn"), torch_threads, product_size)
        if "sqn" in problems:
            results["torch_td_error_difference"] = torch_difference(problems["sqn"])
    timings = time_in_turns(programs, repeats)
    rates = {
        program: 2 * product_size**3 / timing.median / 1e9
        for (what, program), timing in timings.items()
        if what == PRODUCT
    }
    results["products_gflops"] = {program: four_digits(rate) for program, rate in rates.items()}
    results["updates"] = [
        _entry(problems[algo], program, timings[algo, program], max(rates.values()))
        for algo in problems
        for what, program in timings
        if what == algo
    ]
    return results


def _entry(
    problem: Problem, program: str, timing: Timing, products_gflops: float
) -> dict[str, Any]:
    """The entry of one agent and program."""
    config, obs = problem.program.config, problem.episodes.obs
    num_updates, num_steps, batch_size = problem.episodes.actions.shape
    operations = update_operations(
        config.algo,
        config.network,
        num_beams=obs.ranges.shape[-1],
        goal_size=obs.goal.shape[-1],
        num_actions=NUM_ACTIONS,
        num_steps=num_steps,
        batch_size=batch_size,
        burn_in_length=config.learner.burn_in_length,
    )
    gflops = num_updates * operations / timing.median / 1e9
    return {
        "algo": config.algo,
        "program": program,
        "batch_size": batch_size,
        "num_steps": num_steps,
        "milliseconds": four_digits(timing.median / num_updates * 1e3),
        **timing.rates(num_updates, unit="updates_per_second"),
        "operations": operations,
        "gflops": four_digits(gflops),
        "share_of_products": four_digits(gflops / products_gflops),
    }


def table(results: dict[str, Any]) -> str:
    """Updates, the share of the products' best rate, and times as fast as PyTorch at its best."""
    base: dict[str, float] = {}
    for entry in results["updates"]:
        if entry["program"].startswith("PyTorch"):
            base[entry["algo"]] = min(entry["milliseconds"], base.get(entry["algo"], float("inf")))
    rows = []
    for entry in results["updates"]:
        algo, milliseconds = entry["algo"], entry["milliseconds"]
        row = [algo, entry["program"], f"{milliseconds:.0f}", f"{entry['updates_per_second']:.3g}"]
        row += [f"{entry['operations'] / 1e9:.1f}", f"{entry['gflops']:.1f}"]
        row.append(f"{entry['share_of_products']:.2f}")
        row.append(f"{base[algo] / milliseconds:.2f}" if algo in base else "-")
        rows.append(row)
    header = ["agent", "program", "ms an update", "updates a second", "GFLOP an update"]
    return markdown_table([*header, "GFLOP/s", "share of products", "times PyTorch"], rows)
