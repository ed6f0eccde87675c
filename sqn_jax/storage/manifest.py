"""What a checkpoint holds, in a file of its own: damage and mix-ups are detected before it is used.

Orbax writes a step as a whole or not at all, but reads whatever it finds: one wrong bit loads as a
wrong number. The manifest has the SHA-256 of every file and of every array, the settings and the
map of the run, and the versions that wrote it; and its own.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

import sqn_jax
from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.outside.reading import open_regular, parse_json
from sqn_jax.storage.files import flush_to_disk
from sqn_jax.training import devices

NAME = "manifest.json"
SCHEMA = 1

MAX_BYTES = 2**26
"""Size of a manifest at most; that of the preset `paper` has 20 kB."""

CHANGEABLE = (
    *("total_episodes", "eval", "checkpoint_minutes", "checkpoint_replay"),
    "max_skipped_updates",
)
"""Settings that a run may go on with other values of."""


class Damaged(ValueError):
    """A checkpoint is not what was written."""


class Mismatch(ValueError):
    """A checkpoint is sound, but of another run; `table` says in what it differs."""

    def __init__(self, message: str, rows: Sequence[tuple[str, str, str]]) -> None:
        super().__init__(message)
        self.rows = rows

    @property
    def table(self) -> str:
        """One line a difference: what, in the checkpoint, here."""
        rows = [("", "checkpoint", "here"), *self.rows]
        widths = [max(len(row[column]) for row in rows) for column in range(2)]
        return "\n".join(
            f"  {name:{widths[0]}}  {then:{widths[1]}}  {now}".rstrip() for name, then, now in rows
        )


@dataclass(frozen=True)
class Origin:
    """The run that a checkpoint is of."""

    config: TrainConfig
    world: Mapping[str, Any] | None = None
    """What identifies its map (`OccupancyMap.identity`); None where no map is at hand."""
    num_devices: int = 1


@dataclass(frozen=True)
class Manifest:
    """The contents of a manifest file."""

    contents: Mapping[str, Any]

    @property
    def is_exact(self) -> bool:
        """Whether a run resumes from it exactly as it would have gone on."""
        return bool(self.contents["exact"])

    @property
    def score(self) -> float | None:
        """Success in training since the checkpoint before."""
        score = self.contents["score"]
        return None if score is None else float(score)

    @property
    def leaves(self) -> Mapping[str, Mapping[str, Any]]:
        """Shape, dtype and SHA-256 of each array, by its path."""
        leaves: Mapping[str, Mapping[str, Any]] = self.contents["leaves"]
        return leaves


def describe_leaves(items: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Shape, dtype and SHA-256 of each array of some trees; all processes of a run call it."""
    return {path: {**_form(leaf), "sha256": leaf_digest(leaf)} for path, leaf in leaves_of(items)}


