"""Tables of suites of tasks: policies and baselines on maps that nobody was trained on."""

from __future__ import annotations

from experiments.common import recorded
from experiments.entries import Entry
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.suite_scores import worst_tenth

SHIPPED = ("pretrained:best", "bug", "oracle")


def external() -> str:
    """Policies and baselines on suites from elsewhere: success, worst tenth of the maps, SPL."""
    return _suites("external.json")


def fresh() -> str:
    """The same on fresh procedural maps, one hard task each."""
    return _suites("fresh.json")


def _suites(name: str) -> str:
    suites = _by_agent(name)
    rows = [
        [_with_count(suite, found), *(_with_worst(row) for row in found.values())]
        for suite, found in suites.items()
    ]
    agents = next(iter(suites.values()))
    return markdown_table(["success, worst tenth, SPL", *agents], rows)


def best() -> str:
    """All training seeds of the preset `best`, beside the policy of this name and the baselines."""
    others = {**_by_agent("external.json"), **_by_agent("fresh.json")}
    agents = (*(f"seed{number}" for number in range(3)), *SHIPPED)
    rows = []
    for suite, own in _by_agent("best_suites.json").items():
        found = {**others.get(suite, {}), **own}
        cells = [_with_worst(found[agent]) if agent in found else "" for agent in agents]
        rows.append([_with_count(suite, own), *cells])
    return markdown_table(["success, worst tenth, SPL", *agents], rows)


def _by_agent(name: str) -> dict[str, dict[str, Entry]]:
    """The rows of each suite of a record, by their agents."""
    suites = recorded(name)["suites"]
    return {suite: {row["agent"]: row for row in rows} for suite, rows in suites.items()}


def _with_count(suite: str, found: dict[str, Entry]) -> str:
    return f"{suite} ({next(iter(found.values()))['num_tasks']} tasks)"


def _with_worst(row: Entry) -> str:
    return f"{row['success']['mean']:.2f}, {worst_tenth(row):.2f}, {row['spl']['mean']:.2f}"
