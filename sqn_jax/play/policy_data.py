"""A policy as data for the page: its settings, and its weights as half-precision numbers."""

from __future__ import annotations

import base64
import dataclasses
from typing import Any

import numpy as np

from sqn_jax.export.description import require_exportable
from sqn_jax.export.folder import flat_arrays
from sqn_jax.policies.run_policies import Policy

PREFIX = "params/"
"""What the paths of all arrays begin with."""

BEYOND: dict[str, tuple[object, ...]] = {
    "network.cell": ("gru", "refined_gru"),
    "env.bumper": (0.0,),
}
"""What the page computes beyond what `sqn export` does, or does not, see `require_exportable`."""

LARGEST = float(np.finfo(np.float16).max)


def policy_data(policy: Policy) -> dict[str, Any]:
    """What `Policy` in `web/network.js` and `Env` in `web/env.js` are made from.

    Weights are rounded to float16, of 11 bits: half the size of float32.

    Args:
        policy: with one training seed.

    Returns:
        Texts, numbers, lists and dicts, as JSON takes them: `name`, `algo`, the settings `env` and
        `network` by their names, the `shapes` of the arrays by their paths, and `weights`, base64
        of all of them in that order.

    Raises:
        ValueError: the page does not compute such a policy, or a weight is too large for float16.
    """
    config = policy.config
    require_exportable(config, verb="played", beyond=BEYOND)
    arrays = flat_arrays(policy.params[0])
    for path, array in arrays.items():
        if (largest := np.abs(array).max()) > LARGEST:
            raise ValueError(
                f"policy {policy.name}: array {path} has a number of {largest:g}, expected at most "
                f"{LARGEST:g}"
            )
    halves = {path: array.astype("<f2") for path, array in arrays.items()}
    return {
        "name": policy.name,
        "algo": config.algo,
        "env": dataclasses.asdict(config.env),
        "network": dataclasses.asdict(config.network),
        "shapes": {path.removeprefix(PREFIX): list(half.shape) for path, half in halves.items()},
        "weights": base64.b64encode(b"".join(x.tobytes() for x in halves.values())).decode(),
    }
