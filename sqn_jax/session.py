"""A training run or an evaluation as a person starts it: progress, checkpoints, files, figures.

The numbers come from `train` and `evaluate`; this module decides what is said and written when.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from tqdm import tqdm

import sqn_jax
from sqn_jax import devices
from sqn_jax.checkpoint import Checkpoints
from sqn_jax.compare import (
    Agent,
    Driven,
    Learnt,
    Settings,
    World,
    evaluate_agents,
    load_maps,
    num_episodes,
)
from sqn_jax.compilation import kept_programs, watched_compilation
from sqn_jax.config import TrainConfig
from sqn_jax.env import EnvParams, make_env
from sqn_jax.maps import OccupancyMap, load_map
from sqn_jax.policies import Policy, seeds_of
from sqn_jax.progress import episodes_bar
from sqn_jax.rollout import EpisodeSummary, Trace
from sqn_jax.runlog import RunFolder, write_json, write_records
from sqn_jax.tensorboard import Board, require_tensorboard
from sqn_jax.train import (
    ChunkReport,
    RunnerState,
    compile_chunk,
    memory_bytes,
    num_windows,
    policy_params,
    run,
    runner_shapes,
    start_run,
)


class Stopped(Exception):
    """The run was stopped by a signal, after saving; carries the exit code."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal_number)
        self.exit_code = 128 + signal_number


@kept_programs()
def train_session(
    config: TrainConfig,
    run_dir: Path,
    *,
    resume: bool = False,
    num_devices: int | None = None,
    tensorboard: bool = False,
) -> None:
    """Train, evaluate and draw, telling the terminal about it.

    Args:
        config: the settings; of a resumed run those in its folder.
        run_dir: where everything goes.
        resume: go on from the newest checkpoint in `run_dir`.
        num_devices: see `devices.choose`.
        tensorboard: write metrics and pictures for TensorBoard, too.

    Raises:
        ValueError: the map, the folder or the number of devices is unusable, or tensorboardX is
            asked for and not installed.
        Stopped: by SIGINT or SIGTERM, after the chunk was finished and saved.
    """
    devices.use_cores()
    mesh = devices.choose(config, num_devices)
    occupancy_map = load_map(config.map, robot_radius=config.env.robot_radius)
    env_params = make_env(occupancy_map, config.env)
    # Refuses a window that does not fit before anything is written.
    num_windows(config, env_params)
    if tensorboard:
        require_tensorboard()
    folder = RunFolder(run_dir) if resume else RunFolder.create(run_dir, config)
    _announce(config, env_params, run_dir, mesh)
    with Checkpoints(run_dir) as checkpoints, ExitStack() as stack:
        if resume:
            shapes = runner_shapes(env_params, config, mesh)
            runner, seconds_before = _restored(shapes, config, folder, checkpoints)
        else:
            runner, seconds_before = start_run(env_params, config, mesh), 0.0
        done = int(np.max(np.asarray(runner.round))) * config.num_envs
        board = stack.enter_context(Board(run_dir, done)) if tensorboard else None
        on_row = None if board is None else board.scalars
        runner, timing = _train(
            runner, env_params, config, folder, checkpoints, seconds_before, mesh, on_row
        )
        results, drawn = _evaluate(runner, occupancy_map, config, folder)
        figures = _draw(drawn, occupancy_map, config, folder)
        if board is not None and figures:
            for path in sorted(folder.figures.glob("*.png")):
                board.picture(path.stem, path.read_bytes(), config.num_rounds * config.num_envs)
    _conclude(results, timing, figures, config, folder)


def _announce(config: TrainConfig, env_params: EnvParams, run_dir: Path, mesh: Mesh | None) -> None:
    seeds = f"seed {config.seed}"
    if config.num_seeds > 1:
        seeds = f"seeds {config.seed} to {config.seed + config.num_seeds - 1}"
    episodes = config.num_rounds * config.num_envs
    print(
        f"{config.algo.upper()} by {config.method.upper()} on {config.map}, {seeds}: "
        f"{episodes:,} episodes of {env_params.max_steps} steps, {config.num_envs} robots at once\n"
        f"run folder {run_dir}, {_device_words(mesh)}, "
        f"episodes in memory {memory_bytes(config, env_params) / 1e6:,.1f} MB"
    )


def _device_words(mesh: Mesh | None) -> str:
    device = jax.devices()[0]
    times = "" if mesh is None else f" x {mesh.size}"
    return f"device {device.platform} ({device.device_kind}){times}"


