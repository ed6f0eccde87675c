"""Training end to end on the Maze: repeatable, resumable, compiled once, and every preset runs."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly

from sqn_jax.agent.program import Program
from sqn_jax.config import ReplayConfig, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import EnvParams, make_env
from sqn_jax.training import loop
from sqn_jax.training.loop import make_program
from sqn_jax.training.state import RunnerState, memory_bytes

METRICS = {
    *("mean_reward", "success", "time_steps", "collisions", "covered_area", "skill_usage"),
    *(
        "epsilon",
        "discount",
        "updates",
        "skipped_updates",
        "finite",
        "loss",
        "gradient_norm",
        "mean_q",
        "gate_entropy",
        "skill_distance",
    ),
}


@pytest.fixture(scope="module")
def maze() -> EnvParams:
    """The Maze as the paper has it."""
    return make_env("maze")


def world_of(config: TrainConfig, maze: EnvParams) -> EnvParams:
    """What `make_env("maze", config.env)` makes, in less time where only the length differs."""
    if dataclasses.replace(config.env, max_steps=0) == maze.config:
        return dataclasses.replace(maze, config=config.env, max_steps=config.env.max_steps)
    return make_env("maze", config.env)


def small_paper() -> TrainConfig:
    """The paper's preset with four robots, short episodes and a small replay; else unchanged."""
    paper = PRESETS["paper"]
    return dataclasses.replace(
        paper,
        num_envs=4,
        updates_per_round=4,
        total_episodes=24,
        rounds_per_chunk=2,
        env=dataclasses.replace(paper.env, max_steps=24),
        replay=dataclasses.replace(paper.replay, capacity=8, min_episodes=8),
    )


def small_quick() -> TrainConfig:
    """The quick preset with robots for one minibatch and two short windows; else unchanged."""
    quick = PRESETS["quick"]
    learner = dataclasses.replace(quick.learner, window_length=12)
    return dataclasses.replace(
        quick,
        num_envs=quick.learner.batch_size,
        total_episodes=quick.learner.batch_size * quick.rounds_per_chunk,
        env=dataclasses.replace(quick.env, max_steps=2 * learner.window_length),
        learner=learner,
    )


def numbers(tree: Any) -> list[np.ndarray]:
    """Every array of a tree on the host; keys as their words."""
    leaves = jax.tree.leaves(tree)
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in leaves
    ]


