"""The end of a training run: final evaluation, figures, summary."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

import sqn_jax
from sqn_jax.agent.networks import Params
from sqn_jax.agent.program import Program
from sqn_jax.config import TrainConfig
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent
from sqn_jax.evaluation.compare import evaluate_agents
from sqn_jax.evaluation.paper_results import paper_reward
from sqn_jax.evaluation.settings import Settings
from sqn_jax.maps import OccupancyMap
from sqn_jax.outside.messages import say
from sqn_jax.policies.run_policies import Policy, seeds_of
from sqn_jax.storage.run_folder import RunFolder
from sqn_jax.training import devices, memory_budget

FIELDS = ("output",)
"""What the figures need of the steps, beside the poses."""


def settings_of(config: TrainConfig) -> Settings:
    """The settings of the final evaluation of a run: its first map, both kinds of tasks."""
    return Settings(
        maps=(str(config.maps.names[0]),),
        tasks=("evaluation points", "random pairs"),
        episodes=config.eval.episodes,
        eval_seeds=1,
        seed=config.eval.seed,
        noise=((config.env.velocity_noise, config.env.range_noise),),
        goal_radii=(config.env.goal_radius,),
        max_steps=config.env.max_steps,
    )


def require_memory(program: Program) -> None:
    """Refuse a run whose final evaluation would not fit into memory; asked before it is trained."""
    config = program.config
    settings = settings_of(config)
    numbers = 3 + 5 + 6 * config.network.num_skills
    # The steps of both kinds of tasks, what is joined, and a copy for the figures.
    copies = len(settings.tasks) + 2
    needed = 4.0 * numbers * program.max_steps * settings.episodes * copies
    memory_budget.require(needed, "the final evaluation", "final evaluation")


def evaluate_run(
    params: Params, occupancy_map: OccupancyMap, config: TrainConfig, folder: RunFolder
) -> tuple[list[dict[str, Any]], list[EpisodeBatch]]:
    """Run greedy episodes of every training seed, between evaluation points and random pairs.

    Args:
        params: those of the policy, of all training seeds.
        occupancy_map: the first map of the run.
        config: the config of the run.
        folder: the run folder.

    Returns:
        The results, and the episodes of the first seed for each kind of task.
    """
    # On one device; otherwise every program that uses them would run on all of the mesh.
    params = jax.device_put(params, jax.local_devices()[0])
    policy = Policy(folder.path.name, config, seeds_of(params, config))
    of_first_seed: list[EpisodeBatch] = []

    def collect(batch: EpisodeBatch) -> None:
        if batch.training_seed == policy.training_seeds[0]:
            of_first_seed.append(batch)

    evaluation, records = evaluate_agents(
        [TrainedAgent(config.algo, (policy,))],
        {(str(config.maps.names[0]), config.env.robot_radius): occupancy_map},
        settings_of(config),
        on_evaluated=collect,
        fields=FIELDS,
    )
    folder.write_json("evaluation.json", evaluation)
    folder.write_records("evaluation.jsonl", records)
    return evaluation["results"], of_first_seed


def draw_figures(
    batches: list[EpisodeBatch], occupancy_map: OccupancyMap, config: TrainConfig, folder: RunFolder
) -> bool:
    """Write the figures; print a message and return False if Matplotlib is not installed."""
    try:
        from sqn_jax import figures
    except ImportError:
        say("no figures: Matplotlib is not installed (pip install 'sqn_jax[viz]')")
        return False
    name = f"{config.algo.upper()}, {occupancy_map.name}"
    if (count := len(config.maps.names)) > 1:
        name += f" (trained on {count} maps)"
    curve = figures.learning_curve(
        folder.read_metrics(), title=name, paper_reward=paper_reward(config)
    )
    figures.save(curve, folder.figures / "learning_curve.png")
    for batch in batches:
        tasks = batch.world.tasks
        figure = figures.trajectories(
            occupancy_map,
            batch.goals,
            batch.trajectory.poses,
            batch.trajectory.output.skill_weights,
            batch.main_metrics.success,
            batch.main_metrics.time_steps,
            goal_radius=config.env.goal_radius,
            robot_radius=config.env.robot_radius,
            title=f"{name}, {tasks}" + (f", seed {config.seed}" if config.num_seeds > 1 else ""),
        )
        figures.save(figure, folder.figures / f"trajectories_{tasks.replace(' ', '_')}.png")
    return True


def _duration(seconds: float) -> str:
    return f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.1f} s"


def conclude(
    results: list[dict[str, Any]],
    timing: dict[str, float],
    has_figures: bool,
    config: TrainConfig,
    folder: RunFolder,
    curve: dict[str, Any] | None = None,
) -> None:
    """Write summary.json, with the end of the learning curve if there is one, and print it."""
    summary: dict[str, Any] = {
        "episodes": config.num_rounds * config.num_envs,
        "wall_seconds": round(timing["train_seconds"], 1),
        "compile_seconds": round(timing["compile_seconds"], 1),
        "compiled_earlier": bool(timing["compiled_earlier"]),
        "steps_per_second": round(timing["env_steps"] / max(timing["train_seconds"], 1e-9)),
        "device": devices.describe(),
        "num_devices": timing["num_devices"],
        "versions": {"sqn_jax": sqn_jax.__version__, "jax": jax.__version__},
    }
    summary |= {
        entry["tasks"].replace(" ", "_"): {
            "success": entry["success"]["mean"],
            "time_steps": entry["time_steps"]["mean"],
        }
        for entry in results
    }
    if curve is not None:
        curve = {**curve, "seconds": round(timing.get("curve_seconds", 0.0), 1)}
        summary["learning_curve"] = curve
    # Before anything is printed: the reader of a pipe may have left.
    folder.write_json("summary.json", summary)
    say(
        f"trained in {_duration(summary['wall_seconds'])} "
        f"({summary['steps_per_second']:,} steps a second on average)"
    )
    for entry in results:
        low, high = entry["success"]["ci95"]
        say(
            f"{entry['tasks'] + ':':19} success {entry['success']['mean']:.2f} "
            f"[{low:.2f}, {high:.2f}], {entry['time_steps']['mean']:.0f} steps "
            f"({config.eval.episodes} greedy episodes"
            + (f" of each of {config.num_seeds} seeds)" if config.num_seeds > 1 else ")")
        )
    if curve is not None:
        paper = curve["paper_mean_reward"]
        say(
            f"{'learning curve:':19} mean reward {np.mean(curve['mean_reward']):.2f} at its end"
            + ("" if paper is None else f" (the paper's {config.algo.upper()}: {paper:.2f})")
            + f"; {curve['points']} evaluation{'s' * (curve['points'] != 1)}, "
            + f"{_duration(curve['seconds'])} in all"
        )
    if has_figures:
        say(f"figures in {folder.figures}")
