"""The four presets: starting points that `sqn train --preset NAME` chooses between."""

from __future__ import annotations

import dataclasses

from sqn_jax.config import (
    EnvConfig,
    EvalConfig,
    ExplorationConfig,
    LearnerConfig,
    NetworkConfig,
    RandomizationConfig,
    ReplayConfig,
    TrainConfig,
)


def _quick() -> TrainConfig:
    """Recurrent PQN within the budget of two CPU cores."""
    return TrainConfig(
        method="pqn",
        total_episodes=71_680,
        num_envs=256,
        rounds_per_chunk=2,
        env=EnvConfig(near_goal_fraction=0.3),
        network=NetworkConfig(layer_norm=True),
        learner=LearnerConfig(
            batch_size=16,
            window_length=100,
            learning_rate=5e-4,
            learning_rate_schedule="linear",
            discount_start=0.95,
            discount=0.985,
            average_share=0.05,
            restart_at_goal=True,
            advantage_learning=0.8,
        ),
        exploration=ExplorationConfig(epsilon_start=0.4, epsilon_end=0.02, ladder=True),
    )


def _best() -> TrainConfig:
    """`quick` with 7.5 times the steps, on generated maps of all kinds and their mirror images.

    The Maze, the Column, the Forest and the Cave themselves are not among them. Most tasks come
    from maps on which about every other goal is reached.
    """
    quick = _quick()
    return dataclasses.replace(
        quick,
        map="maze:0-59,rooms:0-29,corridors:0-29,track:0-19,clutter:0-9,courtyard:0-9,"
        "column:0-1,forest:0-5,cave:0-19",
        task_sampling="learnability",
        total_episodes=179_200,
        # No goal is too far away to be told from one that is farther.
        env=dataclasses.replace(quick.env, goal_distance_encoding="rational"),
        # Who pushes against a corner is told so.
        network=dataclasses.replace(quick.network, motion_inputs=True),
        # 200 steps ahead: the way out of a long dead end must be worth it.
        learner=dataclasses.replace(quick.learner, discount=0.995),
        randomization=RandomizationConfig(mirror=True),
        # Hardly any random actions in half of the run: robots get stuck in time to learn from it.
        exploration=dataclasses.replace(quick.exploration, decay_fraction=0.5),
    )


def _smoke() -> TrainConfig:
    """Every part of a run in less than a minute, without learning anything useful."""
    return TrainConfig(
        method="pqn",
        total_episodes=64,
        num_envs=16,
        updates_per_round=4,
        rounds_per_chunk=2,
        env=EnvConfig(max_steps=60),
        network=NetworkConfig(layer_norm=True),
        replay=ReplayConfig(capacity=64, min_episodes=16),
        learner=LearnerConfig(
            batch_size=8,
            learning_rate=1e-3,
            discount=0.99,
            window_length=30,
            burn_in_length=5,
            average_share=0.1,
            restart_at_goal=True,
        ),
        exploration=ExplorationConfig(epsilon_start=0.5, epsilon_end=0.05, ladder=True),
        eval=EvalConfig(episodes=8, curve_points=1, curve_episodes=8),
    )


PAPER_MAPS = ("maze", "column", "forest", "cave")
"""The four kinds of maps the paper evaluates on, by the names of ours."""

PRESETS: dict[str, TrainConfig] = {
    "quick": _quick(),
    "best": _best(),
    "paper": TrainConfig(),
    "smoke": _smoke(),
}
"""`quick` is the default, `best` trains on all kinds of maps, `smoke` is for tests.

`paper` has every setting that the paper gives (sections III, IV-A, IV-C and IV-D). What it leaves
open is chosen here: learning rate, Adam's epsilon and the gradient norm, discount, `n_step`, double
Q-learning, value rescaling, priorities, size of the replay and when updates begin, robots a round
and updates an episode, the robot's and the goal's radius. docs/ARCHITECTURE.md says why. Ranges in
the replay are 8 bits; on a GPU for data centers the recurrent products of the GRU are float16.
"""
