"""The folder of an exported policy: written as a whole or not at all.

policy.onnx         the network with all that surrounds it; describes its robot
params.safetensors  the parameters; config.json: the robot and all settings
sqn_policy.py       runs them with NumPy alone
reference.npz       a rollout to compare with
README.md           the model card
SHA256SUMS          digests of all these
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from flax import traverse_util
from numpy.typing import NDArray

from sqn_jax.agent.networks import Params
from sqn_jax.export.description import describe_policy, require_exportable
from sqn_jax.export.model_card import Result, model_card
from sqn_jax.export.rollout import reference_rollout
from sqn_jax.export.safetensors_file import to_safetensors
from sqn_jax.outside.messages import named
from sqn_jax.policies.greedy import GreedyPolicy
from sqn_jax.policies.run_policies import Policy
from sqn_jax.storage.arrays import packed_arrays
from sqn_jax.storage.files import NotWritten, write_whole

ONNX, PARAMS, CONFIG = "policy.onnx", "params.safetensors", "config.json"
RUNTIME, REFERENCE, CARD, SUMS = "sqn_policy.py", "reference.npz", "README.md", "SHA256SUMS"
FILES = (ONNX, PARAMS, CONFIG, RUNTIME, REFERENCE, CARD)
"""All files but that of the digests."""


def require_libraries(*names: str) -> None:
    """Refuse where a library of the extra `export` is missing."""
    for name in names:
        if find_spec(name) is None:
            raise ValueError(f"{name} is not installed (pip install 'sqn_jax[export]')")


def require_free(folder: Path) -> None:
    """Refuse a place that holds anything but an export, which may be replaced.

    Raises:
        ValueError: one line naming the folder and what is in it.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise ValueError(f"--out {named(folder)}: is no folder, expected a new one")
    entries = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    foreign = [name for name in entries if name not in (*FILES, SUMS)]
    if foreign or (entries and SUMS not in entries):
        what = named(Path(foreign[0])) if foreign else f"no {SUMS}"
        raise ValueError(
            f"--out {named(folder)}: holds {what}, expected a new folder or an export to replace"
        )


def export_policy(
    policy: Policy,
    out: Path,
    *,
    results: Sequence[Result] = (),
    terms: str = "",
    map_name: str = "maze",
) -> None:
    """Write the folder of a policy; one that is there already is replaced in the end.

    Args:
        policy: of one training seed.
        out: the folder.
        results: for the model card.
        terms: the license, for the model card.
        map_name: where the reference rollout takes place.

    Raises:
        ValueError: the policy cannot be exported, the folder holds something else, the map is
            unusable, or a file cannot be written.
    """
    require_libraries("onnx")
    require_exportable(policy.config)
    require_free(out)
    contents = export_contents(policy, model_card(policy, results, terms), map_name)
    try:
        _write_folder(out, contents)
    except OSError as error:
        raise error if isinstance(error, NotWritten) else NotWritten(out, error) from None


def flat_arrays(params: Params) -> dict[str, NDArray[np.float32]]:
    """The arrays of a parameter tree by their paths."""
    flat = traverse_util.flatten_dict(params, sep="/")
    return {path: np.asarray(array) for path, array in flat.items()}


def export_contents(policy: Policy, card: str, map_name: str) -> dict[str, bytes]:
    """The contents of each file, see `export_policy`."""
    from sqn_jax.export.network_graph import policy_graph

    arrays = flat_arrays(policy.params[0])
    packed = to_safetensors(arrays)
    description = describe_policy(policy) | {"params_sha256": hashlib.sha256(packed).hexdigest()}
    graph = policy_graph(policy.config, arrays, onnx_description(description))
    acting = GreedyPolicy(policy.name, policy.config, policy.params[0])
    rollout = reference_rollout(acting, map_name)
    contents = {
        ONNX: graph.SerializeToString(deterministic=True),
        PARAMS: packed,
        CONFIG: (json.dumps(description, indent=2, allow_nan=False) + "\n").encode(),
        RUNTIME: runtime_source(),
        REFERENCE: packed_arrays(rollout),
        CARD: card.encode(),
    }
    return contents | {SUMS: sums_text(contents).encode()}


def onnx_description(description: Mapping[str, Any]) -> dict[str, Any]:
    """What of `config.json` stands in the ONNX file: all but the settings of the training."""
    others = {name: description[name] for name in ("name", "versions", "params_sha256")}
    return others | description["robot"]


def runtime_source() -> bytes:
    """The file `sqn_policy.py` as it comes with this version."""
    return Path(__file__).with_name(RUNTIME).read_bytes()


def sums_text(contents: Mapping[str, bytes]) -> str:
    """Digests in the format of `sha256sum`."""
    digests = {name: hashlib.sha256(contents[name]).hexdigest() for name in FILES}
    return "".join(f"{digest}  {name}\n" for name, digest in digests.items())


def _write_folder(out: Path, contents: Mapping[str, bytes]) -> None:
    """Write beside the place, then move there; what is there already is moved away before."""
    out = out.absolute()
    partial, old = (out.with_name(f".{out.name}.{os.getpid()}.{end}") for end in ("partial", "old"))
    out.parent.mkdir(parents=True, exist_ok=True)
    partial.mkdir()
    try:
        for name, data in contents.items():
            write_whole(partial / name, data)
        if out.exists():
            out.rename(old)
        try:
            partial.rename(out)
        except BaseException:
            if old.exists():
                old.rename(out)
            raise
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
