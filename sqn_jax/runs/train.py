"""A training run from start to end: progress, checkpoints, metrics, final evaluation, figures.

`training.loop` computes; this module prints, writes and reads.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array

from sqn_jax.agent.program import Program
from sqn_jax.config import TrainConfig
from sqn_jax.config.map_names import MapFile
from sqn_jax.env import EnvParams, make_env
from sqn_jax.maps import OccupancyMap, load_map, step_warning
from sqn_jax.outside.messages import say
from sqn_jax.outside.reading import read_at_most
from sqn_jax.policies.interventions import with_motion_inputs
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.policies.run_policies import Policy, require_same_network, started_from
from sqn_jax.runs import divergence, final_evaluation, streams
from sqn_jax.runs.learning_curve import LearningCurve, summary_of
from sqn_jax.runs.progress import episodes_bar, phase
from sqn_jax.runs.signals import Interrupted, deferred, wait_for
from sqn_jax.runs.tensorboard import Board, require_tensorboard
from sqn_jax.storage import manifest
from sqn_jax.storage.checkpoint import Checkpoints, chunks_in
from sqn_jax.storage.compile_cache import cached_programs, watched_compilation
from sqn_jax.storage.lock import locked
from sqn_jax.storage.manifest import Manifest, Origin
from sqn_jax.storage.run_folder import CHECKPOINTS, SUMMARY, RunFolder, require_usable
from sqn_jax.training import devices, memory_budget
from sqn_jax.training.loop import (
    ChunkReport,
    CompiledChunk,
    compile_chunk,
    make_program,
    rounds_done,
    run,
    runner_shapes,
    start_run,
)
from sqn_jax.training.state import RunnerState, memory_bytes

MAX_PICTURE_BYTES = 2**25
"""Size of a figure for TensorBoard, at most."""


@cached_programs()
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
    require_usable(run_dir)
    memory_budget.bound_programs()
    devices.use_cores()
    mesh = devices.choose(config, num_devices)
    occupancy_map = load_map(config.maps, robot_radius=config.env.robot_radius)
    env_params = make_env(occupancy_map, config.env)
    _warn_of_short_episodes(occupancy_map, config)
    program = make_program(env_params, config, mesh)
    # Errors up to here leave no files behind.
    num_bytes = memory_bytes(program)
    memory_budget.require(num_bytes, "keeping its episodes", config.method)
    final_evaluation.require_memory(program)
    if tensorboard:
        require_tensorboard()
    is_saved = resume and bool(chunks_in(run_dir / CHECKPOINTS))
    start = None if is_saved else _starting_policy(config)
    origin = Origin(config, occupancy_map.identity(), 1 if mesh is None else mesh.size)
    with ExitStack() as stack:
        stack.enter_context(locked(run_dir))
        folder = RunFolder(run_dir) if resume else RunFolder.create(run_dir, config)
        checkpoints = stack.enter_context(Checkpoints(run_dir, origin))
        runner = _restored(program, folder, checkpoints) if resume else None
        _announce(program, run_dir, num_bytes, resume_command)
        done = 0 if runner is None else rounds_done(runner) * config.num_envs
        board = stack.enter_context(Board(run_dir, done)) if tensorboard else None
        first_map = _first_map(config, occupancy_map)
        curve = LearningCurve(first_map, config)
        training = _Training(env_params, program, folder, checkpoints, start, resume_command, curve)
        runner = training.run(runner, None if board is None else board.scalars)
        phase(f"evaluating on {first_map.name}")
        results, batches = final_evaluation.evaluate_run(runner, first_map, config, folder)
        phase("drawing")
        has_figures = final_evaluation.draw_figures(batches, first_map, config, folder)
        if board is not None and has_figures:
            _add_figures(board, config, folder)
    last = summary_of(folder.read_metrics(), config)
    final_evaluation.conclude(results, training.timing, has_figures, config, folder, last)


def _warn_of_short_episodes(occupancy_map: OccupancyMap, config: TrainConfig) -> None:
    """Warn if the limit that a map file sets is too short for its paths."""
    from_files = any(isinstance(name, MapFile) for name in config.maps.names)
    if from_files and config.env.max_steps == 0:
        line = step_warning(
            occupancy_map,
            config.env.robot_radius,
            config.env.forward_speed * config.env.time_step,
            config.env.goal_radius,
        )
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
        f"run folder {run_dir}, device {devices.describe(program.mesh)}, "
        f"episodes in memory {num_bytes / 1e6:,.1f} MB"
    )
    if config.method == "r2d2" and not config.checkpoint_replay:
        say("checkpoints without the replay: a stopped run does not resume exactly")
    if resume_command:  # Later a signal may end the process at once.
        say(f"if it is stopped, resume with {resume_command}", flush=True)


def _restored(program: Program, folder: RunFolder, checkpoints: Checkpoints) -> RunnerState | None:
    """The state to resume from; None if the run was stopped before its first checkpoint.

    Also writes the config to the folder and drops the metrics of chunks after the checkpoint.
    """
    config = program.config
    runner, chunks = None, 0
    folder.sweep()
    if checkpoints.chunks():
        runner, saved = checkpoints.restore(runner_shapes(program))
        chunks = rounds_done(runner) // config.rounds_per_chunk
        if chunks > config.num_chunks:
            episodes = chunks * config.rounds_per_chunk * config.num_envs
            raise ValueError(
                f"total_episodes is {config.total_episodes}, expected at least the {episodes} that "
                f"the run in {folder.path} has done"
            )
        say(f"resuming after {chunks} of {config.num_chunks} chunks")
        _report_changes(saved, 1 if program.mesh is None else program.mesh.size)
        if config.method == "r2d2" and runner.learner.memory is None:
            say("saved without the replay: resuming with an empty one, not exactly as before")
            memory = start_run(program).learner.memory
            learner = dataclasses.replace(runner.learner, memory=memory)
            runner = dataclasses.replace(runner, learner=learner)
    else:
        _require_none_lost(folder, config)
        say("stopped before its first checkpoint: starting from the beginning")
    rows = folder.rows_of(chunks, config)
    folder.write_config(config)
    folder.write_metrics(rows)
    if chunks < config.num_chunks:
        folder.unfinish()
    return runner


def _require_none_lost(folder: RunFolder, config: TrainConfig) -> None:
    """Refuse to start from the beginning if there must have been checkpoints."""
    checkpoints = folder.path / CHECKPOINTS
    is_no_folder = os.path.lexists(checkpoints) and not checkpoints.is_dir()
    if (
        is_no_folder
        or any(checkpoints.glob("*.damaged"))
        or (folder.path / SUMMARY).exists()
        or folder.train_seconds() > 120 * config.checkpoint_minutes
    ):
        raise ValueError(
            f"{checkpoints}: holds no checkpoint that can be used, but the run had some; put "
            "them back, or start a new run in another folder"
        )


def _report_changes(saved: Manifest, num_devices: int) -> None:
    """Print what has changed of machine and versions; the run is then not the same to the bit."""
    old = {**saved.contents["versions"], "device": saved.contents["device"]}
    new = {**manifest.versions(), "device": devices.describe()}
    old["devices"], new["devices"] = str(saved.contents["num_devices"]), str(num_devices)
    changed = [name for name in ("jax", "device", "devices", "sqn_jax") if old[name] != new[name]]
    if changed:
        saved_under = ", ".join(f"{name} {old[name]}" for name in changed)
        resumed_under = ", ".join(f"{name} {new[name]}" for name in changed)
        say(
            f"saved under {saved_under}; resuming under {resumed_under}: "
            "the results will not be the same bit for bit"
        )


class _Training:
    """The training of a run to its end, with metrics and checkpoints."""

    def __init__(
        self,
        env_params: EnvParams,
        program: Program,
        folder: RunFolder,
        checkpoints: Checkpoints,
        start: Policy | None,
        resume_command: str,
        curve: LearningCurve,
    ) -> None:
        config, mesh = program.config, program.mesh
        self._env_params, self._program, self._config = env_params, program, config
        self._start, self._resume_command = start, resume_command
        self._folder, self._checkpoints, self._curve = folder, checkpoints, curve
        self._steps_a_round = config.num_envs * config.num_seeds * env_params.max_steps
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
        with deferred(message) as received, episodes_bar(total, done * config.num_envs) as bar:
            for runner, report in run(runner, self._env_params, self._program, compiled):  # noqa: B020
                row = self._write_row(report, runner)
                if on_row is not None:
                    on_row(row)
                bar.set_postfix_str(_postfix(row), refresh=False)
                bar.update(config.rounds_per_chunk * config.num_envs)
                divergence.raise_if_diverged(row, runner.learner, config, self._folder)
                if streams.reader_left():  # As a closed terminal would.
                    received.append(signal.SIGPIPE)
                is_due = time.monotonic() - self._saved_at > 60 * config.checkpoint_minutes
                if received or is_due or report.chunk == config.num_chunks:
                    self._save(report.chunk, runner)
                if received:
                    break
        if received:
            raise Interrupted(received[0], self._resume_command)
        return runner

    def _compile(self) -> CompiledChunk:
        """Compile a chunk; refuse what does not fit into memory."""
        say("compiling ...", end="", flush=True)
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
        self._folder.append_metrics(row)
        return row

    def _save(self, chunk: int, runner: RunnerState) -> None:
        """Write a checkpoint; its rows of metrics are flushed to the disk before."""
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
