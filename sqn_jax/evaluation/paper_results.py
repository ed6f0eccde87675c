"""The results reported in the paper, for comparison with ours."""

from __future__ import annotations

from sqn_jax.config import Algorithm, TrainConfig
from sqn_jax.config.presets import PAPER_MAPS

_TABLE: dict[Algorithm, tuple[tuple[float, float], ...]] = {
    "dqn": ((0.72, 253.0), (0.95, 151.5), (0.97, 167.0), (0.38, 1061.4)),
    "r2d2": ((0.70, 257.8), (0.99, 172.4), (0.91, 221.8), (0.64, 937.7)),
    "sqn": ((0.98, 181.1), (0.99, 148.7), (0.93, 171.4), (0.82, 767.5)),
}
"""In the order of `PAPER_MAPS`."""

PAPER_RESULTS: dict[str, dict[str, tuple[float, float]]] = {
    algorithm: dict(zip(PAPER_MAPS, row, strict=True)) for algorithm, row in _TABLE.items()
}
"""Success and time steps, table I of the paper, by algorithm and the name of our map.

The maps of the paper are not published; ours are similar but not the same."""

PAPER_REWARDS: dict[str, float] = {"sqn": 1.35, "r2d2": 1.18, "dqn": 1.10}
"""Mean reward a step in evaluation, at the end of training in the maze (paper, section V-A)."""


def paper_reward(config: TrainConfig) -> float | None:
    """The paper's final mean reward to set beside a run; None for a run on another map."""
    return PAPER_REWARDS[config.algo] if str(config.maps.names[0]) == "maze" else None
