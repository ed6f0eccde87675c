"""What each skill does: python experiments/skills.py RUN|pretrained:NAME ... --out FILE

For every training seed of the policies: success of an SQN as it is, with each of its skills alone,
without each of them, and with their weights exchanged, in the same tasks; the mean weights of its
skills by what the robot is doing, and along the episode; and how much the skill with the largest
weight says about the situation (mutual information). Then the same over all seeds.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from experiments.common import run
from sqn_jax.agent.trajectory import Trajectory
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent, group_policies
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.settings import Settings
from sqn_jax.evaluation.statistics import seed_interval
from sqn_jax.policies.interventions import (
    fix_skill_weights,
    single_head,
    swap_skills,
    without_skill,
)
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.policies.run_policies import Policy, of_seed
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.storage.files import probe_file, write_json

AS_IT_IS = "as it is"
NEW_GROUND = 0.1
"""m2 a step: with less newly seen, a robot is on ground it knows."""
NEAR_WALL = 0.3
"""m from the robot's center to what the nearest beam hits."""
NEAR = 1.0
"""m from the goal: there a robot is at the goal, rather than on its way."""
PHASES = 4
"""Parts of an episode in which weights are averaged, up to the arrival."""
SHUFFLES = 20
"""How often the weights of the episodes are exchanged, for what chance alone gives."""

Flags = NDArray[np.bool_]


def variants(policy: Policy) -> dict[str, Policy]:
    """The policy, each of its skills alone, without each of them, and exchanged, by name.

    Of two skills one is alone where the other is taken out. Of a gate that was not learned only
    what each skill does alone.
    """
    count = policy.config.network.num_skills
    numbered = [(index, index + 1) for index in range(count)]
    if policy.config.network.gate != "learned":
        alone = {f"skill {number} alone": single_head(policy, index) for index, number in numbered}
        return {AS_IT_IS: policy, **alone}
    changed = {
        f"skill {number} alone": fix_skill_weights(policy, np.eye(count)[index].tolist())
        for index, number in numbered
    }
    if count > 2:
        changed |= {
            f"without skill {number}": without_skill(policy, index) for index, number in numbered
        }
    return {AS_IT_IS: policy, **changed, "exchanged": swap_skills(policy)}


def situations(trajectory: Trajectory) -> dict[str, Flags]:
    """Whether a robot was in each situation, [T, N]; it is in one at a time."""
    info = trajectory.info
    refused, fresh = info["collision"], info["covered_area"] > NEW_GROUND
    at_goal = info["goal_distance"] < NEAR
    under_way = ~at_goal & ~refused
    return {
        "at the goal": at_goal,
        "new ground": under_way & fresh,
        "known ground": under_way & ~fresh,
        "refused": refused & ~at_goal,
    }


def weights_by_situation(trajectory: Trajectory) -> dict[str, Any]:
    """Mean weights of the skills and the share of steps, before the goal and at it."""
    weights = trajectory.output.skill_weights
    return {
        name: {"share": float(steps.mean()), "weights": weights[steps].mean(axis=0).tolist()}
        for name, steps in situations(trajectory).items()
        if steps.any()
    }


def weights_over_time(weights: NDArray[Any], time_steps: NDArray[Any]) -> list[list[float]]:
    """Mean weights [PHASES, K] in equal parts of each episode up to its arrival.

    Args:
        weights: [T, N, K].
        time_steps: [N] steps up to the arrival, or all.
    """
    phases = np.arange(len(weights))[:, None] * PHASES // np.maximum(time_steps, 1)[None]
    return [weights[phases == phase].mean(axis=0).tolist() for phase in range(PHASES)]


def mutual_information(first: ArrayLike, second: ArrayLike) -> float:
    """Mutual information of two labelings of the same steps, bit: of 0, one says nothing.

    Args:
        first: whole numbers from 0, of any shape.
        second: of the same shape.
    """
    first, second = np.ravel(first), np.ravel(second)
    if not first.size:
        return 0.0
    joint = np.zeros((first.max() + 1, second.max() + 1))
    np.add.at(joint, (first, second), 1)
    joint /= first.size
    independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    known = joint > 0
    return float((joint[known] * np.log2(joint[known] / independent[known])).sum())


