"""Tables of suites of tasks: policies and baselines on maps that nobody was trained on."""

from __future__ import annotations

from experiments.common import recorded
from experiments.entries import Entry, mean, one_of, results_of
from sqn_jax.config.presets import PAPER_MAPS
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.suite_scores import worst_tenth
from sqn_jax.policies.pretrained import card_of

BEST = "pretrained:best"
BEFORE = "chain"
"""The policy that was `pretrained:best` before, the last of a chain of runs."""


def external() -> str:
    """Policies and baselines on suites from elsewhere: success, worst tenth of the maps, SPL."""
    return _suites("external.json")


def fresh() -> str:
    """The same on fresh procedural maps, one hard task each."""
    return _suites("fresh.json")


def _suites(name: str) -> str:
    """`pretrained:best` is one of the training seeds in a record of their own."""
    own, others = _by_agent("best_suites.json"), _by_agent(name)
    agents = [BEST, *(agent for agent in next(iter(others.values())) if agent != BEFORE)]
    rows = []
    for suite, found in others.items():
        found = {BEST: own[suite][f"seed{_picked_seed()}"], **found}
        cells = [_with_worst(found[agent]) if agent in found else "" for agent in agents]
        rows.append([_with_count(suite, found), *cells])
    return markdown_table(["success, worst tenth, SPL", *agents], rows)


def best() -> str:
    """All training seeds of the preset `best`, and what stood in their place before."""
    others = {**_by_agent("external.json"), **_by_agent("fresh.json")}
    labels = {
        **{f"seed{number}": f"seed {number}" for number in range(3)},
        **{BEFORE: "the chain before", "bug": "bug", "oracle": "oracle"},
    }
    rows = []
    for suite, own in _by_agent("best_suites.json").items():
        found = {**others.get(suite, {}), **own}
        cells = [_with_worst(found[agent]) if agent in found else "" for agent in labels]
        rows.append([_with_count(suite, own), *cells])
    return markdown_table(["success, worst tenth, SPL", *labels.values()], rows)


def card() -> str:
    """What `pretrained:best` reaches, for its model card: on all suites and on the four maps."""
    others = {**_by_agent("external.json"), **_by_agent("fresh.json")}
    header = ["tasks", "success", "95 % interval", "SPL", "success of the wall follower"]
    rows = []
    for suite, own in _by_agent("best_suites.json").items():
        found = {**others.get(suite, {}), **own}
        best_row = found[f"seed{_picked_seed()}"]
        bug = mean(found["bug"]) if "bug" in found else ""
        rows.append([_with_count(suite, own), *_with_interval(best_row), bug])
    entries = results_of("pretrained_table.json")
    for name in PAPER_MAPS:
        found = {agent: one_of(entries, agent, name) for agent in ("sqn best", "bug")}
        rows.append([name, *_with_interval(found["sqn best"]), mean(found["bug"])])
    return markdown_table(header, rows)


def _with_interval(entry: Entry) -> list[str]:
    low, high = entry["success"]["ci95"]
    return [mean(entry), f"{low:.2f} to {high:.2f}", f"{entry['spl']['mean']:.2f}"]


def _by_agent(name: str) -> dict[str, dict[str, Entry]]:
    """The rows of each suite of a record, by their agents."""
    suites = recorded(name)["suites"]
    return {suite: {row["agent"]: row for row in rows} for suite, rows in suites.items()}


def _picked_seed() -> int:
    """The training seed of `pretrained:best`."""
    return int(card_of(BEST)["training_seed"])


def _with_count(suite: str, found: dict[str, Entry]) -> str:
    return f"{suite} ({next(iter(found.values()))['num_tasks']} tasks)"


def _with_worst(row: Entry) -> str:
    return f"{row['success']['mean']:.2f}, {worst_tenth(row):.2f}, {row['spl']['mean']:.2f}"
