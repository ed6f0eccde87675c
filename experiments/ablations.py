"""Does the skill ensemble help? Arms trained alike, compared by their training seeds.

    python -m experiments.ablations --arena quick|wide|caves|paper|smoke [--arms A ...]

Trains what is missing of an arena of docs/ENSEMBLE.md, the first seeds of all arms first, evaluates
every run once, and writes ablations.json, ablations.md, learning_curves.png and differences.png.
The same command resumes what was stopped; --earlier FILE adds the runs of an ablations.json that
was written elsewhere. With smoke the robots learn next to nothing; it shows that all works.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.arenas import ARENAS, ARMS, REFERENCE, Arena, Run, parse_changes, planned_runs
from experiments.arm_statistics import (
    PRIMARY,
    Scores,
    arm_results,
    arms_table,
    by_seed,
    comparison_line,
    paired_by_seed,
    verdict,
)
from experiments.common import run, train_unless_done
from sqn_jax import config as configs
from sqn_jax import figures
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent, with_epsilons
from sqn_jax.evaluation.settings import Settings, Tasks
from sqn_jax.outside.reading import read_json
from sqn_jax.policies.run_policies import load_policy
from sqn_jax.runs.evaluate import evaluate_session
from sqn_jax.storage.files import write_json, write_whole
from sqn_jax.storage.metrics import evaluated_rows
from sqn_jax.storage.run_folder import RunFolder

TASKS: tuple[Tasks, ...] = ("evaluation points", "random pairs")
PRIMARY_TASKS: Tasks = "random pairs"

SCHEMA = 1
MAX_SCORES_BYTES = 2**24

CURVE = ("episodes", "mean_reward", "success", "eval_mean_reward", "eval_success")
"""What a record keeps of a run's metrics: points in evaluation, or all rows if there are none."""


@dataclass(frozen=True)
class Result:
    """What a run came to."""

    run: Run
    scores: list[dict[str, Any]]
    """By training seed, map, tasks and epsilon."""
    curve: list[dict[str, Any]]
    """Rows of `CURVE`; none if the record of the run has none."""


def evaluation_settings(arena: Arena) -> Settings:
    """Both kinds of tasks on the maps of an arena."""
    return Settings(
        maps=arena.maps,
        tasks=TASKS,
        episodes=arena.episodes,
        eval_seeds=arena.eval_seeds,
    )


def evaluation_of(arena: Arena) -> dict[str, Any]:
    """The evaluation of an arena; the scores of arenas that share it can be compared."""
    return dataclasses.asdict(evaluation_settings(arena)) | {"epsilons": arena.epsilons}


def scores_of(trained: Run, folder: Path, arena: Arena, path: Path) -> list[dict[str, Any]]:
    """The scores of a run by training seed, map, tasks and epsilon; evaluated unless on file.

    Raises:
        ValueError: the file is of another evaluation.
    """
    settings = evaluation_settings(arena)
    run_settings = configs.to_public_dict(trained.config)
    asked = json.loads(json.dumps({"run": run_settings, **evaluation_of(arena)}))
    if path.is_file():
        found = read_json(path, MAX_SCORES_BYTES, "scores")
        if not isinstance(found, dict) or found.get("evaluation") != asked:
            raise ValueError(
                f"{path}: of another run or evaluation, expected --out to name a folder"
            )
        return whole_scores(found.get("scores"), trained, arena, str(path))
    rows: dict[tuple[Any, ...], dict[str, list[float]]] = {}

    def keep(batch: EpisodeBatch) -> None:
        occupancy_map, tasks = batch.world.occupancy_map, batch.world.tasks
        key = (batch.training_seed, occupancy_map.name, tasks, batch.agent.epsilon)
        numbers = batch.numbers(settings.goal_radii[0])
        for name in ("spl", "success", "time_steps"):
            rows.setdefault(key, {}).setdefault(name, []).append(float(numbers[name].mean()))

    agents = with_epsilons([TrainedAgent(trained.arm, (load_policy(folder),))], arena.epsilons)
    evaluate_session(list(agents), settings, on_evaluated=keep)
    scores = [
        {
            **dict(zip(("seed", "map", "tasks", "epsilon"), key, strict=True)),
            # All evaluation seeds have as many episodes.
            **{name: sum(values) / len(values) for name, values in row.items()},
        }
        for key, row in rows.items()
    ]
    write_json(path, {"evaluation": asked, "scores": scores})
    return scores


