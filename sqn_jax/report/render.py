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
from sqn_jax.evaluation.agents import TrainedAgent, with_epsilons
from sqn_jax.evaluation.cached_work import cached_work
from sqn_jax.evaluation.compare import load_maps
from sqn_jax.evaluation.episodes import episode_keys
from sqn_jax.evaluation.recording import Episode, record_episodes
from sqn_jax.evaluation.settings import Settings, Tasks, World, robot_for, task_key, worlds
from sqn_jax.figures import animation
from sqn_jax.figures.skills import MAX_AGENTS, MAX_TASKS
from sqn_jax.outside.messages import say
from sqn_jax.policies.run_policies import Policy
from sqn_jax.storage.files import probe_writable, written_whole

MOST_EPISODES = 32
"""Per policy; an episode in the cave takes 9 MB of memory."""

EpisodesByAgent = Mapping[str, list[Episode]]


@cached_work()
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
    epsilon: float = 0.0,
    mp4: bool = False,
) -> list[Path]:
    """Run episodes of policies, draw them, and print progress.

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
        epsilon: probability of a random action in each step; 0 is greedy.
        mp4: also write every animation as MP4.

    Returns:
        The files written: the paths (several agents side by side, task by task), and for each agent
        a timeline of its first episode and its animations.

    Raises:
        ValueError: an option is out of its range, the map is unusable for a robot, there are too
            many policies, or the folder cannot be written.
    """
    require_drawable(episodes, animations, mp4=mp4)
    settings = Settings(
        maps=(map_name,),
        tasks=(tasks,),
        episodes=episodes,
        eval_seeds=1,
        seed=seed,
        noise=(noise,),
        max_steps=max_steps,
    )
    agents = named_agents(policies, epsilon)
    maps = load_maps(list(agents.values()), settings)
    make_folder(out)
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
        say(f"{name}: {outcome(recorded[name])}", start="\r")
    numbers = range(1, episodes + 1)
    return draw(
        recorded, out, title=tasks, kind="episode", numbers=numbers, animations=animations, mp4=mp4
    )


def require_drawable(episodes: int, animations: int, *, mp4: bool) -> None:
    """Refuse numbers of episodes and animations out of their range, and MP4 without its library.

    Raises:
        ValueError: one line that names what was expected.
    """
    if not 1 <= episodes <= MOST_EPISODES:
        raise ValueError(f"episodes is {episodes}, expected 1 to {MOST_EPISODES}")
    if not 0 <= animations <= episodes:
        raise ValueError(f"animations is {animations}, expected 0 to the {episodes} episodes")
    if mp4:
        animation.require_mp4()


def named_agents(policies: Sequence[Policy], epsilon: float) -> dict[str, TrainedAgent]:
    """The agents by their names in pictures, which say an epsilon above 0.

    Raises:
        ValueError: no policies, too many, or an epsilon that is not in 0..1.
    """
    greedy = [TrainedAgent(name, (policy,)) for name, policy in agent_names(policies).items()]
    return {agent.name: agent for agent in with_epsilons(greedy, [epsilon])}


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


def default_folder(policies: Sequence[Policy], map_name: str, suite: Path | None = None) -> Path:
    """`renders/RUN_MAP` in the current folder; with the file of a suite, `renders/RUN_SUITE`."""
    name = policies[0].name
    if len(policies) > 1:
        name += f"_and_{len(policies) - 1}_more"
    return Path("renders") / f"{name}_{parse(map_name).stem if suite is None else suite.stem}"


def _file_name(agent: str) -> str:
    return re.sub(r"[^\w.-]+", "_", agent.lower()).strip("_")


def make_folder(out: Path) -> None:
    """Make the folder to write to; refuse one that cannot be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe_writable(out)
    except OSError as error:
        raise ValueError(f"folder {out}: cannot be written ({error.strerror})") from None


def outcome(episodes: Sequence[Episode]) -> str:
    """How many goals were reached, and in how many steps."""
    steps = [episode.time_steps for episode in episodes if episode.success]
    reached = f"{len(steps)} of {len(episodes)} goals reached"
    return reached + (f", {sum(steps) / len(steps):.0f} steps on average" if steps else "")


def draw(
    recorded: EpisodesByAgent,
    out: Path,
    *,
    title: str,
    kind: str,
    numbers: Sequence[int],
    animations: int,
    mp4: bool,
) -> list[Path]:
    """Write all files with a progress bar; returns them.

    Args:
        recorded: the episodes of each agent.
        out: the folder.
        title: what the tasks are called.
        kind: what a number counts: "episode", or "task" of a suite.
        numbers: of the episodes of each agent, for titles and names of files.
        animations: how many episodes of each agent are animated.
        mp4: also as MP4.
    """
    jobs: dict[Path, Callable[[Path], None]] = _path_jobs(recorded, out, title)
    for name, episodes in recorded.items():
        map_name, file = episodes[0].occupancy_map.name, _file_name(name)
        about = f"{name}, {map_name}, {title}, {kind} {numbers[0]}"
        path = out / f"{file}_timeline_{numbers[0]}.png"
        jobs[path] = partial(_draw_timeline, episodes[0], about)
        for number, episode in list(zip(numbers, episodes, strict=True))[:animations]:
            jobs[out / f"{file}_{kind}_{number}.gif"] = partial(_draw_gif, episode)
            if mp4:
                jobs[out / f"{file}_{kind}_{number}.mp4"] = partial(_draw_mp4, episode)
    for path, job in tqdm(
        jobs.items(),
        mininterval=0.5 if sys.stderr.isatty() else 20,
        dynamic_ncols=True,
        bar_format="{percentage:3.0f}%|{bar:12}| {n_fmt}/{total_fmt} files [{elapsed}]",
    ):
        job(path)
    for path in jobs:
        say(f"wrote {path} ({_size(path.stat().st_size)})")
    return list(jobs)


def _path_jobs(
    recorded: EpisodesByAgent, out: Path, title: str
) -> dict[Path, Callable[[Path], None]]:
    """The pictures of paths: one of a single agent, or of several one for each map."""
    names = [episode.occupancy_map.name for episode in next(iter(recorded.values()))]
    maps = list(dict.fromkeys(names))
    if len(recorded) == 1:
        about = f"{maps[0]}, {title}" if len(maps) == 1 else title
        return {out / "trajectories.png": partial(_draw_paths, recorded, about)}
    jobs: dict[Path, Callable[[Path], None]] = {}
    for number, map_name in enumerate(maps, start=1):
        own = {
            agent: [one for one, name in zip(episodes, names, strict=True) if name == map_name]
            for agent, episodes in recorded.items()
        }
        file = "trajectories.png" if len(maps) == 1 else f"trajectories_map_{number}.png"
        jobs[out / file] = partial(_draw_paths, own, f"{map_name}, {title}")
    return jobs


def _draw_paths(recorded: EpisodesByAgent, title: str, path: Path) -> None:
    """The paths of one agent, or of several agents task by task on one map."""
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
