"""What is put into the package: an average of two policies is between them, number by number."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from rooms import random_params, small_room

from experiments.ship_weights import averaged
from sqn_jax.agent import make_network
from sqn_jax.config import NetworkConfig, TrainConfig
from sqn_jax.env import NUM_ACTIONS
from sqn_jax.policies.pretrained import write_policy
from sqn_jax.policies.run_policies import Policy


def a_policy(hidden_size: int, *seeds: int) -> Policy:
    config = TrainConfig(num_seeds=len(seeds), network=NetworkConfig(hidden_size=hidden_size))
    network = make_network("sqn", config.network, NUM_ACTIONS)
    params = tuple(random_params(network, small_room(9), seed) for seed in seeds)
    return Policy("other", config, params)


def saved(policy: Policy, folder: Path) -> str:
    write_policy(folder, policy, {})
    return str(folder / f"{policy.name}.npz")


def test_an_average_holds_a_share_of_each_of_two_policies(tmp_path: Path) -> None:
    own, other = a_policy(8, 1, 2), a_policy(8, 3)
    found = averaged(own, saved(other, tmp_path), 0.75)
    assert (found.name, found.config) == (own.name, own.config)
    theirs = jax.tree.leaves(other.params[0])
    for params, before in zip(found.params, own.params, strict=True):
        for mixed, a, b in zip(
            jax.tree.leaves(params), theirs, jax.tree.leaves(before), strict=True
        ):
            expected = (3 * np.asarray(a, np.float64) + np.asarray(b, np.float64)) / 4
            np.testing.assert_allclose(mixed, expected, rtol=1e-6, atol=1e-7)


def test_what_cannot_be_averaged_is_refused(tmp_path: Path) -> None:
    own = a_policy(8, 1)
    word = saved(a_policy(8, 3), tmp_path)
    for share in (0.0, 1.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="expected between 0 and 1"):
            averaged(own, word, share)
    wider = saved(dataclasses.replace(a_policy(16, 3), name="wider"), tmp_path)
    with pytest.raises(ValueError, match=r"hidden_size is 16, here it is 8"):
        averaged(own, wider, 0.5)
