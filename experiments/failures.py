"""How policies fail: python experiments/failures.py RUN|pretrained:NAME ... --map cave --out FILE

For every ordered pair of evaluation points the share of successes, and what the robots that failed
did in their last 200 steps: stand still (all of them within 1 m), pushing against something or
not, or drive on.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.common import run
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent
from sqn_jax.evaluation.settings import Settings
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.storage.files import probe_file, write_json

LAST_STEPS = 200
STILL = 1.0
"""m; all last places of a robot that stands still lie in a square of this size."""
PUSHING = 0.5
"""A robot pushes if more than this share of its last moves was refused."""


def failures(batch: EpisodeBatch, points: NDArray[np.floating]) -> dict[str, Any]:
    """What E episodes between evaluation points [P, 2] came to."""
    success = np.asarray(batch.main_metrics.success)
    poses, collisions = batch.trajectory.poses, batch.trajectory.info["collision"]
    last = poses[-LAST_STEPS:, ~success, :2]
    still = np.ptp(last, axis=0).max(axis=-1) < STILL if last.size else np.zeros(0, bool)
    refused = collisions[-LAST_STEPS:, ~success].mean(axis=0)
    starts_at = _nearest(batch.starts[:, :2], points)
    goals_at = _nearest(batch.goals, points)
    pairs = {}
    for pair in sorted(set(zip(starts_at.tolist(), goals_at.tolist(), strict=True))):
        same = (starts_at == pair[0]) & (goals_at == pair[1])
        pairs[f"{pair[0] + 1} to {pair[1] + 1}"] = {
            "episodes": int(same.sum()),
            "success": float(success[same].mean()),
        }
    return {
        "episodes": len(success),
        "success": float(success.mean()),
        "failures": int((~success).sum()),
        "stand_still_pushing": int((still & (refused > PUSHING)).sum()),
        "stand_still_otherwise": int((still & (refused <= PUSHING)).sum()),
        "pairs": pairs,
    }


def _nearest(places: NDArray[np.floating], points: NDArray[np.floating]) -> NDArray[np.int64]:
    away = np.hypot(*np.moveaxis(places[:, None] - points[None], -1, 0))
    nearest: NDArray[np.int64] = away.argmin(axis=1)
    return nearest


def main() -> None:
    """Run every policy and write what became of its episodes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policies", nargs="+", metavar="RUN|pretrained:NAME")
    parser.add_argument("--map", default="cave")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    names = [Path(word).name for word in options.policies]
    if len(set(names)) < len(names):
        raise ValueError(f"policies {', '.join(names)}: one name comes twice")
    probe_file(options.out)
    settings = Settings(maps=(options.map,), episodes=options.episodes, eval_seeds=1)
    agents = [TrainedAgent(word, (find_policy(word),)) for word in options.policies]
    by_policy = {}

    def keep(batch: EpisodeBatch) -> None:
        points = batch.world.occupancy_map.evaluation_points
        by_policy[Path(batch.agent.name).name] = failures(batch, points)

    evaluate_session(agents, settings, on_evaluated=keep, fields=("info",))
    write_json(options.out, {"map": options.map, "last_steps": LAST_STEPS, "policies": by_policy})
    for name, counts in by_policy.items():
        print(
            f"{name}: success {counts['success']:.2f}; of {counts['failures']} failures "
            f"{counts['stand_still_pushing']} push and stand still, "
            f"{counts['stand_still_otherwise']} stand still otherwise"
        )


if __name__ == "__main__":
    run(main)
