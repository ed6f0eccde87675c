"""A training run from start to end: progress, checkpoints, metrics, final evaluation, figures.

`training.loop` computes; this module prints, writes and reads.
"""

from __future__ import annotations

import signal
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array
from jax.sharding import Mesh

from sqn_jax import config as configs
from sqn_jax.agent.learner import policy_params
from sqn_jax.agent.networks import Params
from sqn_jax.agent.program import Program
from sqn_jax.config import TrainConfig
from sqn_jax.config.map_names import MapFile
from sqn_jax.env import EnvParams, make_env
from sqn_jax.evaluation.cached_work import cached_work
from sqn_jax.maps import OccupancyMap, load_map, step_warning
from sqn_jax.outside.messages import say
from sqn_jax.outside.reading import read_at_most
from sqn_jax.policies.interventions import with_motion_inputs
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.policies.run_policies import Policy, require_same_network, started_from
from sqn_jax.runs import divergence, final_evaluation, streams
from sqn_jax.runs.learning_curve import LearningCurve, summary_of
from sqn_jax.runs.progress import episodes_bar, phase, preparing
from sqn_jax.runs.resuming import restored
from sqn_jax.runs.signals import Interrupted, deferred, wait_for
from sqn_jax.runs.tensorboard import Board, require_tensorboard
from sqn_jax.storage import lock, manifest
from sqn_jax.storage.checkpoint import Checkpoints, chunks_in
from sqn_jax.storage.compile_cache import watched_compilation
from sqn_jax.storage.lock import locked
from sqn_jax.storage.manifest import Origin
from sqn_jax.storage.run_folder import CHECKPOINTS, RunFolder, require_usable
from sqn_jax.training import devices, memory_budget, processes
from sqn_jax.training.loop import (
    ChunkReport,
    CompiledChunk,
    compile_chunk,
    make_program,
    rounds_done,
    run,
    start_run,
)
from sqn_jax.training.state import RunnerState, memory_bytes

SHARED_SECONDS = 20
"""How long a file may take from one machine to the others."""

MAX_PICTURE_BYTES = 2**25
"""Size of a figure for TensorBoard, at most."""


@cached_work()
def train_session(
    config: TrainConfig,
    run_dir: Path,
    *,
    resume: bool = False,
    num_devices: int | None = None,
    tensorboard: bool = False,
    resume_command: str = "",
) -> None:
    """Train, evaluate, draw, and print progress.

    Args:
        config: the settings; for a resumed run those in its folder, maybe with more episodes.
        run_dir: the run folder.
        resume: resume from the newest sound checkpoint in `run_dir`, or from the beginning if the
            run was stopped before its first checkpoint.
        num_devices: see `devices.choose`.
        tensorboard: also write metrics and figures for TensorBoard.
        resume_command: the command to resume a stopped run with; printed.

    Raises:
        ValueError: the map, the folder or the number of devices is unusable, the run does not fit
            into memory, or tensorboardX is needed but not installed.
        Mismatch: the checkpoints belong to another run.
        NotSaved: a checkpoint could not be written.
        Diverged: the run has diverged.
        Interrupted: a signal stopped the run; the current chunk was finished and saved.
    """
    with processes.together():
        setup = _set_up(config, run_dir, resume, num_devices, tensorboard)
    program, first_map = setup.program, _first_map(config, setup.occupancy_map)
    world = setup.occupancy_map.identity()
    processes.require_same(_description(config, world, resume, program.mesh))
    with ExitStack() as stack:
        folder = stack.enter_context(_run_folder(run_dir, config, resume))
        origin = Origin(config, world, 1 if program.mesh is None else program.mesh.size)
        checkpoints = stack.enter_context(Checkpoints(run_dir, origin))
        runner = restored(program, folder, checkpoints) if resume else None
        _announce(program, run_dir, setup.num_bytes, resume_command)
        done = 0 if runner is None else rounds_done(runner) * config.num_envs
        has_board = tensorboard and processes.is_first()
        board = stack.enter_context(Board(run_dir, done)) if has_board else None
        curve = LearningCurve(first_map, config)
        training = _Training(setup, folder, checkpoints, resume_command, curve)
        runner = training.run(runner, None if board is None else board.scalars)
        params = devices.on_host(policy_params(runner.learner, config))
        if processes.is_first():
            _finish(params, first_map, config, folder, board, training.timing)