def _restored(
    shapes: RunnerState, config: TrainConfig, folder: RunFolder, checkpoints: Checkpoints
) -> tuple[RunnerState, float]:
    """The state to go on from, and the seconds of training already behind it."""
    runner = checkpoints.restore(shapes)
    chunks = int(np.max(np.asarray(runner.round))) // config.rounds_per_chunk
    folder.keep_metrics(chunks)
    rows = folder.read_metrics()
    print(f"resuming after {chunks} of {config.num_chunks} chunks")
    return runner, float(rows[-1]["wall_seconds"]) if rows else 0.0


def _train(
    runner: RunnerState,
    env_params: EnvParams,
    config: TrainConfig,
    folder: RunFolder,
    checkpoints: Checkpoints,
    seconds_before: float,
    mesh: Mesh | None,
    on_row: Callable[[dict[str, Any]], None] | None,
) -> tuple[RunnerState, dict[str, float]]:
    """Drive the training to its end; returns the final state and how long it took."""
    episodes_a_chunk = config.rounds_per_chunk * config.num_envs
    rounds_done = int(np.max(np.asarray(runner.round)))
    steps_a_round = config.num_envs * config.num_seeds * env_params.max_steps
    timing: dict[str, float] = {"train_seconds": seconds_before}
    timing["env_steps"] = rounds_done * steps_a_round
    timing["num_devices"] = 1 if mesh is None else mesh.size
    print("compiling ...", end="", flush=True)
    with watched_compilation() as was_read:
        program, timing["compile_seconds"] = compile_chunk(env_params, config, mesh)
    timing["compiled_earlier"] = was_read()
    how = "compiled earlier, read" if was_read() else "compiled"
    print(f"\r{how} in {timing['compile_seconds']:.1f} s")
    last_saved = time.monotonic()
    total = config.num_rounds * config.num_envs
    with _signals() as received, episodes_bar(total, rounds_done * config.num_envs) as bar:
        for runner, report in run(runner, env_params, config, program, mesh):  # noqa: B020
            timing["train_seconds"] += report.seconds
            timing["env_steps"] += config.rounds_per_chunk * steps_a_round
            row = _row(report, timing["train_seconds"], env_params, config)
            folder.append_metrics(row)
            if on_row is not None:
                on_row(row)
            bar.set_postfix_str(_postfix(row), refresh=False)
            bar.update(episodes_a_chunk)
            if received or time.monotonic() - last_saved > 60 * config.checkpoint_minutes:
                checkpoints.save(report.chunk, runner)
                last_saved = time.monotonic()
            if received:
                raise Stopped(received[0])
    if checkpoints.latest() != config.num_chunks:
        checkpoints.save(config.num_chunks, runner)
    return runner, timing


@kept_programs()
def evaluate_session(
    agents: Sequence[Agent], settings: Settings, out: Path | None = None
) -> dict[str, Any]:
    """Evaluate agents under a progress bar.

    Args:
        agents: who drives; see `compare.evaluate_agents`.
        settings: where and how often.
        out: where to write the evaluation, a JSON file, and beside it one record an episode.

    Returns:
        The evaluation as written.

    Raises:
        ValueError: a map is unusable for a robot; nothing was driven then.
    """
    maps = load_maps(agents, settings)
    with episodes_bar(num_episodes(agents, settings)) as bar:
        evaluation, records = evaluate_agents(agents, maps, settings, bar.update)
    if out is not None:
        write_json(out, evaluation)
        write_records(out.with_suffix(".jsonl"), records)
    return evaluation


def _row(
    report: ChunkReport, train_seconds: float, env_params: EnvParams, config: TrainConfig
) -> dict[str, Any]:
    """One line of metrics.jsonl."""
    rounds = report.chunk * config.rounds_per_chunk
    episodes = rounds * config.num_envs
    steps = config.rounds_per_chunk * config.num_envs * config.num_seeds * env_params.max_steps
    return {
        "chunk": report.chunk,
        "episodes": episodes,
        "env_steps": episodes * env_params.max_steps,
        "wall_seconds": round(train_seconds, 3),
        "steps_per_second": round(steps / report.seconds),
        **report.metrics,
    }


