"""Animations and pictures of trained policies on tasks of a suite, for `sqn render`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from sqn_jax.evaluation.agents import TrainedAgent
from sqn_jax.evaluation.cached_work import cached_work
from sqn_jax.evaluation.settings import SuiteSettings
from sqn_jax.evaluation.suite_recording import first_try, record_tasks
from sqn_jax.evaluation.suites import SuiteMaps, evaluate_suite, num_episodes, robot_for
from sqn_jax.outside.messages import say
from sqn_jax.policies.run_policies import Policy
from sqn_jax.report.render import draw, make_folder, named_agents, outcome, require_drawable
from sqn_jax.runs.evaluate import suite_maps
from sqn_jax.runs.progress import episodes_bar
from sqn_jax.tasks import TaskSuite


@cached_work()
def render_suite_session(
    policies: Sequence[Policy],
    suite: TaskSuite,
    out: Path,
    *,
    source: Path | None = None,
    pick: Sequence[int] | Literal["worst"] = (),
    episodes: int = 4,
    animations: int = 1,
    seed: int = 1_000,
    noise: tuple[float, float] = (0.0, 0.0),
    epsilon: float = 0.0,
    mp4: bool = False,
) -> list[Path]:
    """Run tasks of a suite with policies, draw them, and print progress.

    Args:
        policies: the policies; of each, the first training seed is used.
        suite: the tasks; whether they can be solved is checked first.
        out: the folder to write to, see `render.render_session`.
        source: the file of the suite, for errors.
        pick: numbers of tasks, from 0; "worst": the `episodes` tasks with the least success of all
            policies in one try each, then the least SPL; none: the first `episodes` tasks.
        episodes: tasks to draw, 1 to 32, unless they are given by number.
        animations: per policy, 0 to the number of tasks.
        seed: the evaluation seed.
        noise: of the velocity and of the ranges, in the units of each policy's config.
        epsilon: probability of a random action in each step; 0 is greedy.
        mp4: also write every animation as MP4.

    Returns:
        The files written.

    Raises:
        ValueError: an option is out of its range, a task cannot be solved, there are too many
            policies, or the folder cannot be written.
    """
    numbers = [] if pick == "worst" else list(pick)
    require_drawable(len(numbers) or episodes, animations, mp4=mp4)
    _require_tasks(numbers, suite)
    numbers = numbers or list(range(min(episodes, len(suite.tasks))))
    agents = {
        name: dataclasses.replace(agent, policies=(_first_seed(agent.policies[0]),))
        for name, agent in named_agents(policies, epsilon).items()
    }
    settings = first_try(seed, noise)
    maps = suite_maps(list(agents.values()), suite, source)
    make_folder(out)
    if pick == "worst":
        say(f"looking for the worst of {len(suite.tasks)} tasks", flush=True)
        numbers = _worst_tasks(list(agents.values()), suite, maps, settings, len(numbers))
        say(f"the worst: {', '.join(map(str, numbers))}")
    recorded = {}
    for name, agent in agents.items():
        say(f"{name}: running ...", end="", flush=True)
        load = maps[robot_for(agent.env_config, suite).robot_radius]
        recorded[name] = record_tasks(agent, suite, numbers, load, settings)
        say(f"{name}: {outcome(recorded[name])}", start="\r")
    return draw(
        recorded,
        out,
        title=suite.name,
        kind="task",
        numbers=numbers,
        animations=min(animations, len(numbers)),
        mp4=mp4,
    )


def _first_seed(policy: Policy) -> Policy:
    config = dataclasses.replace(policy.config, num_seeds=1)
    return dataclasses.replace(policy, config=config, params=policy.params[:1])


def _require_tasks(numbers: Sequence[int], suite: TaskSuite) -> None:
    """Refuse numbers of tasks that the suite does not have, or twice."""
    for number in numbers:
        if not 0 <= number < len(suite.tasks):
            raise ValueError(f"--pick {number}: expected 0 to {len(suite.tasks) - 1}")
        if numbers.count(number) > 1:
            raise ValueError(f"--pick {number}: comes twice, expected each task once")


def _worst_tasks(
    agents: Sequence[TrainedAgent],
    suite: TaskSuite,
    maps: dict[float, SuiteMaps],
    settings: SuiteSettings,
    count: int,
) -> list[int]:
    """The numbers of the worst tasks in an evaluation, the worst first."""
    with episodes_bar(num_episodes(agents, suite, settings)) as bar:
        evaluation, _ = evaluate_suite(agents, suite, maps, settings, bar.update)
    return worst_tasks(evaluation, count)


def worst_tasks(evaluation: dict[str, Any], count: int) -> list[int]:
    """The numbers of the tasks with the least success of all agents, then the least SPL.

    Args:
        evaluation: the contents of the evaluation file of a suite.
        count: how many, the worst first.
    """
    of_agents = [entry["tasks"] for entry in evaluation["results"]]
    ranks = [
        (sum(task["success"] for task in tries), sum(task["spl"] for task in tries), number)
        for number, tries in enumerate(zip(*of_agents, strict=True))
    ]
    return [number for *_, number in sorted(ranks)[:count]]
