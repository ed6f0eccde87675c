"""Policies as two small files: arrays in NumPy's .npz, settings and a model card's facts in .json.

Those that come with the package are named `pretrained:NAME`.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.policies.run_policies import Policy, WhichParams, load_policy
from sqn_jax.storage.files import write_json
from sqn_jax.training.state import params_shapes

PREFIX = "pretrained:"
SUFFIX = ".npz"


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
    if name not in pretrained_names():
        known = ", ".join(PREFIX + known_name for known_name in pretrained_names()) or "none"
        raise ValueError(f"{PREFIX}{name}: no such policy, expected one of {known}")
    return read_policy(_folder(), name)


def read_policy(folder: Traversable, name: str) -> Policy:
    """The policy in NAME.npz and NAME.json of a folder.

    Raises:
        ValueError: a file is missing or damaged, or the arrays are not those of the network.
    """
    try:
        description = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        config = configs.from_dict(description["config"])
        packed = (folder / f"{name}.npz").read_bytes()
        if hashlib.sha256(packed).hexdigest() != description["sha256"]:
            raise ValueError(f"{name}.npz is not the file that {name}.json belongs to")
        with np.load(io.BytesIO(packed), allow_pickle=False) as file:
            arrays = {path: file[path] for path in file.files}
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"policy {name}: cannot be read ({error})") from None
    return Policy(name, config, (_tree(arrays, config, name),))


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
    file = io.BytesIO()
    arrays = {path: np.asarray(array) for path, array in flat.items()}
    np.savez_compressed(file, allow_pickle=False, **arrays)
    packed = file.getvalue()
    (folder / f"{policy.name}.npz").write_bytes(packed)
    digest = hashlib.sha256(packed).hexdigest()
    write_json(folder / f"{policy.name}.json", {"card": card, "config": config, "sha256": digest})


def _folder() -> Traversable:
    return resources.files("sqn_jax.policies") / "weights"


def _tree(arrays: Mapping[str, Any], config: TrainConfig, name: str) -> Any:
    expected = traverse_util.flatten_dict(params_shapes(config), sep="/")
    for path in sorted(expected.keys() | arrays.keys()):
        wanted = expected[path].shape if path in expected else None
        shape = arrays[path].shape if path in arrays else None
        if wanted != shape:
            raise ValueError(f"policy {name}: array {path} is {shape}, expected {wanted}")
    loaded = {path: jnp.asarray(array, expected[path].dtype) for path, array in arrays.items()}
    return traverse_util.unflatten_dict(loaded, sep="/")
