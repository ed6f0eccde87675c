"""The page: semantic HTML with its style and pictures inside; it fetches nothing."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

from sqn_jax import config as configs
from sqn_jax.config.presets import PAPER_MAPS
from sqn_jax.evaluation.paper_results import PAPER_RESULTS
from sqn_jax.evaluation.settings import Settings
from sqn_jax.report.content import Content, Run, changed_settings
from sqn_jax.report.episodes import NEAR, WorstEpisode
from sqn_jax.report.pictures import Illustration, Illustrations
from sqn_jax.storage.run_folder import CONFIG

_BASELINE_NAMES = {"oracle": "oracle (knows the map)", "bug": "bug (wall follower)"}

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff;
  max-width: 54rem; margin: 0 auto; padding: 1rem; overflow-wrap: break-word; }
h1, h2, h3 { line-height: 1.25; margin: 2rem 0 .6rem; }
h1 { font-size: 1.7rem; margin-top: .5rem; }
h2 { font-size: 1.3rem; border-bottom: 2px solid #0072b2; padding-bottom: .2rem; }
h3 { font-size: 1.05rem; }
p { margin: .6rem 0; }
.lead { font-size: 1.1rem; }
figure { margin: 1rem 0 1.5rem; }
img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption, .note { color: #555; font-size: .9rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid #ddd; text-align: right;
  white-space: nowrap; }
thead th { border-bottom: 2px solid #999; vertical-align: bottom; }
th[scope=colgroup] { text-align: center; border-bottom-width: 1px; }
th[scope=row] { position: sticky; left: 0; background: #fff; }
th[scope=row], .settings th, .settings td { text-align: left; }
tr.reference th, tr.reference td { color: #555; font-weight: normal; }
tr.first th, tr.first td { border-top: 2px solid #999; }
pre { overflow-x: auto; background: #f5f5f5; padding: .7rem; font-size: .8rem; }
summary { cursor: pointer; margin: .6rem 0; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  figure, table, .hard { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  img { max-height: 17cm; }
  .hard img { max-height: 12cm; }
  .scroll { overflow: visible; }
}
"""


def to_html(
    content: Content,
    pictures: Illustrations,
    play_links: Sequence[str | None] = (),
    *,
    no_play: str = "",
) -> str:
    """The page as text; the same content and pictures give the same text.

    Args:
        content: what it is about.
        pictures: of it.
        play_links: for each of the worst episodes where one can try it, if anywhere.
        no_play: why nobody can.
    """
    title = f"Report on {', '.join(run.name for run in content.runs)}"
    sections = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{escape(lead(content))}</p>',
        f'<p class="note">{escape(_protocol(content.settings, content.agents[0].epsilon))}</p>',
        *_worst(content.worst, pictures.worst, play_links, no_play),
        "<h2>Success and time steps</h2>",
        success_table(content.evaluation["results"], content.settings),
        *_training(content, pictures),
        "<h2>Paths</h2>",
        *map(_figure, pictures.paths),
        *_left_out(pictures),
        "<h2>One episode</h2>",
        _figure(pictures.animation),
        "<h2>Settings</h2>",
        *(part for run in content.runs for part in _settings(run)),
    ]
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            # Should anything get past the escaping, it can neither run nor fetch.
            '<meta http-equiv="Content-Security-Policy" '
            "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">",
            f"<title>{escape(title)}</title>",
            f"<style>{_STYLE}</style>",
            "</head>",
            "<body>",
            "<main>",
            *sections,
            "</main>",
            "</body>",
            "</html>",
            "",
        ]
    )


def lead(content: Content) -> str:
    """One sentence with the result of each agent."""
    parts = []
    for agent in content.agents:
        results = [
            f"{entry['success']['mean']:.2f} in {_world(entry, content.settings)} "
            f"({entry['time_steps']['mean']:,.0f} steps)"
            for entry in content.evaluation["results"]
            if entry["agent"] == agent.name
        ]
        parts.append(f"{agent.name} has success {_listed(results)}")
    return "; ".join(parts) + "."


def _listed(items: Sequence[str]) -> str:
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def _world(entry: dict[str, Any], settings: Settings) -> str:
    """The map, and also the tasks if there are two kinds of them."""
    name = str(entry["map"])
    return name if len(settings.tasks) == 1 else f"{name}, {entry['tasks']}"


