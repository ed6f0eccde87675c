"""Saving and loading the state of a run with Orbax.

A checkpoint holds the whole `RunnerState`: parameters, optimizer, replay, keys and the round, and a
manifest (`manifest.py`) that is compared with it before anything is used. The parameters of the
policy stand apart, so that it can be loaded without the rest; so does the replay, which can be left
out.

A step is written under a hidden name and renamed once all of it is on the disk. Of a run in several
processes each writes and reads what its devices have; the first does the rest.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import warnings
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from jax.sharding import SingleDeviceSharding

from sqn_jax.agent.learner import LearnerState
from sqn_jax.agent.networks import Params
from sqn_jax.storage import manifest
from sqn_jax.storage.files import flush_folder
from sqn_jax.storage.manifest import Damaged, Manifest, Mismatch, Origin
from sqn_jax.storage.run_folder import CHECKPOINTS
from sqn_jax.training import processes
from sqn_jax.training.state import RunnerState

NUM_NEWEST = 2
"""How many of the newest stay on the disk; the best one besides."""

OVERHEAD_BYTES = 2**21
"""What a checkpoint takes besides its arrays, at most: some fifty small files, and the manifest."""

# Orbax reports every file it touches; a user wants to see the progress of the training.
logging.getLogger("absl").setLevel(logging.ERROR)


class NotSaved(OSError):
    """A checkpoint could not be written; the older ones are as they were."""


def chunks_in(folder: Path) -> list[int]:
    """Chunks done at each checkpoint in a folder, the oldest first; none if there is no folder."""
    if folder.is_symlink() or not folder.is_dir():
        return []
    names = [path.name for path in folder.iterdir() if path.is_dir() and not path.is_symlink()]
    return sorted(int(name) for name in names if name.isascii() and name.isdigit())


class Checkpoints:
    """The checkpoints of one run folder; use as a context manager."""

    def __init__(self, run_dir: Path, origin: Origin) -> None:
        self._folder = (run_dir / CHECKPOINTS).absolute()
        self._origin = origin
        self._orbax = ocp.Checkpointer(ocp.CompositeCheckpointHandler())

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self._orbax.close()

    def chunks(self) -> list[int]:
        """Chunks done at each checkpoint, the oldest first."""
        return chunks_in(self._folder)

    def save(
        self, chunk: int, runner: RunnerState, *, score: float | None = None, light: bool = False
    ) -> None:
        """Write the state after `chunk` chunks; on the disk when this returns.

        All processes of a run are to call it, as `restore` and `restore_policy`.

        Args:
            chunk: chunks done.
            runner: the state.
            score: success in training since the checkpoint before; the best one stays.
            light: leave out the replay, where there is one.

        Raises:
            NotSaved: the disk is full, say.
        """
        items = _split(runner)
        exact = not (light and "memory" in items)
        if not exact:
            del items["memory"]
        partial = self._folder / f".{chunk}.partial"
        try:
            with processes.together():
                if processes.is_first():
                    self._folder.mkdir(parents=True, exist_ok=True)
                    self._sweep()
                    _require_space(self._folder, items)
            arguments = {name: ocp.args.StandardSave(item) for name, item in items.items()}
            self._orbax.save(partial, args=ocp.args.Composite(**arguments))
            leaves = manifest.describe_leaves(items)
            with processes.together():
                if processes.is_first():
                    manifest.write(
                        partial, leaves, self._origin, chunk=chunk, score=score, exact=exact
                    )
                    self._set_aside(chunk)
                    partial.rename(self._place(chunk))
                    flush_folder(self._folder)
        except Exception as error:  # Orbax raises what its file library does.
            if processes.has_lost(error):
                raise
            if processes.is_first():
                self._sweep()
            raise NotSaved(self._not_saved(chunk, error)) from None
        if processes.is_first():
            self._prune()

    def restore(self, runner_shapes: RunnerState) -> tuple[RunnerState, Manifest]:
        """Load the newest sound checkpoint into a state of the given shapes (arrays or structs).

        Newer ones that are damaged are named in a warning and set aside. The state has no replay
        where the checkpoint was saved without.

        Raises:
            ValueError: there is no checkpoint, or none that is sound.
            Mismatch: it is of another run.
        """
        with processes.together():
            found = self._newest_sound() if processes.is_first() else None
        chunk, faults = processes.gather(found)[0]
        description = manifest.read(self._place(chunk), chunk, ())
        items = _split(runner_shapes)
        if not description.is_exact:
            items.pop("memory", None)
        restored = self._restored(chunk, description, items)
        for damaged, fault in faults if processes.is_first() else ():
            warnings.warn(f"{fault}; going on from chunk {chunk}", UserWarning, stacklevel=2)
            self._set_aside(damaged)
        return _join(restored), description

    def _newest_sound(self) -> tuple[int, list[tuple[int, str]]]:
        """The newest checkpoint that is what was written, and what is wrong with newer ones."""
        faults = []
        for chunk in reversed(self._require_some()):
            try:
                manifest.read(self._place(chunk), chunk)
            except Damaged as error:
                faults.append((chunk, f"checkpoint {self._place(chunk)}: damaged, {error}"))
            else:
                return chunk, faults
        raise ValueError("; ".join(fault for _, fault in faults))

    def restore_policy(
        self, params_shapes: Params, *, averaged: bool, which: int | str = "newest"
    ) -> Params:
        """Load only the parameters to evaluate.

        Args:
            params_shapes: the parameters as arrays or structs.
            averaged: whether the run's policy is the average of its parameters, see
                `TrainConfig.averages_params`.
            which: "newest", "best" (by success in training) or a number of chunks.

        Raises:
            ValueError: there is no such checkpoint, or it is damaged.
            Mismatch: it is of another run.
        """
        chunk = self._chosen(which)
        name = "target_params" if averaged else "params"
        try:
            description = manifest.read(self._place(chunk), chunk, (name,))
        except Damaged as error:
            message = f"checkpoint {self._place(chunk)}: damaged, {error}"
            older = [sound for sound in self.chunks() if sound < chunk and self._is_sound(sound)]
            if older:
                message += f"; that of chunk {older[-1]} is sound: --resume goes on from it, "
                message += f"--checkpoint {older[-1]} takes it"
            raise ValueError(message) from None
        return self._restored(chunk, description, {name: params_shapes})[name]

    def _chosen(self, which: int | str) -> int:
        chunks = self._require_some()
        if which == "newest":
            return chunks[-1]
        if which == "best":
            return self._best(chunks) or chunks[-1]
        if which in chunks:
            return int(which)
        known = ", ".join(str(chunk) for chunk in chunks)
        raise ValueError(f"{self._folder}: no checkpoint {which}, expected newest, best or {known}")

    def _restored(self, chunk: int, description: Manifest, shapes: dict[str, Any]) -> Any:
        """Trees of the given shapes; on the first device where these do not name any.

        Wherever the arrays lay when they were saved: a run on two devices can resume on one.
        """
        place = self._place(chunk)
        rows = manifest.differences(description, self._origin, shapes)
        if rows:
            raise Mismatch(f"checkpoint {place}: not of this run as it is set up here", rows)
        items = {name: ocp.args.StandardRestore(_placed(item)) for name, item in shapes.items()}
        try:
            restored = self._orbax.restore(place, args=ocp.args.Composite(**items))
        except Exception as error:  # Not damage: every file is what was written.
            reason = " ".join(str(error).split())[:200]
            raise ValueError(
                f"checkpoint {place}: cannot be restored ({type(error).__name__}: {reason})"
            ) from None
        wrong = manifest.wrong_leaf(description, {name: restored[name] for name in shapes})
        if wrong is not None:
            raise ValueError(f"checkpoint {place}: {wrong} was restored with other numbers")
        return restored

    def _require_some(self) -> list[int]:
        chunks = self.chunks()
        if not chunks:
            raise ValueError(f"{self._folder}: holds no checkpoint")
        return chunks

    def _place(self, chunk: int) -> Path:
        return self._folder / str(chunk)

    def _is_sound(self, chunk: int) -> bool:
        try:
            manifest.read(self._place(chunk), chunk)
        except ValueError:
            return False
        return True

    def _best(self, chunks: Collection[int]) -> int | None:
        """The one with most success in training, the newer of two alike."""
        scores = []
        for chunk in chunks:
            with suppress(ValueError):  # What is damaged cannot be the best.
                score = manifest.read(self._place(chunk), chunk, ()).score
                if score is not None:
                    scores.append((score, chunk))
        return max(scores)[1] if scores else None

    def _prune(self) -> None:
        """Delete all but the newest ones and the best."""
        chunks = self.chunks()
        selected = {*chunks[-NUM_NEWEST:], self._best(chunks)}
        for chunk in chunks:
            if chunk not in selected:
                gone = self._place(chunk).with_name(f".{chunk}.old")
                with suppress(OSError):
                    self._place(chunk).rename(gone)
        self._sweep()

    def _sweep(self) -> None:
        """Delete what was broken off."""
        for pattern in (".*.partial*", ".*.old"):
            for path in self._folder.glob(pattern):
                shutil.rmtree(path, ignore_errors=True)

    def _set_aside(self, chunk: int) -> None:
        """Move an unusable checkpoint aside, where it can still be inspected."""
        place = self._place(chunk)
        if place.exists():
            aside = place.with_name(f"{chunk}.damaged")
            shutil.rmtree(aside, ignore_errors=True)
            place.rename(aside)

    def _not_saved(self, chunk: int, error: Exception) -> str:
        chunks = self.chunks()
        left = f"that of chunk {chunks[-1]} is on the disk" if chunks else "there is no older one"
        return f"checkpoint {self._place(chunk)}: cannot be written ({_reason(error)}); {left}"


def _require_space(folder: Path, items: dict[str, Any]) -> None:
    """Refuse to begin what a disk has no room for.

    Orbax's file library continues to write in threads of its own after a write has failed, and each
    of them prints a traceback.
    """
    needed = sum(leaf.nbytes for leaf in jax.tree.leaves(items)) + OVERHEAD_BYTES
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(
            errno.ENOSPC,
            f"{os.strerror(errno.ENOSPC)}: {free / 1e6:,.1f} MB free, {needed / 1e6:,.1f} needed",
        )


def _reason(error: Exception) -> str:
    """What the system said, out of the long story of a library."""
    message = " ".join(str(error).split())
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EIO):
        if os.strerror(number) in message:
            return os.strerror(number)
    return message[:200] or type(error).__name__


def _split(runner: RunnerState) -> dict[str, Any]:
    """Parameters, their slow copy, replay, and all else as plain trees; keys as raw numbers."""
    learner = runner.learner
    map_success = {} if runner.map_success is None else {"map_success": runner.map_success}
    items = {
        "params": learner.params,
        "target_params": learner.target_params,
        "memory": learner.memory,
        "rest": {
            "opt_state": learner.opt_state,
            "num_updates": learner.num_updates,
            "num_skipped": learner.num_skipped,
            "key": _key_data(runner.key),
            "round": learner.round,
            **map_success,
        },
    }
    return {name: item for name, item in items.items() if item is not None}


def _placed(shapes: Any) -> Any:
    first = SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(
            x.shape, x.dtype, sharding=getattr(x, "sharding", None) or first
        ),
        shapes,
    )


def _key_data(key: Any) -> Any:
    if isinstance(key, jax.ShapeDtypeStruct):
        data = jax.eval_shape(jax.random.key_data, key)
        return jax.ShapeDtypeStruct(data.shape, data.dtype, sharding=key.sharding)
    return jax.random.key_data(key)


def _join(items: Any) -> RunnerState:
    rest = items["rest"]
    optional = {name: items.get(name) for name in ("target_params", "memory")}
    learner = LearnerState(
        params=items["params"],
        **optional,
        opt_state=rest["opt_state"],
        round=rest["round"],
        num_updates=rest["num_updates"],
        num_skipped=rest["num_skipped"],
    )
    key = jax.random.wrap_key_data(rest["key"])
    return RunnerState(learner, key, rest.get("map_success"))