def assert_same_bits(one: Any, other: Any) -> None:
    for ours, theirs in zip(numbers(one), numbers(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def all_chunks(runner: RunnerState, run: Trained) -> tuple[RunnerState, list[Any]]:
    """Train to the end with what a run compiled; the final state and the metrics of all rounds."""
    metrics = []
    for _ in range(run.config.num_chunks):
        runner, chunk = run.compiled(runner, run.world)
        metrics.append(jax.device_get(chunk))
    return runner, metrics


@dataclasses.dataclass
class Trained:
    """A run done once for several tests."""

    program: Program
    world: EnvParams
    compiled: loop.CompiledChunk
    final: RunnerState
    metrics: list[Any]
    traces: list[int]
    keys: list[tuple[int, ...]]

    @property
    def config(self) -> TrainConfig:
        return self.program.config


def trained(config: TrainConfig, world: EnvParams) -> Trained:
    """Train once, and note how often a round had been traced after each chunk."""
    program = make_program(world, config)
    count = 0
    body = loop.train_round

    def counted(*args: Any, **kwargs: Any) -> Any:
        nonlocal count
        count += 1
        return body(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "train_round", counted)
        compiled, _ = loop.compile_chunk(world, program)
        runner, metrics, traces = loop.start_run(program), [], []
        keys = [tuple(numbers(runner.key)[0].tolist())]
        for _ in range(config.num_chunks):
            runner, chunk = compiled(runner, world)
            metrics.append(jax.device_get(chunk))
            traces.append(count)
            keys.append(tuple(numbers(runner.key)[0].tolist()))
        again = make_program(world, config)
        for _ in loop.run(loop.start_run(again), world, again):
            traces.append(count)
    return Trained(program, world, compiled, runner, metrics, traces, keys)


@pytest.fixture(scope="module")
def smoke(maze: EnvParams) -> Trained:
    """The smoke preset in full, compiled as it is for users."""
    return trained(PRESETS["smoke"], world_of(PRESETS["smoke"], maze))


@pytest.fixture(scope="module")
def paper(maze: EnvParams) -> Trained:
    with compiling_quickly():
        return trained(small_paper(), world_of(small_paper(), maze))


@pytest.fixture(params=["smoke", "paper"])
def either(request: pytest.FixtureRequest) -> Trained:
    """A run of each method: pqn, which drives in windows, and r2d2, which has a replay."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def other_seed(smoke: Trained) -> tuple[RunnerState, list[Any]]:
    """The smoke preset from the next seed, in the same program."""
    config = dataclasses.replace(smoke.config, seed=smoke.config.seed + 1)
    with compiling_quickly():
        runner = loop.start_run(make_program(smoke.world, config))
    return all_chunks(runner, smoke)


def test_the_program_is_traced_once(either: Trained) -> None:
    """Over all chunks, and again by `run` for an equal program."""
    assert len(either.traces) == 2 * either.config.num_chunks > 2
    assert either.traces[0] > 0
    assert set(either.traces) == {either.traces[0]}


def test_a_state_from_a_checkpoint_gets_the_program_of_a_new_one(smoke: Trained) -> None:
    """Arrays from a checkpoint are bound to their device: JAX would make another program for them,
    and the one that the first start has compiled and kept would be of no use to the second."""
    bound = jax.device_put(smoke.world, jax.devices()[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.stages.Lowered, "compile", lambda lowered, **_: lowered.as_text())
        new, resumed = (
            loop.compile_chunk(world, smoke.program)[0] for world in (smoke.world, bound)
        )
    assert "while" in str(new)
    assert new == resumed


def test_the_same_seed_gives_the_same_numbers_bit_for_bit(either: Trained) -> None:
    runner = loop.start_run(either.program)
    final, metrics = all_chunks(runner, either)
    assert_same_bits(final, either.final)
    assert_same_bits(metrics, either.metrics)


def test_another_seed_gives_other_numbers(
    smoke: Trained, other_seed: tuple[RunnerState, list[Any]]
) -> None:
    final, metrics = other_seed
    kernels = [
        np.asarray(state.learner.params["params"]["perception"]["input_kernel"])
        for state in (final, smoke.final)
    ]
    assert (kernels[0] != kernels[1]).mean() > 0.99
    for name in ("mean_reward", "covered_area", "loss", "mean_q"):
        assert (metrics[0][name] != smoke.metrics[0][name]).all(), name
    np.testing.assert_array_equal(metrics[0]["epsilon"], smoke.metrics[0]["epsilon"])


def test_rounds_differ_from_each_other(either: Trained) -> None:
    """Were the key not carried on, each round would start its robots at the same places."""
    assert len(set(either.keys)) == either.config.num_chunks + 1
    rewards = np.concatenate([chunk["mean_reward"] for chunk in either.metrics])
    assert len(set(rewards.tolist())) == either.config.num_rounds


def test_side_by_side_each_seed_does_what_it_does_alone(
    smoke: Trained, other_seed: tuple[RunnerState, list[Any]]
) -> None:
    """To rounding, which a batched product does in another order.

    Rounding can decide whether a robot has seen a place at the very edge of its sight (0.1 m2 of
    one robot among 16), so that what is seen and learned in one chunk, of 1,920 steps and 8
    updates, agrees to 2 %. Between the two seeds there lies far more.
    """
    program = make_program(smoke.world, dataclasses.replace(smoke.config, num_seeds=2))
    with compiling_quickly():
        runners = loop.start_run(program)
    for index in range(2):
        config = dataclasses.replace(smoke.config, seed=smoke.config.seed + index)
        alone = loop.start_run(make_program(smoke.world, config))
        np.testing.assert_array_equal(numbers(runners.key)[0][index], numbers(alone.key)[0])
        for one, other in zip(
            numbers(runners.learner.params), numbers(alone.learner.params), strict=True
        ):
            np.testing.assert_allclose(one[index], other, atol=1e-5)
    with compiling_quickly():
        compiled, _ = loop.compile_chunk(smoke.world, program)
        _, metrics = compiled(runners, smoke.world)
    for index, alone in enumerate((smoke.metrics[0], other_seed[1][0])):
        for name in METRICS:
            np.testing.assert_allclose(
                metrics[name][index], alone[name], rtol=0.02, atol=1e-3, err_msg=f"{name} {index}"
            )


def test_the_state_given_to_a_chunk_is_donated(either: Trained) -> None:
    runner = loop.start_run(either.program)
    new_runner, _ = either.compiled(runner, either.world)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(runner))
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(new_runner))
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(either.world))


def test_a_run_resumed_mid_way_ends_as_the_uninterrupted_one(either: Trained) -> None:
    config, world, program = either.config, either.world, either.program
    start = loop.start_run(program)
    runner, report = next(loop.run(start, world, program))
    assert report.chunk == 1
    # The next chunk would take the state itself.
    restored = jax.tree.map(jnp.copy, runner)
    reports = []
    for state, report in loop.run(restored, world, program):
        reports.append(report)
        final = state
    assert [report.chunk for report in reports] == list(range(2, config.num_chunks + 1))
    assert_same_bits(final, either.final)
    assert list(loop.run(final, world, program)) == []


def test_reports_say_what_the_rounds_did(either: Trained) -> None:
    config, world, program = either.config, either.world, either.program
    reports = [r for _, r in loop.run(loop.start_run(program), world, program)]
    assert [report.chunk for report in reports] == list(range(1, config.num_chunks + 1))
    for report, rounds in zip(reports, either.metrics, strict=True):
        assert set(report.metrics) == set(rounds) == METRICS
        json.dumps(report.metrics)
        assert report.seconds > 0
        for name in METRICS - {"updates", "skipped_updates", "finite"}:
            np.testing.assert_allclose(report.metrics[name], rounds[name].mean(axis=0), rtol=1e-6)
        assert report.metrics["updates"] == rounds["updates"][-1]
        assert report.metrics["skipped_updates"] == 0
        assert report.metrics["finite"] is True
        assert 0 <= report.metrics["success"] <= 1
        assert 1 <= report.metrics["time_steps"] <= config.env.max_steps
        assert len(report.metrics["skill_usage"]) == 2
        np.testing.assert_allclose(sum(report.metrics["skill_usage"]), 1.0, rtol=1e-5)
    assert np.isfinite([reports[-1].metrics[name] for name in METRICS - {"skill_usage"}]).all()


def test_smoke_counts_its_updates_and_lowers_epsilon_as_worked_out_by_hand(smoke: Trained) -> None:
    # 60 steps in windows of 30, 16 robots in minibatches of 8: four updates a round, four rounds.
    assert smoke.program.num_windows == 2
    assert smoke.program.updates_per_round == 4
    updates = np.concatenate([chunk["updates"] for chunk in smoke.metrics])
    assert updates.tolist() == [4, 8, 12, 16]
    assert int(smoke.final.learner.num_updates) == 16
    assert int(smoke.final.learner.round) == 4
    # From 0.5 towards 0.05 in quarters of 0.45.
    epsilons = np.concatenate([chunk["epsilon"] for chunk in smoke.metrics])
    np.testing.assert_allclose(epsilons, [0.5, 0.3875, 0.275, 0.1625], rtol=1e-5)


def test_a_falling_learning_rate_is_zero_after_the_last_update_of_the_run(smoke: Trained) -> None:
    learner = dataclasses.replace(smoke.config.learner, learning_rate_schedule="linear")
    config = dataclasses.replace(smoke.config, learner=learner)
    optimizer = make_program(smoke.world, config).optimizer
    params = {"w": jnp.zeros(1)}
    opt_state, steps = optimizer.init(params), []
    for _ in range(17):
        updates, opt_state = optimizer.update({"w": jnp.ones(1)}, opt_state, params)
        steps.append(-float(updates["w"][0]))
    # 16 updates in all: the first with 1e-3, the last with a sixteenth of it.
    np.testing.assert_allclose(steps, [1e-3 * (16 - i) / 16 for i in range(17)], rtol=1e-3)


def test_the_small_paper_run_waits_for_its_replay_and_then_updates(paper: Trained) -> None:
    updates = np.concatenate([chunk["updates"] for chunk in paper.metrics])
    losses = np.concatenate([chunk["loss"] for chunk in paper.metrics])
    # Four episodes a round; eight are needed.
    assert updates.tolist() == [0, 4, 8, 12, 16, 20]
    assert np.isnan(losses[0])
    assert np.isfinite(losses[1:]).all()
    assert int(paper.final.learner.memory.size) == 8
    assert (np.asarray(paper.final.learner.memory.priorities) > 0).all()


def test_memory_is_foretold_to_the_byte(paper: Trained) -> None:
    replay_bytes = sum(array.nbytes for array in jax.tree.leaves(paper.final.learner.memory))
    # A round: 25 observations of 73 floats, 24 steps of 9 bytes, 128 floats, for four robots.
    round_bytes = 4 * (25 * 73 * 4 + 24 * (4 + 4 + 1) + 128 * 4)
    assert memory_bytes(paper.program) == replay_bytes + round_bytes
    two_seeds = make_program(paper.world, dataclasses.replace(paper.config, num_seeds=2))
    assert memory_bytes(two_seeds) == 2 * (replay_bytes + round_bytes)


def test_the_replay_of_the_paper_preset_fits_in_half_a_gigabyte(maze: EnvParams) -> None:
    assert maze.max_steps == 400
    assert memory_bytes(make_program(maze, PRESETS["paper"])) < 0.5e9


def test_the_quick_preset_trains_for_a_chunk(maze: EnvParams) -> None:
    config = small_quick()
    world = world_of(config, maze)
    program = make_program(world, config)
    with compiling_quickly():
        _, report = next(loop.run(loop.start_run(program), world, program))
    assert set(report.metrics) == METRICS
    assert np.isfinite(report.metrics["loss"])
    assert report.metrics["updates"] == config.rounds_per_chunk * 2


def test_a_window_that_does_not_divide_the_episode_is_refused_by_name(smoke: Trained) -> None:
    learner = dataclasses.replace(smoke.config.learner, window_length=7)
    config = dataclasses.replace(smoke.config, learner=learner)
    with pytest.raises(ValueError, match=r"^learner.window_length is 7, expected a divisor .* 60"):
        make_program(smoke.world, config)
    # r2d2 stores whole episodes and has no windows.
    whole = dataclasses.replace(config, method="r2d2", replay=ReplayConfig(32, 16))
    assert make_program(smoke.world, whole).num_windows == 1
