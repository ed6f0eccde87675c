"""`sqn evaluate` on a tiny run: what the files hold, and that every agent met the same tasks."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rooms import write_empty_room

from sqn_jax.baselines.shortest_paths import shortest_path_lengths
from sqn_jax.cli import main
from sqn_jax.config import EnvConfig, TrainConfig
from sqn_jax.evaluation.agents import (
    BaselineAgent,
    TrainedAgent,
    group_policies,
    with_baselines,
)
from sqn_jax.evaluation.compare import (
    _distinct_names,
    evaluate_agents,
    load_maps,
    num_episodes,
)
from sqn_jax.evaluation.settings import Settings, robot_for, worlds
from sqn_jax.maps import (
    OccupancyMap,
    goal_distance,
    load_map,
    points_to_cells,
    save_map,
    traversable,
)
from sqn_jax.policies.run_policies import Policy, load_policy

TINY = ["--preset", "smoke", "--env.max-steps", "30", "--eval.episodes", "4", "--num-seeds", "2"]
EPISODES, EVAL_SEEDS = 3, 2
MAZE_FILE = Path(__file__).resolve().parents[2] / "maps" / "maze.yaml"


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map on which shortest paths are found in little time, with enough places for tasks."""
    path = write_empty_room(tmp_path_factory.mktemp("map"))
    text = path.read_text()
    corners = "evaluation_points: [[0.8, 0.8], [4.2, 3.2]"
    assert corners in text
    text = text.replace(corners, f"{corners}, [0.8, 3.2], [4.2, 0.8], [2.5, 2.0]")
    path.write_text(text + "max_steps: 40\n")
    return path


@pytest.fixture(scope="module")
def as_trained(room: Path) -> list[str]:
    """Words of `evaluate`: the map and the episodes that the tiny run was trained on."""
    return ["--maps", str(room), "--max-steps", "30"]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory, room: Path) -> Path:
    """Two training seeds side by side, moved away from where they were trained."""
    folder = tmp_path_factory.mktemp("runs")
    words = ["train", *TINY, "--map", str(room), "--run-dir", str(folder / "here")]
    assert main(words) == 0
    shutil.move(folder / "here", folder / "elsewhere")
    return folder / "elsewhere"