def _postfix(row: dict[str, Any]) -> str:
    return (
        f"success {np.mean(row['success']):.2f}, reward {np.mean(row['mean_reward']):+.2f}, "
        f"{row['steps_per_second']:,} steps/s"
    )


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM instead of dying of them; a second one ends at once."""
    received: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        received.append(number)
        tqdm.write("\nstopping after this chunk; once more to stop at once", file=sys.stderr)
        for each in previous:
            signal.signal(each, signal.SIG_DFL)

    previous = {each: signal.signal(each, note) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for each, handler in previous.items():
            signal.signal(each, handler)


Drawn = dict[str, tuple[EpisodeSummary, Trace]]
"""For each kind of task, the episodes of the first seed."""


def _evaluate(
    runner: RunnerState, occupancy_map: OccupancyMap, config: TrainConfig, folder: RunFolder
) -> tuple[list[dict[str, Any]], Drawn]:
    """Greedy episodes of every seed from the evaluation points and from random pairs."""
    # On one device: every program that is given them would else run on each of the mesh.
    params = jax.device_put(policy_params(runner.learner, config), jax.devices()[0])
    policy = Policy(folder.path.name, config, seeds_of(params, config))
    settings = Settings(
        maps=(config.map,),
        tasks=("evaluation points", "random pairs"),
        episodes=config.eval.episodes,
        eval_seeds=1,
        seed=config.eval.seed,
        noise=((config.env.velocity_noise, config.env.range_noise),),
        goal_radii=(config.env.goal_radius,),
        max_steps=config.env.max_steps,
    )
    drawn: Drawn = {}

    def keep(_: Agent, world: World, index: int, driven: Driven) -> None:
        if index == 0:
            drawn[world.tasks] = (driven[0][0], driven[1])

    evaluation, records = evaluate_agents(
        [Learnt(config.algo, (policy,))],
        {(config.map, config.env.robot_radius): occupancy_map},
        settings,
        on_driven=keep,
    )
    folder.write_json("evaluation.json", evaluation)
    folder.write_records("evaluation.jsonl", records)
    return evaluation["results"], drawn


def _draw(
    drawn: Drawn, occupancy_map: OccupancyMap, config: TrainConfig, folder: RunFolder
) -> bool:
    """Write the figures; says so and returns False where Matplotlib is not installed."""
    try:
        from sqn_jax import figures
    except ImportError:
        print("no figures: Matplotlib is not installed (pip install 'sqn_jax[viz]')")
        return False
    name = f"{config.algo.upper()} on {occupancy_map.name}"
    curve = figures.learning_curve(folder.read_metrics(), title=name)
    figures.save(curve, folder.figures / "learning_curve.png")
    for tasks, (summary, trace) in drawn.items():
        drawing = figures.trajectories(
            occupancy_map,
            trace.goals,
            trace.poses,
            trace.skill_weights,
            summary.success,
            summary.time_steps,
            goal_radius=config.env.goal_radius,
            robot_radius=config.env.robot_radius,
            title=f"{name}, {tasks}" + (f", seed {config.seed}" if config.num_seeds > 1 else ""),
        )
        figures.save(drawing, folder.figures / f"trajectories_{tasks.replace(' ', '_')}.png")
    return True


def _duration(seconds: float) -> str:
    return f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.1f} s"


def _conclude(
    results: list[dict[str, Any]],
    timing: dict[str, float],
    figures: bool,
    config: TrainConfig,
    folder: RunFolder,
) -> None:
    """Write summary.json and say what it came to."""
    device = jax.devices()[0]
    summary: dict[str, Any] = {
        "episodes": config.num_rounds * config.num_envs,
        "wall_seconds": round(timing["train_seconds"], 1),
        "compile_seconds": round(timing["compile_seconds"], 1),
        "compiled_earlier": bool(timing["compiled_earlier"]),
        "steps_per_second": round(timing["env_steps"] / max(timing["train_seconds"], 1e-9)),
        "device": f"{device.platform} ({device.device_kind})",
        "num_devices": timing["num_devices"],
        "versions": {"sqn_jax": sqn_jax.__version__, "jax": jax.__version__},
    }
    print(
        f"trained in {_duration(summary['wall_seconds'])} "
        f"({summary['steps_per_second']:,} steps a second)"
    )
    for entry in results:
        tasks = entry["tasks"]
        summary[tasks.replace(" ", "_")] = {
            "success": entry["success"]["mean"],
            "time_steps": entry["time_steps"]["mean"],
        }
        low, high = entry["success"]["ci95"]
        print(
            f"{tasks + ':':19} success {entry['success']['mean']:.2f} "
            f"[{low:.2f}, {high:.2f}], {entry['time_steps']['mean']:.0f} steps "
            f"({config.eval.episodes} greedy episodes"
            + (f" of each of {config.num_seeds} seeds)" if config.num_seeds > 1 else ")")
        )
    folder.write_json("summary.json", summary)
    if figures:
        print(f"figures in {folder.figures}")
