"""The page's simulator and networks against the program's own, number by number."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiling_quickly
from node import answer, needs_node, run_node
from refusals import refusal
from rooms import small_room
from vectors import rounded, vectors

from sqn_jax.agent.networks import initial_carry
from sqn_jax.baselines.shortest_paths import shortest_path_lengths
from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig
from sqn_jax.env import Observation
from sqn_jax.env.dynamics import move
from sqn_jax.env.navigation import MOTION_ITERATIONS
from sqn_jax.maps import OccupancyMap, connected_components, load_map, traversable
from sqn_jax.maps.atlas import side_by_side
from sqn_jax.play.map_data import map_data
from sqn_jax.play.policy_data import BEYOND, policy_data
from sqn_jax.policies.pretrained import load_pretrained
from sqn_jax.policies.run_policies import Policy
from sqn_jax.training.motion import MotionObservation
from sqn_jax.training.state import network_of, params_shapes

pytestmark = needs_node


def test_the_parts_agree_with_brute_force() -> None:
    ended = run_node("--test", "units.mjs")
    assert ended.returncode == 0, ended.stdout


def test_episodes_are_those_of_the_program(tmp_path: Path) -> None:
    policies = [load_pretrained(name) for name in ("best", "r2d2", "dqn")]
    # One that looks at its last action, which is drawn for it and often refused.
    network = NetworkConfig(hidden_size=16, motion_inputs=True, cell="refined_gru")
    looking_on = dataclasses.replace(policies[1].config, algo="sqn", network=network)
    policies.append(random_policy(looking_on))
    maps = [load_map(name) for name in ("maze", "column", "forest")]
    seeds = [(0, 0, 0), (0, 1, 1), (0, 2, 2), (1, 1, 4), (2, 2, 8), (3, 0, 3)]
    tasks = [(policy, place, seed, policy == 3) for policy, place, seed in seeds]
    with compiling_quickly():
        question = vectors(policies, maps, tasks, num_steps=400)
    reports = answer("parity.mjs", question, tmp_path)
    assert [report["map"] for report in reports[:3]] == ["maze", "column", "forest"]
    for report, episode in zip(reports, question["episodes"], strict=True):
        assert report["wrongActions"] == report["wrongFlags"] == [], report
        assert report["wrongRanges"] == report["wrongPoints"] == 0, report
        assert report["poseError"] < 1e-4
        assert report["rangeError"] < 1e-4
        # Random weights give values of hundreds.
        assert report["qError"] < max(1e-3, 1e-5 * np.abs(episode["q_values"]).max())
        assert report["weightError"] < 1e-4
        assert report["rewardError"] < 1e-5
        # Of 28,400 readings those along a corner, and points on the very edge of a sector.
        assert report["corners"] <= 10, report
        assert report["edges"] <= 2, report
        assert report["latePoints"] <= 4 * (report["corners"] + report["edges"]), report
    # It is no comparison of robots that stand still.
    *_, last = question["episodes"]
    assert set(last["actions"]) == {0, 1, 2, 3, 4}
    assert 2 < sum(last["collisions"]) < 300
    assert any(any(episode["reached"]) for episode in question["episodes"])


ROBOT = {"num_beams": 7, "field_of_view_deg": 270.0, "max_range": 3.0, "max_goal_distance": 10.0}


def tiny(algo: str = "sqn", **changes: Any) -> TrainConfig:
    """A network of 8 units for a robot of 7 beams."""
    env = EnvConfig(**ROBOT, heading_encoding=changes.pop("heading_encoding", "linear"))
    return TrainConfig(algo=algo, env=env, network=NetworkConfig(hidden_size=8, **changes))


NETWORKS = {
    "sqn with 3 skills and norms": tiny(num_skills=3, layer_norm=True, heading_encoding="sincos"),
    "sqn with 1 skill": tiny(num_skills=1),
    "r2d2 with norms": tiny("r2d2", layer_norm=True),
    "sqn with motion": tiny(motion_inputs=True),
    "r2d2 of refined units": tiny("r2d2", cell="refined_gru", motion_inputs=True),
    "dqn": tiny("dqn", heading_encoding="sincos"),
    "dqn with norms and motion": tiny(
        "dqn", layer_norm=True, dqn_width_factor=2, motion_inputs=True
    ),
}
STEPS = 12


def random_policy(config: TrainConfig) -> Policy:
    """Weights of every part, biases and norms among them, large enough to matter."""
    rng = np.random.default_rng(0)
    draw = lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32)  # noqa: E731
    return Policy("tiny", config, (jax.tree.map(draw, params_shapes(config)),))


def random_observations(config: TrainConfig) -> Observation:
    rng = np.random.default_rng(1)
    num_goal = 2 if config.env.heading_encoding == "linear" else 3
    ranges = rng.uniform(size=(STEPS, 1, 7)).astype(np.float32)
    goal = rng.uniform(size=(STEPS, 1, num_goal)).astype(np.float32)
    if not config.network.motion_inputs:
        return Observation(ranges=ranges, goal=goal)
    motion = rng.integers(2, size=(STEPS, 1, 6)).astype(np.float32)
    return MotionObservation(ranges=ranges, goal=goal, motion=motion)


def as_lists(obs: Observation) -> list[dict[str, list[float]]]:
    """A question of one network: what it sees at each step."""
    fields = {name: np.asarray(values)[:, 0].tolist() for name, values in vars(obs).items()}
    return [dict(zip(fields, step, strict=True)) for step in zip(*fields.values(), strict=True)]


def test_networks_of_all_kinds_say_what_the_program_says(tmp_path: Path) -> None:
    policies = [random_policy(config) for config in NETWORKS.values()]
    observations = [random_observations(config) for config in NETWORKS.values()]

    @jax.jit
    def outputs(params: Any, observations: Any) -> Any:
        return [
            network_of(config).apply(one, obs, initial_carry(config.network, 1))[1]
            for config, one, obs in zip(NETWORKS.values(), params, observations, strict=True)
        ]

    with compiling_quickly():
        expected = outputs([rounded(policy).params[0] for policy in policies], observations)
    questions = [
        {"about": "network", "policy": policy_data(policy), "observations": as_lists(obs)}
        for policy, obs in zip(policies, observations, strict=True)
    ]
    answers = answer("answers.mjs", questions, tmp_path)
    for name, said, output in zip(NETWORKS, answers, expected, strict=True):
        for field in ("q_values", "skill_weights"):
            theirs = np.asarray(getattr(output, field))[:, 0]
            ours = np.array([step[field] for step in said])
            error = np.abs(ours - theirs).max()
            assert error < 1e-5 * max(1, np.abs(theirs).max()), (name, field)
        assert [step["action"] for step in said] == output.q_values[:, 0].argmax(-1).tolist(), name


def random_room(rows: int, columns: int, resolution: float, seed: int) -> OccupancyMap:
    """Walls here and there, single cells among them, and more than one part."""
    rng = np.random.default_rng(seed)
    occupied = rng.uniform(size=(rows, columns)) < 0.02
    for _ in range(8):
        row, column = rng.integers(rows), rng.integers(columns)
        height, width = rng.permutation([2, rng.integers(4, 20)])
        occupied[row : row + height, column : column + width] = True
    occupied[:, columns // 2] = True
    occupied[4:9, columns // 2] = seed % 2 == 1
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    points = np.array([[1.0, 1.0], [2.0, 2.0]])
    return OccupancyMap("room", occupied, resolution, points, points, origin=(1.0, -2.0, 0.3))


def test_blocked_cells_parts_and_paths_are_those_of_the_program(tmp_path: Path) -> None:
    # 0.035 / 0.01 comes out a little above 3.5.
    cases = [(0.0, 0.1, 0), (0.1, 0.05, 1), (0.15, 0.05, 2), (0.07, 0.1, 3), (0.035, 0.01, 4)]
    questions, expected = [], []
    for radius, resolution, seed in cases:
        room = random_room(50, 61, resolution, seed)
        free = traversable(room.occupied, resolution, radius)
        rng = np.random.default_rng(seed)
        cells = np.argwhere(free)[rng.integers(free.sum(), size=(12, 2))]
        places = (cells[..., ::-1] + rng.uniform(0.01, 0.99, (12, 2, 2))) * resolution
        places[0, 1] = places[0, 0]
        lengths = shortest_path_lengths(room, places[:, 0], places[:, 1], robot_radius=radius)
        questions.append(
            {"about": "grid", "map": map_data(room), "radius": radius, "tasks": places.tolist()}
        )
        expected.append((room, free, places, lengths))
    said = answer("answers.mjs", questions, tmp_path)
    unreachable = 0
    for given, (room, free, places, lengths) in zip(said, expected, strict=True):
        np.testing.assert_array_equal(np.reshape(given["blocked"], free.shape), ~free)
        assert given["cells"] == map_data(room)["cells"]
        labels, count = connected_components(free)
        ours = np.reshape(given["labels"], free.shape)
        assert given["sizes"] == [0, *np.bincount(ours[free])[1:].tolist()]
        assert len({*zip(labels.flat, ours.flat, strict=True)}) == count + (not free.all())
        for path, place, length in zip(given["paths"], places, lengths, strict=True):
            if path is None:
                assert np.isinf(length)
                unreachable += 1
                continue
            assert path["length"] == pytest.approx(length, rel=1e-5, abs=1e-5)
            check_path(np.array(path["points"]), path["length"], place, free, room.resolution)
    assert 5 < unreachable < 40


def check_path(points: Any, length: float, place: Any, free: Any, resolution: float) -> None:
    """A path is as long as it says, and leads over free cells from the first place to the other."""
    np.testing.assert_array_equal(points[[0, -1]], place)
    points[0] = (np.floor(points[0] / resolution) + 0.5) * resolution
    legs = np.hypot(*np.diff(points, axis=0).T)
    assert legs.sum() == pytest.approx(length)
    between = np.linspace(0, 1, 50)[:, None, None]
    columns, rows = np.floor((points[:-1] * (1 - between) + points[1:] * between).T / resolution)
    assert free[rows.astype(int), columns.astype(int)].all()


def room_map() -> OccupancyMap:
    """The map of `rooms.small_room`."""
    occupied = np.zeros((30, 40), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[14:16, 12:28] = True
    corners = np.array([[0.65, 0.65], [3.35, 0.65]])
    return OccupancyMap("room", occupied, 0.1, corners, corners)


def test_moves_of_any_velocity_end_where_the_program_says(tmp_path: Path) -> None:
    world = small_room(10)
    rng = np.random.default_rng(5)
    free = traversable(room_map().occupied, 0.1, 0.1)
    cells = np.argwhere(free)[rng.integers(free.sum(), size=400)][:, ::-1]
    places = (cells + rng.uniform(0.01, 0.99, (400, 2))) * 0.1
    poses = np.column_stack([places, rng.uniform(-np.pi, np.pi, 400)]).astype(np.float32)
    velocities = rng.normal(size=(400, 2)) * [4, 4]
    velocities[::7, 0] = 0  # Turns on the spot, and straight moves.
    velocities[1::7, 1] = 0
    # A step ends half a millimeter before the border at 3.8 m, or is refused.
    gaps = np.array([-1e-3, 1e-4, 4e-4, 6e-4, 1e-3])
    poses[:5] = np.column_stack([3.8 - 0.25 - gaps, np.full(5, 0.75), np.zeros(5)])
    velocities[:5] = [2.5, 0]
    velocities = velocities.astype(np.float32)

    @jax.jit
    def moved(poses: Any, velocities: Any) -> Any:
        def one(pose: Any, velocity: Any) -> Any:
            return move(
                pose,
                velocity,
                world.body,
                time_step=world.time_step,
                iterations=MOTION_ITERATIONS,
            )

        return jax.vmap(one)(poses, velocities)

    with compiling_quickly():
        ends, refused = moved(poses, velocities)
    question = {
        "about": "moves",
        "settings": vars(world.config),
        "map": map_data(room_map()),
        "poses": poses.tolist(),
        "velocities": velocities.tolist(),
    }
    (said,) = answer("answers.mjs", [question], tmp_path)
    assert [step["collision"] for step in said] == np.asarray(refused).tolist()
    np.testing.assert_allclose([step["pose"] for step in said], np.asarray(ends), atol=2e-6)
    assert refused[:5].tolist() == [True, True, True, False, False]
    assert 40 < refused.sum() < 360
    # Standing still is no move that a robot could notice to be refused.
    assert {tuple(step["motion"]) for step in said} == {(1, 0, 0, 0, 0, 0)}


def test_what_is_observed_under_noise(tmp_path: Path) -> None:
    place = {"map": map_data(room_map()), "pose": [0.8, 0.8, 0.5], "goal": [2.8, 2.3], "noise": 2}
    draws = [-1.0, -0.5, 0.0, 0.25, 0.5, 0.9, 1.0]
    changes: list[dict[str, Any]] = [
        {},
        {"range_noise_unit": "absolute", "heading_encoding": "sincos"},
        {"goal_distance_encoding": "rational", "goal_distance_scale": 10.0},
        {"max_goal_distance": 2.0},
    ]
    questions = [
        {"about": "observation", **place, "draws": draws, "settings": vars(EnvConfig(**ROBOT | x))}
        for x in changes
    ]
    relative, absolute, rational, far = answer("answers.mjs", questions, tmp_path)
    readings = np.array(relative["readings"])
    for said, noisy in [
        (relative, readings * (1 + 2 * np.array(draws))),
        (absolute, readings + 3 * 2 * np.array(draws)),
    ]:
        np.testing.assert_allclose(said["ranges"], np.clip(noisy / 3, 0, 1), atol=1e-6)
        assert said["goal"][0] == pytest.approx(0.25)  # 2 and 1.5 m away are 2.5 of 10 m.
    assert rational["goal"][0] == pytest.approx(2.5 / 12.5)
    assert far["goal"][0] == 1
    heading = np.arctan2(1.5, 2) - 0.5
    assert relative["goal"][1] == pytest.approx((heading + np.pi) / (2 * np.pi), abs=1e-6)
    expected = [(1 + np.sin(heading)) / 2, (1 + np.cos(heading)) / 2]
    np.testing.assert_allclose(absolute["goal"][1:], expected, atol=1e-6)


def test_what_the_page_cannot_compute_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = random_policy(tiny())
    policy.params[0]["params"]["skill_0"]["hidden"]["bias"] = jnp.full(8, 7e4)
    assert refusal(lambda: policy_data(policy)) == (
        "policy tiny: array params/skill_0/hidden/bias has a number of 70000, expected at most "
        "65504"
    )
    monkeypatch.delitem(BEYOND, "network.cell")
    other = random_policy(tiny(cell="refined_gru"))
    assert refusal(lambda: policy_data(other)) == (
        "network.cell is 'refined_gru', which cannot be played, expected 'gru'"
    )
    both = side_by_side([room_map(), room_map()], "both")
    assert refusal(lambda: map_data(both)) == "map both: 2 maps side by side, expected one"