def information(
    trajectory: Trajectory, time_steps: NDArray[Any], max_range: float
) -> dict[str, Any]:
    """How much the skill with the largest weight says about what its robot was in, bit.

    Up to the arrival, without the first step: whether the goal was reachable (eq. 8), whether a
    wall was near, and which of `situations` the step before was. Steps of an episode are alike, so
    some information is there by chance: `by_chance` is the mean with the skills of the episodes
    exchanged between them.

    Args:
        trajectory: with `info`, `output` and `obs`.
        time_steps: [N] steps up to the arrival, or all.
        max_range: m, what a range of 1 stands for.
    """
    skills = trajectory.output.skill_weights[1:].argmax(axis=-1)
    under_way = np.arange(1, len(skills) + 1)[:, None] < time_steps[None]
    labels = {
        "goal reachable": trajectory.info["reward_navigation"][:-1] > 0,
        "wall near": trajectory.obs.ranges[1:-1].min(axis=-1) * max_range < NEAR_WALL,
        "situation": np.stack(list(situations(trajectory).values())).argmax(axis=0)[:-1],
    }
    rng = np.random.default_rng(0)
    orders = [rng.permutation(skills.shape[1]) for _ in range(SHUFFLES)]

    def bits(skills: NDArray[Any], label: NDArray[Any]) -> float:
        return mutual_information(skills[under_way], label[under_way].astype(int))

    return {
        name: {
            "bits": bits(skills, label),
            "by_chance": float(np.mean([bits(skills[:, order], label) for order in orders])),
        }
        for name, label in labels.items()
    }


def over_seeds(seeds: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Rows map, figure, mean over the training seeds with its interval, and each seed's."""
    rows = []
    for name in seeds[0]["maps"]:
        maps = [each["maps"][name] for each in seeds]
        shared = [variant for variant in maps[0] if all(variant in entries for entries in maps)]
        figures = {
            f"success {variant}": [entries[variant]["success"] for entries in maps]
            for variant in shared
        }
        of_each = [entries[AS_IT_IS] for entries in maps]
        figures["largest mean weight"] = [max(entry["mean_weights"]) for entry in of_each]
        for label in of_each[0]["information"]:
            bits = [entry["information"][label] for entry in of_each]
            figures[f"bits about {label}"] = [each["bits"] for each in bits]
            figures[f"bits about {label} by chance"] = [each["by_chance"] for each in bits]
        for label, values in figures.items():
            interval = seed_interval(values)
            shown = f"{np.mean(values):.3f}"
            if interval is not None:
                shown += f" [{interval[0]:.3f}, {interval[1]:.3f}]"
            rows.append([name, label, shown, ", ".join(f"{value:.3f}" for value in values)])
    return rows


def examine(policy: Policy, settings: Settings) -> dict[str, Any]:
    """All figures of one training seed, by map and variant."""
    agents = [TrainedAgent(name, (each,)) for name, each in variants(policy).items()]
    by_map: dict[str, Any] = {}

    def keep(batch: EpisodeBatch) -> None:
        entry: dict[str, Any] = {"success": float(np.mean(batch.main_metrics.success))}
        if batch.agent.name == AS_IT_IS:
            time_steps = np.asarray(batch.main_metrics.time_steps)
            weights = batch.trajectory.output.skill_weights
            entry["mean_weights"] = weights.mean(axis=(0, 1)).tolist()
            entry["weights"] = weights_by_situation(batch.trajectory)
            entry["weights_over_time"] = weights_over_time(weights, time_steps)
            max_range = policy.config.env.max_range
            entry["information"] = information(batch.trajectory, time_steps, max_range)
        by_map.setdefault(batch.world.occupancy_map.name, {})[batch.agent.name] = entry

    evaluate_session(agents, settings, on_evaluated=keep, fields=("info", "output", "obs"))
    return {"policy": policy.name, "seed": policy.config.seed, "maps": by_map}


def main() -> None:
    """Run all variants of all seeds and write what they came to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policies", nargs="+", metavar="RUN|pretrained:NAME")
    parser.add_argument("--maps", nargs="+", default=["maze", "cave"])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    found = [find_policy(name) for name in options.policies]
    for policy in found:
        if policy.config.algo != "sqn":
            raise ValueError(f"policy {policy.name}: is of {policy.config.algo}, expected an sqn")
    if len(group_policies(found)) > 1:
        raise ValueError("policies of different settings, expected training seeds of the same")
    probe_file(options.out)
    settings = Settings(maps=tuple(options.maps), episodes=options.episodes, eval_seeds=1)
    seeds = [
        examine(of_seed(policy, seed), settings)
        for policy in found
        for seed in policy.training_seeds
    ]
    rows = over_seeds(seeds)
    write_json(
        options.out, {"policies": options.policies, "episodes": options.episodes, "seeds": seeds}
    )
    print(markdown_table(["map", "figure", f"{len(seeds)} training seeds", "each"], rows))


if __name__ == "__main__":
    run(main)