def _protocol(settings: Settings, epsilon: float) -> str:
    seeds = f"evaluation seed {settings.seed}"
    if settings.eval_seeds > 1:
        last = settings.seed + settings.eval_seeds - 1
        seeds = f"each of the evaluation seeds {settings.seed} to {last}"
    tasks = {
        "evaluation points": "between the evaluation points of the map",
        "random pairs": "between random pairs of spawn points",
    }
    kind = "greedy episodes" if epsilon == 0 else "episodes"
    actions = "" if epsilon == 0 else f", each action drawn at random with probability {epsilon:g}"
    return (
        f"{settings.episodes:,} {kind} of each trained seed under {seeds}{actions}, "
        f"{' and '.join(tasks[kind] for kind in settings.tasks)}; the goal counts as reached "
        f"within {settings.goal_radii[0]:g} m of it, and a failure counts as many time steps as "
        "an episode has."
    )


def _worst(
    episodes: Sequence[WorstEpisode],
    pictures: Sequence[Illustration],
    play_links: Sequence[str | None],
    no_play: str,
) -> Iterable[str]:
    failures = sum(not worst.success for worst in episodes)
    yield "<h2>Worst episodes</h2>"
    if failures == len(episodes):
        rule = "The failures that ended farthest from the goal, along the shortest path."
    elif failures:
        rule = "All failures, then the slowest successes relative to their shortest paths."
    else:
        rule = "No episode failed: the slowest successes relative to their shortest paths."
    yield f'<p class="note">{rule}</p>'
    if no_play:
        yield f'<p class="note">There is no page to try them on: {escape(no_play)}.</p>'
    links = [*play_links, *[None] * (len(episodes) - len(play_links))]
    for number, (worst, picture) in enumerate(zip(episodes, pictures, strict=True), start=1):
        heading = f"{number}. {worst.batch.world.occupancy_map.name}: {_outcome(worst)}"
        yield '<section class="hard">'
        yield f"<h3>{escape(heading)}</h3>"
        yield f"<p>{escape(describe_episode(worst))}</p>"
        yield _figure(picture)
        if link := links[number - 1]:
            yield f'<p><a href="{escape(link)}">Try this map yourself</a></p>'
        yield "</section>"


def _outcome(worst: WorstEpisode) -> str:
    if worst.success:
        return f"reached, in {worst.slowness:.1f} times the steps of the shortest path"
    return f"not reached, {_meters(worst.remaining_path)} left"


def _meters(length: float) -> str:
    return f"{length:.1f} m" if np.isfinite(length) else "∞ m"


def describe_episode(worst: WorstEpisode) -> str:
    """What happened in an episode, with numbers."""
    batch, place = worst.batch, worst.place
    start, goal = batch.starts[worst.episode], batch.goals[worst.episode]
    where = f"within {NEAR:g} m of ({place.x:.1f}, {place.y:.1f}) m"
    steps = f"{place.steps:,} of the last {place.of:,} steps"
    if worst.success:
        outcome = (
            f"The goal was reached after {worst.steps:,} steps, {worst.slowness:.1f} times as many "
            f"as the shortest path of {_meters(worst.shortest_path)} takes at full speed. Of these "
            f"steps {place.steps:,} were spent {where}."
        )
    else:
        stuck = f"The robot got stuck: it spent {steps} {where}."
        if not place.is_most:
            stuck = f"The robot got stuck nowhere for long: at most it spent {steps} {where}."
        outcome = (
            f"The goal was not reached within {worst.steps:,} steps. {stuck} "
            f"The shortest path to the goal was {_meters(worst.shortest_path)} from the start and "
            f"{_meters(worst.remaining_path)} from the end."
        )
    collisions = {0: "no collision", 1: "1 collision"}
    outcome += f" There {'was' if worst.collisions < 2 else 'were'} "
    outcome += f"{collisions.get(worst.collisions, f'{worst.collisions:,} collisions')}."
    return (
        f"{batch.agent.name}, training seed {batch.training_seed}, in "
        f"{batch.world.occupancy_map.name} "
        f"({batch.world.tasks}, episode {worst.episode} of evaluation seed {batch.eval_seed}): "
        f"from ({start[0]:.1f}, {start[1]:.1f}) m to the goal at ({goal[0]:.1f}, {goal[1]:.1f}) m. "
        f"{outcome}"
    )


