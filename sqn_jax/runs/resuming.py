"""Where a stopped run continues: its newest checkpoint, and the rows that lie behind it."""

from __future__ import annotations

import dataclasses
import os

from sqn_jax.agent.program import Program
from sqn_jax.config import TrainConfig
from sqn_jax.outside.messages import say
from sqn_jax.storage import manifest
from sqn_jax.storage.checkpoint import Checkpoints
from sqn_jax.storage.manifest import Manifest
from sqn_jax.storage.run_folder import CHECKPOINTS, SUMMARY, RunFolder
from sqn_jax.training import devices, processes
from sqn_jax.training.loop import rounds_done, runner_shapes, start_run
from sqn_jax.training.state import RunnerState


def restored(program: Program, folder: RunFolder, checkpoints: Checkpoints) -> RunnerState | None:
    """The state to resume from; None if the run was stopped before its first checkpoint.

    Also writes the config to the folder and drops the metrics of chunks after the checkpoint. All
    processes of a run call it; the first writes.
    """
    config = program.config
    runner, chunks = None, 0
    if processes.is_first():
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
    with processes.together():
        if processes.is_first():
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
