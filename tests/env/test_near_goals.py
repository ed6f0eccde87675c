"""Training tasks with a near goal: the share asked for, and only goals that are near."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from sqn_jax.config import EnvConfig
from sqn_jax.env import make_env, sample_task


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_the_share_of_tasks_with_a_near_goal_is_as_asked(share: float) -> None:
    params = make_env("maze", EnvConfig(near_goal_fraction=share))
    keys = jax.random.split(jax.random.key(4), 4000)
    poses, goals = jax.jit(jax.vmap(sample_task, in_axes=(0, None)))(keys, params)
    distance = np.hypot(*np.asarray(poses[:, :2] - goals).T)
    # Spawn points stand 2.1 m apart in rows and columns, and tasks within 0.5 m of them: one of
    # the four nearest (at a border one two rows on, 4.2 m) is never farther than 5.25 m.
    near = distance < 5.25
    if share == 1.0:
        assert near.all()
    # Of two different points of the 64 chosen at random, 4 of the 63 others are among the nearest.
    # How many lie within 5.25 m at random is read off the same map with a share of 0.
    plain = make_env("maze", EnvConfig())
    plain_poses, plain_goals = jax.jit(jax.vmap(sample_task, in_axes=(0, None)))(keys, plain)
    at_random = (np.hypot(*np.asarray(plain_poses[:, :2] - plain_goals).T) < 5.25).mean()
    expected = share + (1 - share) * at_random
    assert near.mean() == pytest.approx(expected, abs=0.035)