@pytest.fixture(scope="module")
def evaluated(
    run_dir: Path, as_trained: list[str]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Results and records of the tiny run and the references, with and without noise."""
    words = ["evaluate", str(run_dir), *as_trained, "--episodes", str(EPISODES)]
    words += ["--eval-seeds", str(EVAL_SEEDS), "--velocity-noise", "0.2", "--range-noise", "0.4"]
    assert main([*words, "--out", str(run_dir.parent / "found.json")]) == 0
    found = json.loads((run_dir.parent / "found.json").read_text())
    lines = (run_dir.parent / "found.jsonl").read_text().splitlines()
    assert (found["schema"], found["std_ddof"]) == (1, 1)
    return found["results"], [json.loads(line) for line in lines]


def test_every_agent_world_and_radius_has_an_entry(
    evaluated: tuple[list[dict[str, Any]], list[dict[str, Any]]],
) -> None:
    results, records = evaluated
    assert len(results) == 3 * 3 * 2  # Agents, noises, radii.
    noises = {(entry["velocity_noise"], entry["range_noise"]) for entry in results}
    assert noises == {(0.0, 0.0), (0.2, 0.0), (0.0, 0.4)}
    policies = {"sqn": 2, "bug": 1, "oracle": 1}
    assert len(records) == sum(policies.values()) * 3 * 2 * EVAL_SEEDS * EPISODES
    for entry in results:
        assert entry["training_seeds"] == ([0, 1] if entry["agent"] == "sqn" else [None])
        assert ("iqm" in entry["success"]) == (entry["agent"] == "sqn")
        own = [
            record
            for record in records
            if all(
                record[name] == entry[name]
                for name in ("agent", "velocity_noise", "range_noise", "goal_radius")
            )
        ]
        for name in ("success", "time_steps", "spl", "collisions", "coverage_m2"):
            mean = np.mean([record[name] for record in own])
            assert entry[name]["mean"] == pytest.approx(mean), name


def test_every_agent_meets_the_same_tasks_under_every_noise(
    evaluated: tuple[list[dict[str, Any]], list[dict[str, Any]]],
) -> None:
    tasks = defaultdict(set)
    for record in evaluated[1]:
        place = (tuple(record["start"]), tuple(record["goal"]))
        tasks[record["eval_seed"], record["episode"]].add(place)
    assert len(tasks) == EVAL_SEEDS * EPISODES
    assert all(len(places) == 1 for places in tasks.values())
    assert len({places.pop() for places in tasks.values()}) == EVAL_SEEDS * EPISODES


def test_the_policy_is_the_one_the_training_ended_with(
    run_dir: Path, as_trained: list[str], tmp_path: Path
) -> None:
    """The same episodes as in the run's own evaluation, from the run folder alone."""
    words = ["evaluate", str(run_dir), *as_trained, "--episodes", "4", "--eval-seeds", "1"]
    words += ["--goal-radius", "0.3", "--tasks", "points", "pairs", "--no-baselines"]
    assert main([*words, "--out", str(tmp_path / "again.json")]) == 0
    again = [json.loads(line) for line in (tmp_path / "again.jsonl").read_text().splitlines()]
    own = [json.loads(line) for line in (run_dir / "evaluation.jsonl").read_text().splitlines()]
    assert len(again) == len(own) == 2 * 2 * 4
    assert again == own


def test_runs_that_differ_in_their_seeds_are_one_agent() -> None:
    def run(name: str, **changes: Any) -> Policy:
        config = dataclasses.replace(TrainConfig(), **changes)
        return Policy(name, config, tuple({} for _ in range(config.num_seeds)))

    agents = group_policies([run("a", seed=3), run("b", seed=5, num_seeds=2), run("c", algo="dqn")])
    assert [agent.name for agent in agents] == ["sqn", "dqn"]
    assert list(agents[0].training_seeds) == [3, 5, 6]
    told_apart = group_policies([run("a"), run("b", num_envs=100)])
    assert [agent.name for agent in told_apart] == ["sqn a", "sqn b"]
    with pytest.raises(ValueError, match="a, b: the same settings and the same training seed"):
        group_policies([run("a", seed=3), run("b", seed=2, num_seeds=2)])


def test_baselines_have_the_robot_of_the_first_agent() -> None:
    config = TrainConfig()
    narrow = dataclasses.replace(config, env=dataclasses.replace(config.env, robot_radius=0.05))
    agents = with_baselines([TrainedAgent("sqn", (Policy("a", narrow, ({},)),))], baselines=True)
    assert [agent.name for agent in agents] == ["sqn", "bug", "oracle"]
    assert all(agent.env_config.robot_radius == 0.05 for agent in agents)
    assert num_episodes(agents, Settings(maps=("maze", "cave"), episodes=7)) == 3 * 2 * 5 * 7


def test_the_shortest_paths_are_read_off_each_goal_s_own_field(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    occupancy_map = load_map("maze")
    rng = np.random.default_rng(0)
    places = rng.choice(occupancy_map.spawn_points, 7)
    goals = occupancy_map.spawn_points[[3, 9, 9, 40, 3, 22, 50]]
    starts = np.concatenate([places, np.zeros((7, 1))], axis=1)
    # Two fields at a time, so that the last batch is not full.
    monkeypatch.setattr("sqn_jax.maps.distance.FIELD_CELLS", 2 * 340 * 340)
    found = shortest_path_lengths(occupancy_map, starts, goals, robot_radius=0.1)
    free = traversable(occupancy_map.occupied, occupancy_map.resolution, 0.1)
    for episode in range(7):
        field = goal_distance(free, occupancy_map.resolution, goals[episode])
        row, column = points_to_cells(starts[episode, :2], occupancy_map.resolution)
        assert found[episode] == pytest.approx(field[row, column])
        straight = np.hypot(*(goals[episode] - starts[episode, :2]))
        assert found[episode] >= straight - 0.05


def test_the_step_limit_is_the_map_s_whatever_the_run_was_trained_with(
    run_dir: Path, room: Path, tmp_path: Path
) -> None:
    words = ["evaluate", str(run_dir), "--maps", str(room), "--episodes", "1", "--eval-seeds", "1"]
    assert main([*words, "--no-baselines", "--out", str(tmp_path / "found.json")]) == 0
    lines = (tmp_path / "found.jsonl").read_text().splitlines()
    failures = [record for record in map(json.loads, lines) if not record["success"]]
    assert {record["time_steps"] for record in failures} == {40}


def test_a_map_is_judged_by_each_robot_s_own_radius(tmp_path: Path) -> None:
    """A gap of 0.3 m between start and goal: wide enough for one robot, too narrow for another."""
    occupied = np.zeros((40, 60), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[:, 30] = True
    occupied[17:23, 30] = False
    points = np.array([[0.525, 1.0], [2.525, 1.0]])
    save_map(
        OccupancyMap("gap", occupied, 0.05, points, points, max_steps=50), tmp_path / "gap.yaml"
    )
    agents = [BaselineAgent("bug", EnvConfig(robot_radius=radius)) for radius in (0.1, 0.05)]
    settings = Settings(maps=(str(tmp_path / "gap.yaml"),), episodes=1)
    assert set(load_maps(agents, settings)) == {(settings.maps[0], 0.1), (settings.maps[0], 0.05)}
    agents.append(BaselineAgent("bug", EnvConfig(robot_radius=0.2)))
    with pytest.raises(ValueError, match="gap"):
        load_maps(agents, settings)


def test_files_of_one_name_are_told_apart_by_their_folders() -> None:
    names = {
        "/x/hall/map.yaml": "map",
        "/x/yard/map.yaml": "map",
        "maze": "maze",
        "/m/maze.yaml": "maze",
    }
    assert list(_distinct_names(names).values()) == ["hall/map", "yard/map", "maze", "m/maze"]
    deeper = {"/a/x/map.yaml": "map", "/b/x/map.yaml": "map", "/b/x/map.map": "map"}
    assert list(_distinct_names(deeper).values()) == ["a/x/map", "b/x/map.yaml", "x/map.map"]
    with pytest.raises(ValueError, match="one file twice"):
        _distinct_names({"/x/map.yaml": "map", "/x/../x/map.yaml": "map"})


def test_the_robot_of_an_evaluation_may_have_another_radius() -> None:
    settings = Settings(maps=("maze",), episodes=1, robot_radius=0.3)
    assert set(load_maps([BaselineAgent("bug", EnvConfig())], settings)) == {("maze", 0.3)}


def test_a_wider_body_sees_obstacles_thicker_by_the_difference() -> None:
    trained = EnvConfig(robot_radius=0.1)
    for radius, margin in ((0.33, 0.23), (0.1, 0.0), (0.05, 0.0), (None, 0.0)):
        robot = robot_for(trained, Settings(maps=("maze",), robot_radius=radius))
        assert robot.robot_radius == (radius or 0.1)
        assert robot.scan_margin == pytest.approx(margin)


def test_the_oracle_is_that_of_all_robots_that_differ_in_what_they_see(tmp_path: Path) -> None:
    path = write_empty_room(tmp_path)
    settings = Settings(maps=(str(path),), episodes=3, eval_seeds=1)
    far, slow = EnvConfig(goal_distance_encoding="rational"), EnvConfig(forward_speed=1.0)
    agents = [BaselineAgent("oracle", EnvConfig()), BaselineAgent("bug", far)]
    evaluation, _ = evaluate_agents(agents, load_maps(agents, settings), settings)
    ratios = {one["agent"]: one["steps_over_oracle"] for one in evaluation["results"]}
    assert ratios["bug"]["mean"] > 1.0
    # Another robot takes other ways.
    agents = [agents[0], BaselineAgent("bug", slow)]
    evaluation, _ = evaluate_agents(agents, load_maps(agents, settings), settings)
    assert evaluation["results"][-1]["agent"] == "bug"
    assert evaluation["results"][-1]["steps_over_oracle"] is None


def test_the_wall_follower_sees_obstacles_as_they_are() -> None:
    # It keeps away from what it sees by its own width.
    settings = Settings(maps=("maze",), episodes=2, eval_seeds=1, max_steps=60)
    runs = []
    for margin in (0.0, 0.3):
        robot = dataclasses.replace(robot_for(EnvConfig(), settings), scan_margin=margin)
        (world,) = worlds(robot, {("maze", 0.1): load_map("maze")}, settings)
        ((results,),) = BaselineAgent("bug", robot).run([5], world, settings, ("obs",), id)
        runs.append(results.trajectory.obs.ranges)
    np.testing.assert_array_equal(*runs)


def test_a_damaged_file_is_named_in_one_line_and_nothing_is_driven(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refusal(words: list[str]) -> str:
        capsys.readouterr()
        assert main(["evaluate", *words, "--no-baselines", "--episodes", "1"]) == 2
        stderr = capsys.readouterr().err
        assert stderr.startswith("sqn: ")
        assert stderr.count("\n") == 1, stderr
        return stderr

    no_yaml = tmp_path / "bad.yaml"
    no_yaml.write_text("image: [")
    assert "bad.yaml" in refusal([str(run_dir), "--maps", "maze", str(no_yaml)])
    for number, (name, text) in enumerate(
        [("config.json", "{"), ("config.json", "[]"), ("checkpoints", "")]
    ):
        broken = tmp_path / str(number)
        shutil.copytree(run_dir, broken)
        if name == "checkpoints":
            newest = max((broken / name).glob("[0-9]*"), key=lambda step: int(step.name))
            shutil.rmtree(newest / "target_params")
        else:
            (broken / name).write_text(text)
        assert name in refusal([str(broken)])
    out = tmp_path / "0" / "config.json"
    assert "config.json: is a file of that run" in refusal([str(run_dir), "--out", str(out)])


def test_a_damaged_array_of_a_checkpoint_is_one_line(
    run_dir: Path, as_trained: list[str], tmp_path: Path
) -> None:
    """In a process of its own: Orbax complains later of what it left running when it failed."""
    shutil.copytree(run_dir, tmp_path / "run")
    arrays = (tmp_path / "run" / "checkpoints").rglob("target_params/**/d/*")
    for file in [file for file in arrays if file.stat().st_size > 10_000]:
        file.write_bytes(b"")
    words = ["evaluate", str(tmp_path / "run"), *as_trained, "--episodes", "1"]
    program = [sys.executable, "-m", "sqn_jax", *words]
    done = subprocess.run(program, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if line.startswith("sqn: ")]
    assert len(lines) == 1
    assert "damaged" in lines[0]


def test_a_run_without_a_checkpoint_is_named(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bare").mkdir()
    shutil.copy(run_dir / "config.json", tmp_path / "bare" / "config.json")
    assert main(["evaluate", str(tmp_path / "bare")]) == 2
    assert "holds no checkpoint" in capsys.readouterr().err
    (tmp_path / "bare" / "checkpoints").mkdir()
    with pytest.raises(ValueError, match="holds no checkpoint"):
        load_policy(tmp_path / "bare")


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["--no-baselines"], ["run folder"]),
        (["nowhere"], ["nowhere", "holds no run"]),
        (["--episodes", "0"], ["episodes", "0", "at least 1"]),
        (["--episodes", "1000000000000"], ["episodes", "1000000000000", "at most"]),
        (["--seed", "2147483647", "--eval-seeds", "2"], ["seed", "2147483647"]),
        (["--maps", "maze", "maze"], ["maps", "maze", "twice"]),
        (
            ["--maps", str(MAZE_FILE), str(MAZE_FILE.parent / "../maps/maze.yaml")],
            ["maps", "maze.yaml", "one file twice"],
        ),
        (["--robot-radius", "-1"], ["robot_radius", "-1"]),
        (["--bumper", "0.05"], ["--bumper", "run folder"]),
        (["pretrained:dqn", "--bumper", "-1"], ["--bumper", "-1"]),
        (["pretrained:dqn", "--bumper", "nan"], ["--bumper", "nan"]),
        (["--goal-radius", "0.3", "0.3"], ["goal_radii", "0.3", "twice"]),
        (["--velocity-noise", "0.1", "0.1"], ["noise", "0.1", "twice"]),
        (["--velocity-noise", "1e39"], ["noise", "1e+39"]),
        (["--eval-seeds", "0"], ["eval_seeds", "0", "at least 1"]),
        (["--velocity-noise", "-0.1"], ["noise", "-0.1"]),
        (["--range-noise", "nan"], ["noise", "nan"]),
        (["--goal-radius", "0"], ["goal radius", "0"]),
        (["--max-steps", "-1"], ["max_steps", "-1"]),
        (["--out", "/proc/found.json"], ["--out", "/proc/found.json", "cannot be written"]),
        (["--maps", "nowhere"], ["nowhere", "maze"]),
        (["--out", "found.txt"], ["--out", ".json"]),
        (["--out", "no/such/folder/found.json"], ["--out", "existing folder"]),
        (["--tasks", "all"], ["--tasks", "points", "pairs"]),
    ],
)
def test_wrong_words_of_evaluate_are_named_in_one_line(
    capsys: pytest.CaptureFixture[str], words: list[str], names: list[str]
) -> None:
    assert main(["evaluate", *words]) == 2
    stderr = capsys.readouterr().err
    lines = [line for line in stderr.splitlines() if line.startswith("sqn: ")]
    assert len(lines) == 1
    assert "Traceback" not in stderr
    for name in names:
        assert name in lines[0], (name, stderr)
