"""Animations and pictures of trained policies on a map, for `sqn render`.

All policies get the same tasks; `recording` records their episodes, `figures` draws them.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from tqdm import tqdm

from sqn_jax import figures
from sqn_jax.config import EnvConfig
from sqn_jax.config.map_names import parse
from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.evaluation.compare import load_maps
from sqn_jax.evaluation.episodes import episode_keys
from sqn_jax.evaluation.recording import Episode, record_episodes
from sqn_jax.evaluation.settings import Settings, Tasks, World, robot_for, task_key, worlds
from sqn_jax.figures import animation
from sqn_jax.figures.skills import MAX_AGENTS, MAX_TASKS
from sqn_jax.outside.messages import say
from sqn_jax.policies.run_policies import Policy
from sqn_jax.storage.compile_cache import cached_programs
from sqn_jax.storage.files import probe_writable, written_whole

MOST_EPISODES = 32
"""Per policy; an episode in the cave takes 9 MB of memory."""

EpisodesByAgent = Mapping[str, list[Episode]]


@cached_programs()
def render_session(
    policies: Sequence[Policy],
    out: Path,
    *,
    map_name: str = "maze",
    tasks: Tasks = "evaluation points",
    episodes: int = 4,
    animations: int = 1,
    seed: int = 1_000,
    noise: tuple[float, float] = (0.0, 0.0),
    max_steps: int = 0,
    mp4: bool = False,
) -> list[Path]:
    """Run greedy episodes of policies, draw them, and print progress.

    Args:
        policies: the policies; of each, the first training seed is used.
        out: the folder to write to; created if missing; files of the same names are replaced.
        map_name: a map of the project, or a file.
        tasks: between evaluation points, or random pairs of spawn points.
        episodes: per policy, 1 to 32; the first ones of `sqn evaluate`.
        animations: per policy, 0 to `episodes`.
        seed: the evaluation seed.
        noise: of the velocity and of the ranges, in the units of each policy's config.
        max_steps: steps per episode; 0: the limit of the map.
        mp4: also write every animation as MP4.

    Returns:
        The files written: the paths (several agents side by side, task by task), and for each agent
        a timeline of its first episode and its animations.

    Raises:
        ValueError: an option is out of its range, the map is unusable for a robot, there are too
            many policies, or the folder cannot be written.
    """
    if not 1 <= episodes <= MOST_EPISODES:
        raise ValueError(f"episodes is {episodes}, expected 1 to {MOST_EPISODES}")
    if not 0 <= animations <= episodes:
        raise ValueError(f"animations is {animations}, expected 0 to the {episodes} episodes")
    if mp4:
        animation.require_mp4()
    settings = Settings(
        maps=(map_name,),
        tasks=(tasks,),
        episodes=episodes,
        eval_seeds=1,
        seed=seed,
        noise=(noise,),
        max_steps=max_steps,
    )
    agents = {name: TrainedAgent(name, (policy,)) for name, policy in agent_names(policies).items()}
    maps = load_maps(list(agents.values()), settings)
    _make_folder(out)
    world_of: dict[EnvConfig, World] = {}
    keys = episode_keys(task_key(seed, tasks), episodes)
    recorded: dict[str, list[Episode]] = {}
    for name, agent in agents.items():
        robot = robot_for(agent.env_config, settings)
        if robot not in world_of:
            say(f"preparing {map_name} for the robot ...", flush=True)
            (world_of[robot],) = worlds(robot, maps, settings)
        say(f"{name}: running ...", end="", flush=True)
        first_seed = agent.training_seeds[0]
        recorded[name] = record_episodes(keys, agent, first_seed, world_of[robot])
        say(f"{name}: {_outcome(recorded[name])}", start="\r")
    return _draw(recorded, out, tasks=tasks, animations=animations, mp4=mp4)


def agent_names(policies: Sequence[Policy]) -> dict[str, Policy]:
    """Names of the policies in pictures: the algorithm, and the run where this is not unique.

    Names that would still be equal are numbered. The seed is that of the episodes, the first one.

    Raises:
        ValueError: no policies, or too many to draw side by side.
    """
    if not 1 <= len(policies) <= MAX_AGENTS:
        raise ValueError(f"{len(policies)} policies to render, expected 1 to {MAX_AGENTS}")
    algorithms = [policy.config.algo for policy in policies]
    names: dict[str, Policy] = {}
    for policy in policies:
        name = policy.config.algo.upper()
        if algorithms.count(policy.config.algo) > 1:
            name += f" {policy.name}"
        if len(policy.params) > 1:
            name += f" seed {policy.training_seeds[0]}"
        taken = [_file_name(other) for other in names]
        number, unique_name = 1, name
        while _file_name(unique_name) in taken:
            number += 1
            unique_name = f"{name} ({number})"
        names[unique_name] = policy
    return names


def default_folder(policies: Sequence[Policy], map_name: str) -> Path:
    """`renders/RUN_MAP` in the current folder."""
    name = policies[0].name
    if len(policies) > 1:
        name += f"_and_{len(policies) - 1}_more"
    return Path("renders") / f"{name}_{parse(map_name).stem}"


def _file_name(agent: str) -> str:
    return re.sub(r"[^\w.-]+", "_", agent.lower()).strip("_")


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe_writable(out)
    except OSError as error:
        raise ValueError(f"folder {out}: cannot be written ({error.strerror})") from None


def _outcome(episodes: Sequence[Episode]) -> str:
    steps = [episode.time_steps for episode in episodes if episode.success]
    outcome = f"{len(steps)} of {len(episodes)} goals reached"
    return outcome + (f", {sum(steps) / len(steps):.0f} steps on average" if steps else "")


def _draw(
    recorded: EpisodesByAgent, out: Path, *, tasks: Tasks, animations: int, mp4: bool
) -> list[Path]:
    """Write all files with a progress bar; returns them."""
    map_name = next(iter(recorded.values()))[0].occupancy_map.name
    jobs: dict[Path, Callable[[Path], None]] = {}
    jobs[out / "trajectories.png"] = partial(_draw_paths, recorded, f"{map_name}, {tasks}")
    for name, episodes in recorded.items():
        title = f"{name}, {map_name}, {tasks}, episode 1"
        file = _file_name(name)
        jobs[out / f"{file}_timeline_1.png"] = partial(_draw_timeline, episodes[0], title)
        for number, episode in enumerate(episodes[:animations], start=1):
            jobs[out / f"{file}_episode_{number}.gif"] = partial(_draw_gif, episode)
            if mp4:
                jobs[out / f"{file}_episode_{number}.mp4"] = partial(_draw_mp4, episode)
    for path, draw in tqdm(
        jobs.items(),
        mininterval=0.5 if sys.stderr.isatty() else 20,
        dynamic_ncols=True,
        bar_format="{percentage:3.0f}%|{bar:12}| {n_fmt}/{total_fmt} files [{elapsed}]",
    ):
        draw(path)
    for path in jobs:
        say(f"wrote {path} ({_size(path.stat().st_size)})")
    return list(jobs)


def _draw_paths(recorded: EpisodesByAgent, title: str, path: Path) -> None:
    """The paths of one agent on one map, or of several agents task by task."""
    if len(recorded) == 1:
        ((name, episodes),) = recorded.items()
        figures.save(figures.skill_trajectories(episodes, title=f"{name}, {title}"), path)
        return
    first = {name: episodes[:MAX_TASKS] for name, episodes in recorded.items()}
    count = max(len(episodes) for episodes in recorded.values())
    if count > MAX_TASKS:
        title += f", the first {MAX_TASKS} of {count} tasks"
    figures.save(figures.agents_side_by_side(first, title=title), path)


def _draw_timeline(episode: Episode, title: str, path: Path) -> None:
    figures.save(figures.episode_timeline(episode, title=title), path)


def _draw_gif(episode: Episode, path: Path) -> None:
    data = animation.gif(episode)
    with written_whole(path) as partial_path:
        partial_path.write_bytes(data)


def _draw_mp4(episode: Episode, path: Path) -> None:
    animation.mp4(path, episode)


def _size(num_bytes: int) -> str:
    if num_bytes < 1e6:
        return f"{num_bytes / 1e3:.0f} kB"
    return f"{num_bytes / 1e6:.1f} MB"
