"""The learning curve in evaluation (paper, section V-A): a run's policy, evaluated while it trains.

Success in training is that of robots which explore, on tasks that change. A point of this curve is
the policy that would be shipped then, greedy, on the same tasks at every point. They follow a key
of their own, so neither the training nor the final evaluation has anything to do with them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from sqn_jax.agent.learner import LearnerState, policy_params
from sqn_jax.agent.networks import Params
from sqn_jax.config import TrainConfig
from sqn_jax.evaluation.episodes import episode_keys, run_seeds
from sqn_jax.evaluation.paper_results import paper_reward
from sqn_jax.evaluation.settings import World, robot_for, stream_key, worlds
from sqn_jax.maps import OccupancyMap
from sqn_jax.runs.final_evaluation import settings_of
from sqn_jax.storage.metrics import evaluated_rows
from sqn_jax.training import devices, processes
from sqn_jax.training.state import network_of

CURVE_STREAM = 3
"""Which of the streams of `eval.seed` the tasks follow: those of evaluations are 0, 1 and 2."""

METRICS = {
    "eval_mean_reward": "mean_reward",
    "eval_success": "success",
    "eval_time_steps": "time_steps",
}
"""Names in metrics.jsonl, and those of `EpisodeMetrics`."""


def is_point(chunk: int, config: TrainConfig) -> bool:
    """Whether the policy is evaluated after this chunk, 1..`num_chunks`; the last is always one."""
    points, chunks = config.eval.curve_points, config.num_chunks
    return chunk * points // chunks > (chunk - 1) * points // chunks


class LearningCurve:
    """Evaluates a run's policies at the points of its learning curve."""

    def __init__(self, occupancy_map: OccupancyMap, config: TrainConfig) -> None:
        """The map is the first of the run; nothing is prepared before the first point."""
        self._map, self._config = occupancy_map, config
        self._world: World | None = None
        self.seconds = 0.0
        """Time that all points took, with compilation."""

    def point(self, chunk: int, learner: LearnerState) -> dict[str, Any]:
        """The means over the episodes by the names of `METRICS`, a list where there are seeds.

        After a chunk that is no point of the curve they are NaN, and in all processes of a run but
        the first, which evaluates alone.
        """
        num_seeds = self._config.num_seeds
        means = {name: [math.nan] * num_seeds for name in METRICS}
        if is_point(chunk, self._config):
            started = time.perf_counter()
            params = stacked_params(learner, self._config)
            if processes.is_first():
                means = self._evaluate(params)
            self.seconds += time.perf_counter() - started
        return {name: values[0] if num_seeds == 1 else values for name, values in means.items()}

    def _evaluate(self, params: Params) -> dict[str, list[float]]:
        config = self._config
        if self._world is None:
            settings = settings_of(config)
            robot = robot_for(config.env, settings)
            maps = {(settings.maps[0], robot.robot_radius): self._map}
            self._world = next(worlds(robot, maps, settings))
        results = run_seeds(
            curve_keys(config),
            params,
            self._world.env_params,
            network_of(config),
        )
        return {
            name: [float(np.mean(getattr(r.metrics[0], metric), dtype=float)) for r in results]
            for name, metric in METRICS.items()
        }


def curve_keys(config: TrainConfig) -> jax.Array:
    """The keys [E] of the episodes, the same at every point and for every training seed."""
    return episode_keys(stream_key(config.eval.seed, CURVE_STREAM), config.eval.curve_episodes)


def stacked_params(learner: LearnerState, config: TrainConfig) -> Params:
    """The policies to ship, [S, ...] on the host: the state itself is given to the next chunk."""
    params = jax.tree.map(np.array, devices.on_host(policy_params(learner, config)))
    return params if config.num_seeds > 1 else jax.tree.map(lambda x: x[None], params)


def summary_of(rows: Sequence[Mapping[str, Any]], config: TrainConfig) -> dict[str, Any] | None:
    """The last point of the curve in rows of metrics.jsonl, for the summary; None without any."""
    points = evaluated_rows(rows)
    if not points:
        return None
    means = {metric: points[-1][name] for name, metric in METRICS.items()}
    return {
        "points": len(points),
        "episodes_per_point": config.eval.curve_episodes,
        **means,
        "paper_mean_reward": paper_reward(config),
    }