def write(
    folder: Path,
    leaves: Mapping[str, Mapping[str, Any]],
    origin: Origin,
    *,
    chunk: int,
    score: float | None,
    exact: bool,
) -> None:
    """Write the manifest of a folder whose other files are all there, and flush them to the disk.

    Args:
        folder: of the checkpoint.
        leaves: of `describe_leaves`.
        origin: the run.
        chunk: chunks done.
        score: success in training since the checkpoint before.
        exact: see `Manifest.is_exact`.
    """
    contents = {
        "schema": SCHEMA,
        "chunk": chunk,
        "exact": exact,
        "score": score,
        "config": configs.to_dict(origin.config),
        "world": origin.world,
        "device": devices.describe(),
        "num_devices": origin.num_devices,
        "versions": versions(),
        "leaves": dict(leaves),
        "files": {
            path.relative_to(folder).as_posix(): _file_digest(path, flush=True)
            for path in _files(folder)
        },
    }
    entry = {"contents": contents, "sha256": _contents_digest(contents)}
    descriptor = open_regular(folder / NAME, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        json.dump(entry, file, indent=1)
        file.flush()
        flush_to_disk(file.fileno())


def read(folder: Path, chunk: int, items: Iterable[str] | None = None) -> Manifest:
    """Read a manifest and compare the files of a checkpoint with it.

    Args:
        folder: of the checkpoint.
        chunk: chunks done, by the folder's name.
        items: compare only files of these trees; by default all.

    Raises:
        Damaged: one line naming the file, without the folder.
    """
    contents = _contents(folder)
    if contents["chunk"] != chunk:
        raise Damaged(f"{NAME} is that of chunk {contents['chunk']}")
    files = {path.relative_to(folder).as_posix(): path for path in _files(folder)}
    for name in sorted(contents["files"].keys() | files.keys()):
        if items is not None and "/" in name and name.split("/")[0] not in items:
            continue
        if name not in files:
            raise Damaged(f"{name} is missing")
        if name not in contents["files"]:
            raise Damaged(f"{name} does not belong to it")
        try:
            digest = _file_digest(files[name])
        except OSError as error:
            raise Damaged(f"{name} cannot be read ({error.strerror})") from None
        if digest != contents["files"][name]:
            raise Damaged(f"{name} is not what was written")
    return Manifest(contents)


def _contents(folder: Path) -> dict[str, Any]:
    """The contents of a manifest that is whole."""
    try:
        with os.fdopen(open_regular(folder / NAME), "rb") as file:
            data = file.read(MAX_BYTES + 1)
        entry = parse_json(data) if len(data) <= MAX_BYTES else None
    except FileNotFoundError:
        raise Damaged(f"{NAME} is missing") from None
    except OSError as error:
        raise Damaged(f"{NAME} cannot be read ({error.strerror})") from None
    except ValueError:
        raise Damaged(f"{NAME} is not what was written") from None
    entry = {"sha256": None, **entry} if isinstance(entry, dict) else {}
    contents = entry.get("contents")
    if not isinstance(contents, dict) or entry.get("sha256") != _contents_digest(contents):
        raise Damaged(f"{NAME} is not what was written")
    if contents.get("schema") != SCHEMA:
        raise ValueError(
            f"{folder / NAME}: schema {contents.get('schema')!r}, expected {SCHEMA}, that of "
            f"sqn_jax {sqn_jax.__version__}"
        )
    if not _is_well_formed(contents):
        raise Damaged(f"{NAME} lacks what every manifest has")
    return contents


def _is_well_formed(contents: Mapping[str, Any]) -> bool:
    """Whether everything that is read later on is there and of its kind."""
    kinds: dict[str, Any] = {
        **dict.fromkeys(("config", "files", "versions", "leaves"), dict),
        **{"world": dict | None, "score": int | float | None, "exact": bool},
        **{"chunk": int, "device": str, "num_devices": int},
    }
    return (
        all(isinstance(contents.get(name), kind) for name, kind in kinds.items())
        and {"jax", "sqn_jax"} <= contents["versions"].keys()
        and all(isinstance(word, str) for word in contents["versions"].values())
        and all(map(_is_leaf, contents["leaves"].values()))
    )


def _is_leaf(leaf: object) -> bool:
    """Whether the description of an array has what is read of it."""
    return (
        isinstance(leaf, dict)
        and isinstance(leaf.get("dtype"), str)
        and isinstance(leaf.get("sha256"), str)
        and isinstance(shape := leaf.get("shape"), list)
        and all(isinstance(size, int) for size in shape)
    )


def differences(
    manifest: Manifest, origin: Origin, shapes: Mapping[str, Any] | None = None
) -> list[tuple[str, str, str]]:
    """In what a checkpoint is not one of a run: what, in the checkpoint, in the run.

    Args:
        manifest: of the checkpoint.
        origin: the run.
        shapes: the trees it should hold, as arrays or structs.
    """
    then = _settings(manifest.contents["config"])
    now = configs.flat(configs.to_dict(origin.config))
    rows = [
        (name, _word(then, name), _word(now, name))
        for name in [*now, *(then.keys() - now.keys())]
        if name.split(".")[0] not in CHANGEABLE and then.get(name) != now.get(name)
    ]
    # Where a map lies is no matter as long as it is the same.
    if origin.world is not None:
        rows = [row for row in rows if row[0] != "map"]
        world = configs.flat(manifest.contents["world"] or {}, "map.")
        here = configs.flat(json.loads(json.dumps(origin.world)), "map.")
        rows += [
            (name, _word(world, name), _word(here, name))
            for name in here
            if world.get(name) != here[name]
        ]
    if rows or shapes is None:
        return rows
    expected = {path: _form(leaf) for path, leaf in leaves_of(shapes)}
    written = {
        path: {"shape": leaf["shape"], "dtype": leaf["dtype"]}
        for path, leaf in manifest.leaves.items()
        if path.split("/")[0] in shapes
    }
    return [
        (path, _form_word(written.get(path)), _form_word(expected.get(path)))
        for path in sorted(expected.keys() | written.keys())
        if expected.get(path) != written.get(path)
    ]


def _settings(saved: dict[str, Any]) -> dict[str, Any]:
    """Settings as they were saved; those that have come since have their defaults, which are to
    mean what was done before there were any."""
    try:
        return configs.flat(configs.to_dict(configs.from_dict(saved)))
    except ValueError:  # There were settings that are no more: they are shown as differences.
        return configs.flat(saved)


def wrong_leaf(manifest: Manifest, items: Mapping[str, Any]) -> str | None:
    """The path of the first array that is not the one that was written; None if all are."""
    for path, leaf in leaves_of(items):
        if leaf_digest(leaf) != manifest.leaves[path]["sha256"]:
            return path
    return None


def versions() -> dict[str, str]:
    """Of what decides about the numbers of a run and the form of its checkpoints."""
    return {
        "sqn_jax": sqn_jax.__version__,
        "jax": jax.__version__,
        "orbax": version("orbax-checkpoint"),
        "python": platform.python_version(),
    }


def leaves_of(items: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Every array of some trees with its path, `params/params/perception/input_kernel`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(dict(items))
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in leaves]


def leaf_digest(leaf: Any) -> str:
    """SHA-256 of an array's bytes in row-major order, wherever its parts lie."""
    data = np.ascontiguousarray(devices.on_host(leaf)).reshape(-1).view(np.uint8)
    return hashlib.sha256(data.data).hexdigest()


def _files(folder: Path) -> list[Path]:
    """All files of a checkpoint but its manifest."""
    return sorted(
        path
        for path in folder.rglob("*")
        if path != folder / NAME and (path.is_symlink() or not path.is_dir())
    )


def _file_digest(path: Path, *, flush: bool = False) -> str:
    with os.fdopen(open_regular(path), "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        if flush:
            flush_to_disk(file.fileno())
    return digest


def _contents_digest(contents: Mapping[str, Any]) -> str:
    text = json.dumps(contents, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _form(leaf: Any) -> dict[str, Any]:
    return {"shape": list(leaf.shape), "dtype": str(leaf.dtype)}


def _form_word(form: Mapping[str, Any] | None) -> str:
    return "-" if form is None else f"{form['dtype']} {tuple(form['shape'])}"


def _word(settings: Mapping[str, Any], name: str) -> str:
    return str(settings[name]) if name in settings else "-"