def _finish(
    params: Params,
    first_map: OccupancyMap,
    config: TrainConfig,
    folder: RunFolder,
    board: Board | None,
    timing: dict[str, float],
) -> None:
    """Evaluate what was trained, draw it, and say what it came to."""
    phase(f"evaluating on {first_map.name}")
    results, batches = final_evaluation.evaluate_run(params, first_map, config, folder)
    phase("drawing")
    has_figures = final_evaluation.draw_figures(batches, first_map, config, folder)
    if board is not None and has_figures:
        _add_figures(board, config, folder)
    last = summary_of(folder.read_metrics(), config)
    final_evaluation.conclude(results, timing, has_figures, config, folder, last)


@dataclass(frozen=True)
class _Setup:
    """What a run needs before its first file."""

    occupancy_map: OccupancyMap
    env_params: EnvParams
    program: Program
    num_bytes: int
    """Of the episodes in memory."""
    start: Policy | None
    """Where the parameters of a new run come from, if not from its seed."""


def _set_up(
    config: TrainConfig, run_dir: Path, resume: bool, num_devices: int | None, tensorboard: bool
) -> _Setup:
    """Everything that may be refused before files are left behind."""
    require_usable(run_dir)
    memory_budget.bound_programs()
    devices.use_cores()
    mesh = devices.choose(config, num_devices)
    preparing(len(config.maps.names))
    occupancy_map = load_map(config.maps, robot_radius=config.env.robot_radius)
    env_params = make_env(occupancy_map, config.env)
    _warn_of_short_episodes(occupancy_map, config)
    program = make_program(env_params, config, mesh)
    num_bytes = memory_bytes(program)
    memory_budget.require(num_bytes, "keeping its episodes", config.method)
    final_evaluation.require_memory(program)
    if tensorboard:
        require_tensorboard()
    is_saved = resume and bool(chunks_in(run_dir / CHECKPOINTS))
    start = None if is_saved else _starting_policy(config)
    return _Setup(occupancy_map, env_params, program, num_bytes, start)


def _description(
    config: TrainConfig, world: dict[str, Any], resume: bool, mesh: Mesh | None
) -> dict[str, Any]:
    """What all processes of a run must agree on."""
    return {
        **manifest.versions(),
        **configs.flat(configs.to_dict(config)),
        **configs.flat(world, "map."),
        "--resume": resume,
        "--num-devices": 1 if mesh is None else mesh.size,
    }


@contextmanager
def _run_folder(run_dir: Path, config: TrainConfig, resume: bool) -> Iterator[RunFolder]:
    """The folder, locked and for a new run made by the first process; all are to see it."""
    with ExitStack() as stack:
        with processes.together():
            if processes.is_first():
                stack.enter_context(locked(run_dir))
        owner = processes.gather(lock.owner(run_dir))[0]
        with processes.together():
            deadline = time.monotonic() + SHARED_SECONDS
            while lock.owner(run_dir) != owner:
                if time.monotonic() > deadline:
                    raise ValueError(
                        f"run folder {run_dir}: is not that of process 0, expected one that all "
                        "machines share"
                    )
                time.sleep(0.5)
        with processes.together():
            if processes.is_first() and not resume:
                RunFolder.create(run_dir, config)
        yield RunFolder(run_dir)


def _warn_of_short_episodes(occupancy_map: OccupancyMap, config: TrainConfig) -> None:
    """Warn if the limit that a map file sets is too short for its paths."""
    from_files = any(isinstance(name, MapFile) for name in config.maps.names)
    if from_files and config.env.max_steps == 0:
        step = config.env.forward_speed * config.env.time_step
        line = step_warning(occupancy_map, config.env.robot_radius, step, config.env.goal_radius)
        if line is not None:
            warnings.warn(line, stacklevel=2)


