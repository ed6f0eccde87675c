"""Draw the pictures of README and docs anew: python experiments/gallery.py [--only NAME ...]

Maps and episodes are driven and drawn, by the policies that come with the package; learning curves
and noise come from the records in experiments/results/. Everything goes to docs/images/, but
for the page to play on (`--only play`), docs/play.html.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from experiments import play_page
from experiments.common import ALGORITHMS, recorded, run
from sqn_jax import figures
from sqn_jax.config.map_names import ProceduralMap, parse
from sqn_jax.config.presets import PAPER_MAPS, PRESETS
from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.evaluation.recording import Episode, record
from sqn_jax.evaluation.settings import SuiteSettings
from sqn_jax.evaluation.suite_recording import first_try, record_tasks
from sqn_jax.maps import load_map
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.tasks import TaskSuite
from sqn_jax.tasks.generate import hardest_task
from sqn_jax.training.state import params_shapes

FIGURE_AGENTS = ("SQN", "R2D2", "DQN", "best")

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "images"


@cache
def episodes(name: str, map_name: str, count: int) -> tuple[Episode, ...]:
    """The first episodes from the evaluation points, under the evaluation's first seed."""
    policy = find_policy(f"pretrained:{name}")
    recorded_episodes = record(policy, map_name, episodes=count)
    agent = policy.config.algo.upper()
    return tuple(dataclasses.replace(episode, agent=agent) for episode in recorded_episodes)


def first_to_arrive(name: str, map_name: str, count: int) -> Episode:
    """The first of these episodes that reaches its goal."""
    return next(one for one in episodes(name, map_name, count) if one.success)


def network() -> Any:
    """The network of the preset `paper`, from its parameter tree."""
    return figures.network_architecture(params_shapes(PRESETS["paper"]), title="Skill Q-Network")


def maps() -> Any:
    """The four maps with their evaluation points."""
    return figures.map_gallery([load_map(name) for name in PAPER_MAPS])


def observations() -> Any:
    """What the robot sees on each map."""
    return figures.observation_patterns([episodes("sqn", name, 1)[0] for name in PAPER_MAPS])


def coverage() -> Any:
    """The area seen during an episode."""
    return figures.coverage_example(episodes("sqn", "maze", 8)[0])


def reachability() -> Any:
    """A goal that is near but hidden, and one that is reachable."""
    return figures.reachability_example(episodes("sqn", "maze", 8))


def timeline() -> Any:
    """Skills, values and rewards along an episode."""
    return figures.episode_timeline(first_to_arrive("best", "cave", 6), title="SQN in the cave")


def skills() -> Any:
    """Which skill decides where, on every map."""
    recorded_episodes = [episode for name in PAPER_MAPS for episode in episodes("best", name, 6)]
    return figures.skill_trajectories(
        recorded_episodes, title="Weights of the two skills along the way"
    )


def failures() -> Any:
    """The tasks of its validation in which `pretrained:best` fails: the same episodes."""
    maps_tried = recorded("best_recipe_validation.json")["results"][0]["maps"]
    failed = [index for index, tried in enumerate(maps_tried) if tried["success"] == 0]
    maps = {index: parse(maps_tried[index]["map"]).names[0] for index in failed}
    tasks = {i: hardest_task(name) for i, name in maps.items() if isinstance(name, ProceduralMap)}
    # An episode follows from the number of its task; the others only stand in their places.
    every = tuple(tasks.get(index, tasks[failed[0]]) for index in range(len(maps_tried)))
    agent = TrainedAgent("SQN", (find_policy("pretrained:best"),))
    settings = first_try(SuiteSettings.seed)
    recorded_episodes = record_tasks(
        agent, TaskSuite("failures", every), failed, load_map, settings
    )
    return figures.skill_trajectories(
        recorded_episodes, title="The five of 108 validation tasks that fail"
    )


def agents() -> Any:
    """The same tasks for every agent."""
    by_agent = {name.upper(): episodes(name, "maze", 8)[:3] for name in ALGORITHMS}
    return figures.agents_side_by_side(by_agent, title="The same tasks in the maze")


def trajectories() -> Any:
    """Paths of the agents in the maze and in the cave, over the distance to the goal."""
    rows = {}
    for map_name, count in (("maze", 8), ("cave", 6)):
        by_agent = {name: episodes(name.lower(), map_name, count)[0] for name in FIGURE_AGENTS}
        rows[map_name] = by_agent
    return figures.agents_on_maps(rows, title="The same task for each agent, in two maps")


def learning_curve() -> Any:
    """How the default preset learns, from the record of a run."""
    rows = recorded("maze_quick.json")["runs"][0]["curve"]
    return figures.learning_curve(rows, title="SQN, maze")


def learning_curves() -> Any:
    """How three agents learn, from the record of the table's runs."""
    runs = recorded("pretrained_runs.json")["runs"]
    curves = {run_record["config"]["algo"].upper(): [run_record["curve"]] for run_record in runs}
    return figures.learning_curves(curves, title="Training in the maze")


def foreign_trainers() -> Any:
    """How trainers of others learn in the simulator, beside the default preset."""
    curves = {
        "RecurrentPPO of sb3-contrib": [recorded("sb3_recurrent_ppo.json")["curve"]],
        "PPO without memory": [recorded("purejaxrl_ppo.json")["curve"]],
        "SQN, preset quick": [recorded("four_rooms_runs.json")["runs"][0]["eval_curve"]],
    }
    return figures.learning_curves(curves, title="Four rooms, 6 x 6 m together")


def robustness() -> Any:
    """Success under noise, from the record of the robustness runs."""
    results = recorded("pretrained_noise.json")["results"]
    selected = [entry for entry in results if entry["goal_radius"] == results[0]["goal_radius"]]
    return figures.robustness(selected, title="Maze, evaluation points")


STILLS: dict[str, Callable[[], Any]] = {
    function.__name__: function
    for function in (
        *(
            network,
            maps,
            observations,
            coverage,
            reachability,
            timeline,
            skills,
            failures,
            agents,
            trajectories,
        ),
        *(learning_curve, learning_curves, foreign_trainers, robustness),
    )
}
FILMS = {"maze": ("sqn", 8), "cave": ("best", 6)}
"""Maps that a film is made of, who drives, and how many episodes; the first to arrive is shown."""


def main() -> None:
    """Draw what is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=[*STILLS, *FILMS, "play"], metavar="NAME")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default docs/images)")
    options = parser.parse_args()
    for name, draw in STILLS.items():
        if not options.only or name in options.only:
            figures.save(draw(), options.out / f"{name}.png")
            print(f"wrote {options.out / name}.png", flush=True)
    for name, (policy, count) in FILMS.items():
        if not options.only or name in options.only:
            film = figures.gif(first_to_arrive(policy, name, count), count=160, width_px=720)
            (options.out / f"{name}.gif").write_bytes(film)
            print(f"wrote {options.out / name}.gif", flush=True)
    if not options.only or "play" in options.only:
        page = options.out.parent / "play.html"
        play_page.write_page(page)
        pictures = play_page.take_pictures(page, options.out)
        for path in (page, *pictures):
            print(f"wrote {path}", flush=True)
        if not pictures:
            print("no pictures of it: they need chromium, chromedriver and sqn_jax[browser]")


if __name__ == "__main__":
    run(main)
