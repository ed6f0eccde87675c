"""Policies as two small files: arrays in NumPy's .npz, settings and a model card's facts in .json.

Those that come with the package are named `pretrained:NAME`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import traverse_util

from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.outside.messages import one_line
from sqn_jax.outside.reading import read_at_most, read_json
from sqn_jax.policies.run_policies import Policy, WhichParams, load_policy, require_finite
from sqn_jax.storage.arrays import MAX_HEADER_BYTES, packed_arrays, read_arrays, read_headers
from sqn_jax.storage.files import write_json, write_whole
from sqn_jax.storage.run_folder import RunFolder
from sqn_jax.training.state import params_shapes

PREFIX = "pretrained:"
SUFFIX = ".npz"

MAX_JSON_BYTES = 2**20
"""Size of the settings and the model card at most; they have some kilobytes."""


def find_policy(
    name: str, checkpoint: int | str = "newest", params: WhichParams = "shipped"
) -> Policy:
    """A policy by the name a user gives: a run folder, `pretrained:NAME`, or a file NAME.npz.

    Args:
        name: as the user gives it.
        checkpoint: of a run, see `run_policies.load_policy`; other policies have but one.
        params: the same.

    Raises:
        ValueError: there is none, or it is damaged.
    """
    if names_a_run(name):
        return load_policy(Path(name), checkpoint, params)
    if checkpoint != "newest":
        raise ValueError(f"{name}: has no checkpoint {checkpoint}, expected newest")
    if params != "shipped":
        raise ValueError(f"{name}: has no {params} parameters, expected shipped")
    if name.startswith(PREFIX):
        return load_pretrained(name.removeprefix(PREFIX))
    path = Path(name)
    return read_policy(path.parent, path.stem)


def config_of(name: str) -> TrainConfig:
    """The settings of a policy by the name a user gives, without its parameters.

    Raises:
        ValueError: there is none, or its settings cannot be read.
    """
    if names_a_run(name):
        return RunFolder.open(Path(name))[1]
    path = _settings_file(name)
    try:
        description = read_json(path, MAX_JSON_BYTES, "a policy's settings")
        if not isinstance(description, dict) or "config" not in description:
            raise ValueError(f"{path.name} lacks config, expected it")
        config: TrainConfig = configs.from_dict(description["config"])
    except ValueError as error:
        raise ValueError(f"policy {name}: cannot be read ({one_line(error)})") from None
    return config


def names_a_run(name: str) -> bool:
    """Whether a policy's name is that of a run folder, with all that a run leaves."""
    return not (name.startswith(PREFIX) or name.endswith(SUFFIX))


def pretrained_names() -> list[str]:
    """The policies that come with the package."""
    files = _folder().iterdir() if _folder().is_dir() else []
    return sorted(file.name.removesuffix(SUFFIX) for file in files if file.name.endswith(SUFFIX))


def load_pretrained(name: str) -> Policy:
    """A policy that comes with the package.

    Raises:
        ValueError: there is none of this name.
    """
    _require_pretrained(name)
    return read_policy(_folder(), name)


def _require_pretrained(name: str) -> None:
    if name not in pretrained_names():
        known = ", ".join(PREFIX + known_name for known_name in pretrained_names()) or "none"
        raise ValueError(f"{PREFIX}{name}: no such policy, expected one of {known}")


def read_policy(folder: Path, name: str) -> Policy:
    """The policy in NAME.npz and NAME.json of a folder.

    The sizes that the file states are compared with those of the network in its settings before
    anything is unpacked.

    Raises:
        ValueError: a file is missing or damaged, or the arrays are not those of the network.
    """
    try:
        description = read_json(folder / f"{name}.json", MAX_JSON_BYTES, "a policy's settings")
        if not isinstance(description, dict) or not {"config", "sha256"} <= description.keys():
            raise ValueError(f"{name}.json lacks config or sha256, expected both")
        config: TrainConfig = configs.from_dict(description["config"])
        if config.num_seeds != 1:
            raise ValueError(f"num_seeds is {config.num_seeds}, expected 1 in a policy's file")
        expected = traverse_util.flatten_dict(params_shapes(config), sep="/")
        sizes = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in expected.values())
        limit = sizes + 2 * MAX_HEADER_BYTES * (len(expected) + 1)
        packed = read_at_most(folder / f"{name}.npz", limit, "the arrays of its network")
        if hashlib.sha256(packed).hexdigest() != description["sha256"]:
            raise ValueError(f"{name}.npz is not the file that {name}.json belongs to")
        headers = read_headers(packed)
    except ValueError as error:
        raise ValueError(f"policy {name}: cannot be read ({one_line(error)})") from None
    for path in sorted(expected.keys() | headers.keys()):
        wanted = expected[path].shape if path in expected else None
        shape = headers[path][0] if path in headers else None
        if wanted != shape:
            raise ValueError(f"policy {name}: array {path} is {shape}, expected {wanted}")
        if headers[path][1] != expected[path].dtype:
            raise ValueError(
                f"policy {name}: array {path} is of type {headers[path][1]}, expected "
                f"{expected[path].dtype}"
            )
    try:
        arrays = read_arrays(packed, headers)
    except ValueError as error:
        raise ValueError(f"policy {name}: cannot be read ({one_line(error)})") from None
    params = traverse_util.unflatten_dict(arrays, sep="/")
    require_finite(params, f"policy {name}")
    return Policy(name, config, (jax.device_put(params),))


def card_of(name: str) -> dict[str, Any]:
    """The model card's facts of `pretrained:NAME` or NAME.npz; empty where the file has none.

    Raises:
        ValueError: the file of its settings is missing or damaged.
    """
    description = read_json(_settings_file(name), MAX_JSON_BYTES, "a policy's settings")
    card = description.get("card", {}) if isinstance(description, dict) else {}
    return card if isinstance(card, dict) else {}


def write_policy(folder: Path, policy: Policy, card: Mapping[str, Any], *, index: int = 0) -> None:
    """Write NAME.npz and NAME.json into a folder that exists.

    Args:
        folder: where to.
        policy: which; its name is that of the files.
        card: facts worth knowing, as JSON takes them: what it was trained on, what it reaches.
        index: which of its training seeds.
    """
    config = configs.to_public_dict(policy.config)
    config |= {"seed": policy.training_seeds[index], "num_seeds": 1}
    flat = traverse_util.flatten_dict(policy.params[index], sep="/")
    packed = packed_arrays({path: np.asarray(array) for path, array in flat.items()})
    write_whole(folder / f"{policy.name}.npz", packed)
    digest = hashlib.sha256(packed).hexdigest()
    write_json(folder / f"{policy.name}.json", {"card": card, "config": config, "sha256": digest})


def _settings_file(name: str) -> Path:
    """The .json of `pretrained:NAME` or NAME.npz."""
    if not name.startswith(PREFIX):
        return Path(name).with_suffix(".json")
    _require_pretrained(name.removeprefix(PREFIX))
    return _folder() / f"{name.removeprefix(PREFIX)}.json"


def _folder() -> Path:
    return Path(__file__).parent / "weights"