def success_table(results: Sequence[dict[str, Any]], settings: Settings) -> str:
    """Success and time steps: a row for each agent, baseline and paper result; maps across."""
    worlds = list(dict.fromkeys((entry["map"], entry["tasks"]) for entry in results))
    agents = {entry["agent"]: entry["algorithm"] for entry in results}
    entries = {(entry["agent"], entry["map"], entry["tasks"]): entry for entry in results}
    rows = []
    for agent, algorithm in agents.items():
        cells = [_cells(entries.get((agent, *world))) for world in worlds]
        name = _BASELINE_NAMES.get(algorithm, agent)
        rows.append(_row(name, cells, "reference" if algorithm in _BASELINE_NAMES else ""))
    style = "reference first"
    for algorithm in dict.fromkeys(agents.values()):
        cells = [_paper_cells(algorithm, world, settings) for world in worlds]
        if any(any(pair) for pair in cells):
            rows.append(_row(f"the paper, {algorithm.upper()}", cells, style))
            style = "reference"
    names = [_world({"map": name, "tasks": tasks}, settings) for name, tasks in worlds]
    above = "".join(f'<th colspan="2" scope="colgroup">{escape(name)}</th>' for name in names)
    below = '<th scope="col">success</th><th scope="col">steps</th>' * len(names)
    note = "In brackets: 95 % interval over episodes; training seeds may differ by more."
    if style == "reference":
        note += " The numbers of the paper are for its own maps, which are not published."
    return "\n".join(
        [
            '<div class="scroll"><table class="results">',
            f'<thead><tr><th rowspan="2" scope="col"></th>{above}</tr><tr>{below}</tr></thead>',
            "<tbody>",
            *rows,
            "</tbody></table></div>",
            f'<p class="note">{note}</p>',
        ]
    )


def _cells(entry: dict[str, Any] | None) -> tuple[str, str]:
    if entry is None:
        return "", ""
    low, high = entry["success"]["ci95"]
    success = f"{entry['success']['mean']:.2f} [{low:.2f}, {high:.2f}]"
    return success, f"{entry['time_steps']['mean']:,.1f}"


def _paper_cells(algorithm: str, world: tuple[str, str], settings: Settings) -> tuple[str, str]:
    """The numbers of the paper for one of its maps; a user's file may have the same name."""
    name, tasks = world
    results = PAPER_RESULTS.get(algorithm, {})
    is_paper_map = name in PAPER_MAPS and name in settings.maps and tasks == "evaluation points"
    if not is_paper_map or name not in results:
        return "", ""
    success, steps = results[name]
    return f"{success:.2f}", f"{steps:,.1f}"


def _row(name: str, cells: Sequence[tuple[str, str]], style: str) -> str:
    columns = "".join(f"<td>{escape(cell)}</td>" for pair in cells for cell in pair)
    return f'<tr class="{style}"><th scope="row">{escape(name)}</th>{columns}</tr>'


def _training(content: Content, pictures: Illustrations) -> Iterable[str]:
    if pictures.curves:
        yield "<h2>Training</h2>"
        yield from map(_figure, pictures.curves)


def _left_out(pictures: Illustrations) -> Iterable[str]:
    if pictures.paths_left_out:
        yield f'<p class="note">{pictures.paths_left_out} more pictures are left out.</p>'


def _figure(picture: Illustration) -> str:
    kind = "gif" if picture.data.startswith(b"GIF8") else "png"
    data = base64.b64encode(picture.data).decode("ascii")
    return (
        f'<figure><img src="data:image/{kind};base64,{data}" alt="{escape(picture.text)}">'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


def _settings(run: Run) -> Iterable[str]:
    """Where a run was trained, its changes to the nearest preset, and all of its settings."""
    config = run.policy.config
    preset, changes = changed_settings(config)
    yield f"<h3>{escape(run.name)}</h3>"
    yield f"<p>{escape(_provenance(run))}</p>"
    if changes:
        rows = "".join(
            f'<tr><th scope="row"><code>{escape(name)}</code></th>'
            f"<td>{escape(str(ours))}</td><td>{escape(str(theirs))}</td></tr>"
            for name, ours, theirs in changes
        )
        yield (
            '<div class="scroll"><table class="settings"><thead><tr><th scope="col">setting</th>'
            f'<th scope="col">this run</th><th scope="col">preset {escape(preset)}</th></tr>'
            f"</thead><tbody>{rows}</tbody></table></div>"
        )
    else:
        yield f"<p>Every setting is that of the preset {escape(preset)}.</p>"
    text = json.dumps(configs.to_dict(config), indent=2)
    yield (
        f"<details><summary>All settings ({CONFIG})</summary><pre>{escape(text)}</pre></details>"
    )


def _provenance(run: Run) -> str:
    """Device and versions from the run's own summary."""
    summary = run.summary
    parts = []
    if "device" in summary:
        count = summary.get("num_devices", 1)
        parts.append(f"device {summary['device']}" + (f" x {count}" if count != 1 else ""))
    versions = summary.get("versions")
    if isinstance(versions, dict):
        parts += [f"{name} {version}" for name, version in versions.items()]
    if isinstance(summary.get("wall_seconds"), int | float):
        parts.append(f"{summary['wall_seconds'] / 60:,.1f} minutes of training")
    if not parts:
        return "Device and versions of the training are not recorded."
    return f"Trained with {', '.join(parts)}."