def _first_map(config: TrainConfig, occupancy_map: OccupancyMap) -> OccupancyMap:
    """The map of the final evaluation: that of the run, or the first of several."""
    if occupancy_map.tiles == (1, 1):
        return occupancy_map
    return load_map(config.maps.names[0], robot_radius=config.env.robot_radius)


def _add_figures(board: Board, config: TrainConfig, folder: RunFolder) -> None:
    # Not the hidden files, which a killed process has left behind.
    for path in sorted(folder.figures.glob("[!.]*.png")):
        png = read_at_most(path, MAX_PICTURE_BYTES, "a figure", follow=False)
        board.picture(path.stem, png, config.num_rounds * config.num_envs)


def _starting_policy(config: TrainConfig) -> Policy | None:
    """The policy that training starts from, if any."""
    if not config.start_from:
        return None
    policy = find_policy(config.start_from)
    if config.network.motion_inputs:
        policy = with_motion_inputs(policy)
    require_same_network(policy, config)
    return policy


def _announce(program: Program, run_dir: Path, num_bytes: int, resume_command: str) -> None:
    config = program.config
    seeds = f"seed {config.seed}"
    if config.num_seeds > 1:
        seeds = f"seeds {config.seed} to {config.seed + config.num_seeds - 1}"
    episodes = config.num_rounds * config.num_envs
    say(
        f"{config.algo.upper()} by {config.method.upper()} on {config.map}, {seeds}: "
        f"{episodes:,} episodes of {program.max_steps} steps, {config.num_envs} robots at once"
    )
    if config.start_from:
        say(f"starting from {config.start_from}")
    say(
        f"run folder {run_dir}, device {devices.describe(program.mesh)}"
        f"{devices.describe_division(program.mesh, config.num_seeds)}, "
        f"episodes in memory {num_bytes / 1e6:,.1f} MB"
    )
    if config.method == "r2d2" and not config.checkpoint_replay:
        say("checkpoints without the replay: a stopped run does not resume exactly")
    if resume_command:  # Later a signal may end the process at once.
        say(f"if it is stopped, resume with {resume_command}", flush=True)