def whole_scores(rows: Any, trained: Run, arena: Arena, source: str) -> list[dict[str, Any]]:
    """Rows read from a file, once they are what an evaluation of a run writes.

    Raises:
        ValueError: one line that begins with the source: a row is missing, comes twice or is of
            something else, or a number is none or out of its range.
    """
    asked = itertools.product(trained.seeds, arena.maps, TASKS, arena.epsilons)
    try:
        found = [(row["seed"], row["map"], row["tasks"], row["epsilon"]) for row in rows]
        is_asked = sorted(found) == sorted(asked)
        is_sound = all(
            0 <= row["spl"] <= 1 and 0 <= row["success"] <= 1 and row["time_steps"] >= 0
            for row in rows
        )
    except (KeyError, TypeError):
        raise ValueError(f"{source} has scores that are none, expected those of a run") from None
    if not is_asked:
        raise ValueError(f"{source} has scores of other maps or tasks")
    if not is_sound:
        raise ValueError(f"{source} has scores out of range, expected SPL and success from 0 to 1")
    return list(rows)


def whole_curve(rows: Any, source: str) -> list[dict[str, Any]]:
    """A learning curve read from a file, once it is one.

    Raises:
        ValueError: one line that begins with the source.
    """
    numbers = (int, float, type(None))
    is_whole = isinstance(rows, list) and all(
        isinstance(row, dict)
        and isinstance(row.get("episodes"), int)
        and all(name in CURVE and isinstance(value, numbers) for name, value in row.items())
        for row in rows
    )
    if not is_whole:
        raise ValueError(f"{source} has a curve that is none, expected rows of {', '.join(CURVE)}")
    return list(rows)


def curve_of(folder: Path) -> list[dict[str, Any]]:
    """The learning curve of a run as a record keeps it."""
    metrics = RunFolder.open(folder)[0].read_metrics()
    rows = evaluated_rows(metrics) or metrics
    return [{name: row[name] for name in CURVE if name in row} for row in rows]


def earlier_results(path: Path, name: str, planned: Sequence[Run]) -> dict[str, Result]:
    """The results of the runs that a record has, by the runs' names.

    Args:
        path: an ablations.json.
        name: of the arena; a record of another that is judged alike will do.
        planned: the runs that are looked for.

    Raises:
        ValueError: the file is no record of this arena, or a run has other settings or scores.
    """
    arena, record = ARENAS[name], read_json(path, MAX_SCORES_BYTES, "ablations.json")
    alike = [other for other, each in ARENAS.items() if evaluation_of(each) == evaluation_of(arena)]
    if not isinstance(record, dict) or record.get("arena") not in alike:
        raise ValueError(f"{path}: expected an ablations.json of the arena {' or '.join(alike)}")
    if record.get("schema") != SCHEMA:
        raise ValueError(f"{path}: schema is {record.get('schema')!r}, expected {SCHEMA}")
    results = {}
    for each in planned:
        source = f"{path}: {each.name}"
        try:
            settings = record["settings"].get(each.name)
            if settings is None:
                continue
            config = configs.from_dict(settings)
            rows = [row for row in record["scores"][each.arm] if row["seed"] in each.seeds]
            curve = record.get("curves", {}).get(each.name, [])
        except (AttributeError, KeyError, TypeError):
            raise ValueError(f"{path}: not a whole ablations.json") from None
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from None
        if config != each.config:
            raise ValueError(f"{source} has other settings than it has here")
        scores = whole_scores(rows, each, arena, source)
        results[each.name] = Result(each, scores, whole_curve(curve, source))
    return results


def train_within(
    planned: Sequence[Run], arena: Arena, out: Path, minutes: float
) -> Iterator[Result]:
    """Train and evaluate runs; none is begun when the longest so far would not fit any more.

    What is evaluated already takes no time: with 0 minutes nothing is trained.

    Raises:
        ValueError: there are scores of a run without the run.
    """
    begun, longest, left_out = time.monotonic(), 0.0, []
    for each in planned:
        left = 60 * minutes - (time.monotonic() - begun)
        folder, path = out / each.name, out / f"{each.name}_scores.json"
        if path.is_file() and not (folder / "summary.json").is_file():
            raise ValueError(f"{path}: scores of a run that {folder} does not have, delete them")
        if not path.is_file() and left <= longest:
            left_out.append(each.name)
            continue
        started = time.monotonic()
        train_unless_done(each.config, folder)
        yield Result(each, scores_of(each, folder, arena, path), curve_of(folder))
        longest = max(longest, time.monotonic() - started)
    if left_out:
        print(f"--budget-minutes {minutes:g} are used up; not trained: {', '.join(left_out)}")


