"""What each skill does: python experiments/skills.py RUN|pretrained:NAME --out FILE

Success of an SQN as it is, of each of its skills alone and with the weights of its skills
exchanged, in the same tasks; and the mean weights of its skills by what the robot is doing: at its
goal, on new ground, on ground it has seen, or refused a move.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import run
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent
from sqn_jax.evaluation.settings import Settings
from sqn_jax.policies.interventions import fix_skill_weights, swap_skills
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.policies.run_policies import Policy
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.storage.files import write_json

AS_IT_IS = "as it is"
NEW_GROUND = 0.1
"""m2 a step: with less newly seen, a robot is on ground it knows."""
NEAR = 1.0
"""m from the goal: there a robot is at the goal, rather than on its way."""


def variants(policy: Policy) -> dict[str, Policy]:
    """The policy, each of its skills alone, and its skills exchanged, by name."""
    count = policy.config.network.num_skills
    alone = {
        f"skill {index + 1} alone": fix_skill_weights(policy, np.eye(count)[index].tolist())
        for index in range(count)
    }
    return {AS_IT_IS: policy, **alone, "exchanged": swap_skills(policy)}


def weights_by_situation(trajectory: Trajectory) -> dict[str, Any]:
    """Mean weights of the skills and the share of steps, before the goal and at it."""
    weights, info = trajectory.output.skill_weights, trajectory.info
    refused, fresh = info["collision"], info["covered_area"] > NEW_GROUND
    at_goal = info["goal_distance"] < NEAR
    under_way = ~at_goal & ~refused
    situations = {
        "at the goal": at_goal,
        "new ground": under_way & fresh,
        "known ground": under_way & ~fresh,
        "refused": refused & ~at_goal,
    }
    return {
        name: {"share": float(steps.mean()), "weights": weights[steps].mean(axis=0).tolist()}
        for name, steps in situations.items()
        if steps.any()
    }


def main() -> None:
    """Run all variants and write what they came to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policy", metavar="RUN|pretrained:NAME")
    parser.add_argument("--maps", nargs="+", default=["maze", "cave"])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    policies = variants(find_policy(options.policy))
    agents = [TrainedAgent(name, (policy,)) for name, policy in policies.items()]
    settings = Settings(maps=tuple(options.maps), episodes=options.episodes, eval_seeds=1)
    by_map: dict[str, Any] = {}

    def keep(batch: EpisodeBatch) -> None:
        entry: dict[str, Any] = {"success": float(np.mean(batch.main_metrics.success))}
        if batch.agent.name == AS_IT_IS:
            entry["weights"] = weights_by_situation(batch.trajectory)
        by_map.setdefault(batch.world.occupancy_map.name, {})[batch.agent.name] = entry

    evaluate_session(agents, settings, on_evaluated=keep, fields=("info", "output"))
    write_json(
        options.out, {"policy": options.policy, "episodes": options.episodes, "maps": by_map}
    )
    for name, entries in by_map.items():
        for variant, entry in entries.items():
            print(f"{name}, {variant}: success {entry['success']:.2f}")
        for situation, figures in entries[AS_IT_IS]["weights"].items():
            shown = ", ".join(f"{weight:.2f}" for weight in figures["weights"])
            print(f"  {situation} ({100 * figures['share']:.0f} % of the steps): weights {shown}")


if __name__ == "__main__":
    run(main)