class _Training:
    """The training of a run to its end, with metrics and checkpoints."""

    def __init__(
        self,
        setup: _Setup,
        folder: RunFolder,
        checkpoints: Checkpoints,
        resume_command: str,
        curve: LearningCurve,
    ) -> None:
        self._env_params, self._program, self._start = setup.env_params, setup.program, setup.start
        config, mesh = setup.program.config, setup.program.mesh
        self._config, self._resume_command = config, resume_command
        self._folder, self._checkpoints, self._curve = folder, checkpoints, curve
        self._steps_a_round = config.num_envs * config.num_seeds * setup.env_params.max_steps
        self.timing: dict[str, float] = {
            "train_seconds": folder.train_seconds(),
            "env_steps": 0.0,
            "num_devices": 1 if mesh is None else mesh.size,
            "compile_seconds": 0.0,
            "compiled_earlier": False,
        }
        self._successes: list[float] = []
        self._saved_at = time.monotonic()

    def run(
        self, runner: RunnerState | None, on_row: Callable[[dict[str, Any]], None] | None
    ) -> RunnerState:
        """Train from a state, or from the beginning; returns the final state."""
        config = self._config
        done = 0 if runner is None else rounds_done(runner)
        self.timing["env_steps"] = done * self._steps_a_round
        if runner is not None and done >= config.num_rounds:
            return runner
        compiled = self._compile()
        if runner is None:
            runner = start_run(self._program)
            if self._start is not None:
                runner = started_from(runner, self._start)
        total = config.num_rounds * config.num_envs
        message = "stopping after this chunk and saving"
        bar = episodes_bar(total, done * config.num_envs, is_shown=processes.is_first())
        with deferred(message) as received, bar:
            for runner, report in run(runner, self._env_params, self._program, compiled):  # noqa: B020
                row = self._write_row(report, runner)
                if on_row is not None:
                    on_row(row)
                bar.set_postfix_str(_postfix(row), refresh=False)
                bar.update(config.rounds_per_chunk * config.num_envs)
                divergence.raise_if_diverged(row, runner.learner, config, self._folder)
                if streams.reader_left():  # As a closed terminal would.
                    received.append(signal.SIGPIPE)
                number, is_due = self._agreed(received)
                if number or is_due or report.chunk == config.num_chunks:
                    self._save(report.chunk, runner)
                    number, _ = self._agreed(received)
                if number:
                    raise Interrupted(number, self._resume_command)
        return runner

    def _agreed(self, received: list[int]) -> tuple[int, bool]:
        """The signal that any process of the run was sent, or 0, and whether it is time to save."""
        is_due = time.monotonic() - self._saved_at > 60 * self._config.checkpoint_minutes
        reports = processes.gather([received[0] if received else 0, is_due])
        return max(number for number, _ in reports), reports[0][1]

    def _compile(self) -> CompiledChunk:
        """Compile a chunk; refuse what does not fit into memory."""
        say("compiling ...", end="", flush=True)
        with processes.together():
            with watched_compilation() as was_read:
                compiled, seconds = compile_chunk(self._env_params, self._program)
            self.timing |= {"compile_seconds": seconds, "compiled_earlier": was_read()}
            how = "compiled earlier, read" if was_read() else "compiled"
            say(f"{how} in {seconds:.1f} s", start="\r")
            needed = memory_budget.compiled_bytes(compiled)
            memory_budget.require(needed, "training", self._config.method)

        def run_chunk(
            runner: RunnerState, env_params: EnvParams
        ) -> tuple[RunnerState, dict[str, Array]]:
            runner, metrics = compiled(runner, env_params)
            wait_for(metrics)
            return runner, metrics

        return run_chunk

    def _write_row(self, report: ChunkReport, runner: RunnerState) -> dict[str, Any]:
        """Update the timing by a chunk, and write its row of metrics with those of evaluation."""
        self.timing["train_seconds"] += report.seconds
        self.timing["env_steps"] += self._config.rounds_per_chunk * self._steps_a_round
        self._successes.append(float(np.mean(report.metrics["success"])))
        row = _row(report, self.timing["train_seconds"], self._program)
        row |= self._curve.point(report.chunk, runner.learner)
        self.timing["curve_seconds"] = self._curve.seconds
        if processes.is_first():
            self._folder.append_metrics(row)
        return row

    def _save(self, chunk: int, runner: RunnerState) -> None:
        """Write a checkpoint; its rows of metrics are flushed to the disk before."""
        if processes.is_first():
            self._folder.flush_metrics()
        score = float(np.mean(self._successes))
        light = not self._config.checkpoint_replay
        self._checkpoints.save(chunk, runner, score=score, light=light)
        self._successes.clear()
        self._saved_at = time.monotonic()


def _row(report: ChunkReport, train_seconds: float, program: Program) -> dict[str, Any]:
    """One line of metrics.jsonl."""
    config = program.config
    rounds = report.chunk * config.rounds_per_chunk
    episodes = rounds * config.num_envs
    steps = config.rounds_per_chunk * config.num_envs * config.num_seeds * program.max_steps
    return {
        "chunk": report.chunk,
        "episodes": episodes,
        "env_steps": episodes * program.max_steps,
        "wall_seconds": round(train_seconds, 3),
        "steps_per_second": round(steps / report.seconds),
        **report.metrics,
    }


def _postfix(row: dict[str, Any]) -> str:
    return (
        f"success {np.mean(row['success']):.2f}, reward {np.mean(row['mean_reward']):+.2f}, "
        f"{row['steps_per_second']:,} steps/s"
    )