def comparison(scores: Scores, arena: Arena, arms: tuple[str, str]) -> dict[str, Any] | None:
    """Two arms on the maps that decide, greedy; None unless both are there."""
    if not all(arm in scores for arm in arms):
        return None
    selected = {"map": arena.primary, "tasks": PRIMARY_TASKS, "epsilon": 0.0}
    compared = paired_by_seed(*(by_seed(scores[arm], PRIMARY, **selected) for arm in arms))
    return {"arms": arms, "maps": arena.primary, **compared}


def decision(scores: Scores, arena: Arena) -> dict[str, Any] | None:
    """The comparison by which an arena is decided, with its verdict; None unless it can be made."""
    compared = comparison(scores, arena, arena.decided)
    if compared is None:
        return None
    return compared | {"verdict": verdict(compared, arena.least_difference)}


def write_results(name: str, results: Sequence[Result], out: Path) -> str:
    """Write what the runs of an arena came to; returns the page."""
    arena, scores = ARENAS[name], Scores()
    for result in results:
        scores.setdefault(result.run.arm, []).extend(result.scores)
    compared = arm_results(scores, reference=REFERENCE, primary=arena.primary)
    decided = decision(scores, arena)
    tried = [comparison(scores, arena, arms) for arms in arena.described]
    described = [found for found in tried if found is not None]
    settings = {each.run.name: configs.to_public_dict(each.run.config) for each in results}
    curves = {each.run.name: each.curve for each in results if each.curve}
    record = {"schema": SCHEMA, "arena": name, "decision": decided, "described": described}
    record |= {"results": compared, "scores": scores, "settings": settings, "curves": curves}
    write_json(out / "ablations.json", record)
    page = f"# Arena {name}\n\n{arms_table(compared)}\n"
    for found in described if decided is None else (decided, *described):
        page += f"\n{comparison_line(found)}\n"
    write_whole(out / "ablations.md", page)
    draw_curves(name, results, out / "learning_curves.png")
    others = [entry for entry in compared if entry["difference"] is not None]
    if others:
        figure = figures.paired_differences(others, title=f"Arena {name}: arm minus SQN")
        figures.save(figure, out / "differences.png")
    return page


def draw_curves(name: str, results: Sequence[Result], path: Path) -> None:
    """Draw the learning curves of the arms, but for those whose record has no curve."""
    without = sorted({each.run.arm for each in results if not each.curve})
    if without:
        print(f"no curves on record of: {', '.join(without)}")
    curves: dict[str, list[Any]] = {}
    for each in results:
        if each.run.arm not in without:
            curves.setdefault(each.run.arm, []).append(each.curve)
    if curves:
        shown = dict(list(curves.items())[: len(figures.style.COLORS)])
        title = f"Arena {name}, training seeds in evaluation"
        figures.save(figures.learning_curves(shown, title=title), path)


def main() -> None:
    """Parse the options, train, evaluate, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arena", choices=list(ARENAS), default="quick")
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), help="default: the arena's")
    parser.add_argument("--seeds", nargs="+", type=int, help="default: the arena's, from 10 on")
    parser.add_argument("--num-seeds", type=int, default=1, help="seeds side by side in a run")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="for all arms")
    parser.add_argument(
        "--budget-minutes", type=float, default=float("inf"), help="0: none is trained"
    )
    parser.add_argument(
        "--earlier",
        type=Path,
        metavar="FILE",
        help="an ablations.json: its runs are not made again",
    )
    parser.add_argument("--out", type=Path, help="default runs/ablations_ARENA")
    options = parser.parse_args()
    if options.num_seeds < 1:
        raise ValueError(f"--num-seeds is {options.num_seeds}, expected at least 1")
    if not options.budget_minutes >= 0:
        raise ValueError(f"--budget-minutes is {options.budget_minutes:g}, expected 0 or more")
    arena = ARENAS[options.arena]
    planned = planned_runs(
        arena, options.arms, options.seeds, options.num_seeds, parse_changes(options.set)
    )
    out: Path = options.out or Path("runs") / f"ablations_{options.arena}"
    out.mkdir(parents=True, exist_ok=True)
    earlier = {}
    if options.earlier is not None:
        earlier = earlier_results(options.earlier, options.arena, planned)
    missing = [each for each in planned if each.name not in earlier]
    trained = train_within(missing, arena, out, options.budget_minutes)
    known = earlier | {result.run.name: result for result in trained}
    results = [known[each.name] for each in planned if each.name in known]
    if not results:
        raise ValueError("no run is trained, expected a larger --budget-minutes")
    print(write_results(options.arena, results, out))
    print(f"wrote ablations.json, ablations.md and figures to {out}")


if __name__ == "__main__":
    run(main)
