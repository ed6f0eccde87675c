"""Suites of given tasks: episodes as on each map alone, judged by the limits of each task."""

from __future__ import annotations

import dataclasses
import functools
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refusal
from rooms import random_params

from sqn_jax.agent import make_network
from sqn_jax.agent.networks import initial_carry
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.cli import main
from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams, make_env, reset_to, step
from sqn_jax.evaluation import episodes, suite_recording, suite_scores, suites
from sqn_jax.evaluation.agents import BaselineAgent, TrainedAgent
from sqn_jax.evaluation.settings import SuiteSettings
from sqn_jax.maps import OccupancyMap
from sqn_jax.policies.run_policies import Policy
from sqn_jax.runs.evaluate import suite_maps
from sqn_jax.tasks import Task, TaskSuite
from sqn_jax.training.rollout import episode_metrics

LENGTH = 34
NETWORK = NetworkConfig(hidden_size=16)


def room(name: str, rows: int, cols: int, resolution: float, origin: Any) -> OccupancyMap:
    """An empty room of any size, cells and frame."""
    occupied = np.zeros((rows, cols), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    width, height = cols * resolution, rows * resolution
    points = np.array([[0.6, 0.6], [width - 0.6, height - 0.6]])
    return OccupancyMap(name, occupied, resolution, points, points, origin)


ROOMS = {
    "wide": room("wide", 30, 50, 0.1, (-2.0, 1.0, 0.0)),
    "turned": room("turned", 60, 40, 0.05, (0.5, -3.0, 0.7)),
    "coarse": room("coarse", 12, 14, 0.25, (0.0, 0.0, 0.0)),
}


def task(name: str, start: Any, goal: Any, heading: float | None = None, **changes: Any) -> Task:
    """A task by places in the grid's frame."""
    there = ROOMS[name].to_map_frame([start, goal])
    turned = None if heading is None else heading + ROOMS[name].origin[2]
    given = Task(name, tuple(there[0]), turned, tuple(there[1]), LENGTH, 0.3, None)
    return dataclasses.replace(given, **changes)


TASKS = (
    task("wide", (0.75, 0.75), (4.23, 2.23)),
    task("turned", (1.01, 1.52), (1.5, 0.6), heading=3.0),
    task("coarse", (1.6, 1.4), (1.6, 2.0), heading=-1.5, goal_radius=0.7, max_steps=10),
    task("wide", (4.23, 2.23), (0.75, 0.75)),
)
SUITE = TaskSuite("rooms", TASKS)
SETTINGS = SuiteSettings(episodes=2, eval_seeds=2)


def agent(num_seeds: int = 1) -> TrainedAgent:
    config = TrainConfig(algo="sqn", network=NETWORK, num_seeds=num_seeds)
    world = make_env(ROOMS["wide"], config.env)
    network = make_network("sqn", NETWORK, 5)
    params = tuple(random_params(network, world, seed) for seed in range(num_seeds))
    return TrainedAgent("sqn", (Policy("rooms", config, params),))


@pytest.fixture(scope="module")
def chunk() -> suites.SuiteChunk:
    robot = suites.robot_for(EnvConfig(), SUITE)
    (chunk,) = suites.chunks(SUITE, robot, ROOMS.__getitem__)
    return chunk


def test_what_a_suite_says_of_the_body_becomes_what_a_policy_sees() -> None:
    wide = dataclasses.replace(SUITE, robot=(("robot_radius", 0.33),))
    robot = suites.robot_for(EnvConfig(robot_radius=0.1), wide)
    assert (robot.robot_radius, robot.scan_margin) == (0.33, pytest.approx(0.23))
    assert suites.robot_for(EnvConfig(), SUITE).scan_margin == 0.0


def run(chunk: suites.SuiteChunk, policies: TrainedAgent, chosen: Any = slice(None)) -> Any:
    keys = suites._keys(jnp.asarray(chunk.numbers), SETTINGS)[chosen]
    tasks = jax.tree.map(lambda x: x[chosen], chunk.repeated(SETTINGS.tries))
    fields = ("poses", "actions", "rewards", "info")
    return episodes.run_seeds(
        keys,
        policies.stacked_params(),
        chunk.joined,
        policies.network,
        tasks=tasks,
        fields=fields,
    )


def alone(world: EnvParams, start: Any, goal: Any, policies: TrainedAgent) -> Any:
    """An episode of one robot on its own map: a loop over `step`, no batch and no other map."""
    params, network = policies.policies[0].params[0], policies.network
    obs, state = reset_to(jax.random.key(0), start, goal, world)

    def act(carried: Any, _: Any) -> Any:
        obs, state, carry = carried
        carry, output = network.apply(params, jax.tree.map(lambda x: x[None, None], obs), carry)
        action = output.q_values[0, 0].argmax()
        obs, state, *_ = step(jax.random.key(0), state, action, world)
        return (obs, state, carry), (action, state.pose)

    first = obs, state, initial_carry(network.config, 1)
    return jax.lax.scan(act, first, None, length=LENGTH)[1]


def test_each_robot_moves_as_on_its_own_map_alone(chunk: suites.SuiteChunk) -> None:
    assert len({(m.resolution, m.shape) for m in chunk.maps}) == 3
    policies = agent()
    (together,) = run(chunk, policies)
    assert len(np.unique(together.trajectory.actions)) > 2
    compiled = jax.jit(functools.partial(alone, policies=policies))
    which = np.asarray(chunk.repeated(SETTINGS.tries).maps)
    for index in range(0, len(together.goals), SETTINGS.tries):
        world = chunk.worlds[which[index]]
        actions, poses = compiled(world, together.starts[index], together.goals[index])
        np.testing.assert_array_equal(actions, together.trajectory.actions[:, index])
        np.testing.assert_allclose(poses, together.trajectory.poses[1:, index], atol=2e-5)


def test_an_episode_is_the_same_bit_for_bit_without_the_others(chunk: suites.SuiteChunk) -> None:
    (together,) = run(chunk, agent())
    chosen = slice(5, 7)
    (few,) = run(chunk, agent(), chosen)
    ours, theirs = together.of_episodes(chosen), few
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(one, other)


def test_several_policies_in_one_call_run_as_each_alone(chunk: suites.SuiteChunk) -> None:
    both = agent(2)
    results = run(chunk, both)
    for result, params in zip(results, both.policies[0].params, strict=True):
        policy = dataclasses.replace(both.policies[0], params=(params,))
        (own,) = run(chunk, dataclasses.replace(both, policies=(policy,)))
        for one, other in zip(jax.tree.leaves(result), jax.tree.leaves(own), strict=True):
            np.testing.assert_array_equal(one, other)
    first, second = results
    assert (first.trajectory.actions != second.trajectory.actions).any()


def test_starts_and_goals_are_those_of_the_file_in_the_frame_of_the_grid(
    chunk: suites.SuiteChunk,
) -> None:
    (result,) = run(chunk, agent())
    of_tasks = dict(zip(chunk.numbers.tolist(), range(len(TASKS)), strict=True))
    by_hand = {0: (0.75, 0.75), 1: (1.01, 1.52), 2: (1.6, 1.4), 3: (4.23, 2.23)}
    for number, place in by_hand.items():
        tries = slice(of_tasks[number] * SETTINGS.tries, (of_tasks[number] + 1) * SETTINGS.tries)
        np.testing.assert_allclose(result.starts[tries, :2], np.tile(place, (4, 1)), atol=1e-6)
        headings = result.starts[tries, 2]
        if TASKS[number].heading is None:
            assert len(np.unique(headings)) == SETTINGS.tries, "drawn anew for each episode"
        else:
            turned = {1: 3.0, 2: -1.5}[number]
            np.testing.assert_allclose(headings, turned, atol=1e-6)


def reference_metrics(
    distances: Any, refused: Any, rewards: Any, radius: float, limit: int, ends: bool
) -> tuple[bool, int, int, float]:
    """One episode, step by step: success, steps, collisions, mean reward."""
    collisions, total = 0, 0.0
    success, steps, taken = False, limit, 0
    for index in range(limit):
        taken += 1
        total += rewards[index]
        collisions += int(refused[index])
        if distances[index] < radius and not success:
            success, steps = True, index + 1
        if ends and refused[index]:
            break
    return success, steps, collisions, total / taken


@pytest.mark.parametrize("collision_ends", [False, True])
def test_each_episode_is_judged_by_its_own_limits(collision_ends: bool) -> None:
    rng = np.random.default_rng(3)
    steps, robots = 30, 200
    distances = rng.uniform(0, 3, (steps, robots)).astype(np.float32)
    refused = rng.uniform(size=(steps, robots)) < 0.05
    rewards = rng.normal(size=(steps, robots)).astype(np.float32)
    limits = rng.integers(1, steps + 1, robots)
    radii = rng.uniform(0.05, 0.4, robots).astype(np.float32)
    info = {
        "goal_distance": jnp.asarray(distances),
        "collision": jnp.asarray(refused),
        "covered_area": jnp.zeros((steps, robots)),
    }
    trajectory = Trajectory(
        rewards=jnp.asarray(rewards), poses=jnp.zeros((steps + 1, robots, 3)), info=info
    )
    metrics = episode_metrics(
        trajectory, jnp.asarray(radii), jnp.asarray(limits), jnp.bool_(collision_ends)
    )
    for robot in range(robots):
        success, taken, collisions, reward = reference_metrics(
            distances[:, robot],
            refused[:, robot],
            rewards[:, robot],
            radii[robot],
            limits[robot],
            collision_ends,
        )
        assert metrics.success[robot] == success
        assert metrics.time_steps[robot] == taken
        assert metrics.collisions[robot] == collisions
        assert metrics.mean_reward[robot] == pytest.approx(reward, abs=1e-5)
    assert 20 < int(metrics.success.sum()) < 180


@pytest.fixture(scope="module")
def evaluated() -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """An untrained policy, greedy and at random, and both baselines."""
    policy = agent()
    agents = [
        policy,
        dataclasses.replace(policy, name="random", epsilon=1.0),
        BaselineAgent("bug", EnvConfig()),
        BaselineAgent("oracle", EnvConfig()),
    ]
    maps = {EnvConfig().robot_radius: ROOMS.__getitem__}
    return suites.evaluate_suite(agents, SUITE, maps, SETTINGS)


def test_the_table_of_a_suite_says_what_its_interval_and_its_worst_tenth_are(
    evaluated: Any,
) -> None:
    interval, worst = suite_scores.table_notes(evaluated[0])
    assert interval == "95 % interval: over tasks only, one training seed"
    assert "every other try, judged by the rest" in worst
    once = evaluated[0] | {
        "results": [entry | {"worst_tenth_split": None} for entry in evaluated[0]["results"]]
    }
    assert "reads too low" in list(suite_scores.table_notes(once))[1]
    entry = {"worst_tenth": 0.25, "worst_tenth_split": 0.5}
    assert suite_scores.worst_tenth(entry) == 0.5
    assert suite_scores.worst_tenth(entry | {"worst_tenth_split": None}) == 0.25
    # Two maps of two tasks, four tries. Even tries: 0.25, 0.75; odd ones: 1 and 0.5.
    success = np.array([[[1, 1, 0, 1], [0, 1, 0, 1], [1, 0, 1, 0], [1, 1, 0, 1]]], float)
    of_maps = [np.array([True, True, False, False]), np.array([False, False, True, True])]
    assert suite_scores._split_worst(success, of_maps) == (1.0 + 0.75) / 2
    assert suite_scores._split_worst(success[..., :1], of_maps) is None


def test_the_oracle_arrives_on_every_map(evaluated: Any) -> None:
    of_agents = {entry["agent"]: entry for entry in evaluated[0]["results"]}
    assert of_agents["oracle"]["success"]["mean"] == 1.0
    assert of_agents["oracle"]["worst_tenth"] == 1.0
    assert of_agents["oracle"]["spl"]["mean"] > 0.9
    assert [entry["map"] for entry in of_agents["bug"]["maps"]] == ["wide", "turned", "coarse"]


def test_each_policy_is_compared_to_the_wall_follower_in_a_line(evaluated: Any) -> None:
    lines = list(suite_scores.comparison_lines(evaluated[0]))
    assert [line.split(" against ")[0] for line in lines] == ["sqn", "random"]
    means = {entry["agent"]: entry["success"]["mean"] for entry in evaluated[0]["results"]}
    for name, line in zip(("sqn", "random"), lines, strict=True):
        assert f"against bug: {means[name] - means['bug']:+.2f} success, " in line


def test_the_numbers_are_means_of_the_records(evaluated: Any) -> None:
    contents, records = evaluated
    assert len(records) == 4 * len(TASKS) * SETTINGS.tries
    for entry in contents["results"]:
        own = [record for record in records if record["agent"] == entry["agent"]]
        for name in suite_scores.METRICS:
            mean = np.mean([record[name] for record in own])
            assert entry[name]["mean"] == pytest.approx(mean), name
        for number, of_task in enumerate(entry["tasks"]):
            rates = [record["success"] for record in own if record["task"] == number]
            assert of_task["success"] == pytest.approx(np.mean(rates))
    json.dumps(contents, allow_nan=False)


def test_the_length_of_the_shortest_path_is_the_straight_line_in_an_empty_room(
    evaluated: Any,
) -> None:
    lengths = {record["task"]: record["shortest_path_m"] for record in evaluated[1]}
    for number, given in enumerate(TASKS):
        straight = np.hypot(*np.subtract(given.goal, given.start))
        assert straight * 0.98 < lengths[number] < straight * 1.03 + 0.05


def test_failures_take_the_limit_of_their_task(evaluated: Any) -> None:
    for record in evaluated[1]:
        assert record["time_steps"] <= TASKS[record["task"]].max_steps
        if not record["success"]:
            assert record["time_steps"] == TASKS[record["task"]].max_steps


def test_a_recorded_task_is_the_first_try_of_the_evaluation_to_its_own_limit(
    evaluated: Any,
) -> None:
    """Whatever the order asked for, and without the others of their maps."""
    load = ROOMS.__getitem__
    settings = suite_recording.first_try(SETTINGS.seed)
    numbers = [2, 0]
    recorded = suite_recording.record_tasks(agent(), SUITE, numbers, load, settings)
    firsts = [r for r in evaluated[1] if r["agent"] == "sqn" and r["eval_seed"] == SETTINGS.seed]
    for number, one in zip(numbers, recorded, strict=True):
        (record,) = (r for r in firsts if r["task"] == number and r["episode"] == 0)
        assert one.occupancy_map is ROOMS[TASKS[number].map_file]
        assert one.num_steps == TASKS[number].max_steps == len(one.trajectory.covered) - 1
        assert one.success == record["success"]
        assert one.time_steps == record["time_steps"]
        assert one.rewards.mean() == pytest.approx(record["mean_reward"], rel=1e-5)
        assert one.goal_radius == pytest.approx(TASKS[number].goal_radius)


@pytest.mark.parametrize(
    ("collisions", "collision_ends", "expected"),
    [([3, 5], True, 4), ([3, 5], False, 10), ([12], True, 10), ([], True, 10)],
)
def test_a_recorded_task_ends_where_its_episode_does(
    collisions: list[int], collision_ends: bool, expected: int
) -> None:
    refused = np.isin(np.arange(LENGTH), collisions)
    one: Any = SimpleNamespace(collisions=refused)
    assert suite_recording._length(one, TASKS[2], collision_ends) == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--maps", "maze"], "--maps: not with --tasks"),
        (["--goal-radius", "1"], "--goal-radius: not with --tasks"),
        (["--max-steps", "3"], "--max-steps: not with --tasks"),
        (["--velocity-noise", "0.1", "0.2"], "2 levels, expected one"),
        ([], "tasks[0].start (0, 0) lies in an obstacle on map maze"),
        (["--epsilon", "1.5"], "epsilon is 1.5, expected at least 0 and at most 1"),
        (["--epsilon", "0", "0"], "epsilon: 0.0 comes twice"),
        (["--params", "target"], "has no target parameters"),
    ],
)
def test_what_cannot_be_evaluated_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "suite.json"
    in_a_wall = {"map": "maze", "start": [0, 0, None], "goal": [2, 2]}
    file.write_text(json.dumps({"schema": 1, "name": "wall", "tasks": [in_a_wall]}))
    assert main(["evaluate", "pretrained:dqn", "--tasks", str(file), *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_results_do_not_replace_the_tasks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "suite.json"
    file.write_text("the tasks")
    monkeypatch.chdir(tmp_path)
    for out in (str(file), "suite.json", "../" + tmp_path.name + "/suite.json"):
        assert main(["evaluate", "--tasks", str(file), "--out", out]) == 2
        error = capsys.readouterr().err
        assert "is the file of --tasks, expected another one" in error
    assert file.read_text() == "the tasks"


@pytest.mark.parametrize("command", ["evaluate", "render"])
def test_a_bumper_is_said_by_the_suite_or_by_the_option(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "suite.json"
    task = {"map": "maze", "start": [1.0, 1.0, None], "goal": [2.0, 1.0]}
    contents = {"schema": 1, "name": "one", "tasks": [task], "robot": {"bumper": 0.1}}
    file.write_text(json.dumps(contents))
    arguments = ["pretrained:dqn", "--tasks", str(file), "--bumper", "0.05"]
    assert main([command, *arguments, "--out", str(tmp_path / "out.json")]) == 2
    assert "--bumper: not with a file of tasks whose robot says it" in capsys.readouterr().err


def test_a_chunk_is_made_while_the_one_before_is_used() -> None:
    made: list[int] = []
    second_is_made = threading.Event()

    def items() -> Iterator[int]:
        for item in (1, 2, 3):
            made.append(item)
            if item == 2:
                second_is_made.set()
            yield item

    ahead = suites.one_ahead(items())
    assert next(ahead) == 1
    assert second_is_made.wait(10), "while the first is used"
    assert 3 not in made, "no more than one"
    assert list(ahead) == [2, 3]


def test_a_robot_that_an_agent_cannot_control_is_refused_before_anything_is_run() -> None:
    """Its network takes 71 beams; both baselines have to move."""
    config = TrainConfig(network=NETWORK)
    network = make_network("sqn", NETWORK, NUM_ACTIONS)
    params = random_params(network, make_env(ROOMS["wide"], EnvConfig()))
    trained = TrainedAgent("mine", (Policy("mine", config, (params,)),))
    oracle, bug = (BaselineAgent(name, EnvConfig()) for name in ("oracle", "bug"))

    def refused(agent: Any, **robot: float) -> str:
        suite = TaskSuite("some", (task("wide", (1, 1), (2, 1)),), tuple(robot.items()))
        return refusal(lambda: suite_maps([agent], suite))

    said = refused(trained, num_beams=10)
    assert said == "robot.num_beams is 10, expected 71, with which mine was trained"
    for agent in (oracle, bug):
        for slow in ({"forward_speed": 0.0}, {"turn_rate": 0.0}):
            assert refused(agent, **slow).startswith("the robot cannot move or turn")


def test_what_goes_wrong_ahead_is_said_in_its_turn() -> None:
    def items() -> Iterator[int]:
        yield 1
        raise ValueError("the second map")

    ahead = suites.one_ahead(items())
    assert next(ahead) == 1
    with pytest.raises(ValueError, match="the second map"):
        next(ahead)
