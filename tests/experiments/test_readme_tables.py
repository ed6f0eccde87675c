"""The tables of README and docs: they say what the records say, and nothing else is touched."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from experiments import common, readme_tables, suite_tables
from experiments.entries import spread
from experiments.readme_tables import PAGES, ROOT, TABLES, filled


def entry(agent: str, name: str, scores: list[float], **changes: Any) -> dict[str, Any]:
    mean = sum(scores) / len(scores)
    return {
        **{"agent": agent, "map": name, "tasks": "evaluation points", "goal_radius": 0.3},
        **{"velocity_noise": 0.0, "range_noise": 0.0, "training_seeds": list(range(len(scores)))},
        **{
            "success": {"mean": mean, "std_of_means": 0.1},
            "time_steps": {"mean": 123.4},
            "success_per_seed": scores,
        },
        **{"eval_seeds": [1000, 1001], "steps_over_oracle": {"mean": 1.234}},
        **{"spl": {"mean": 0.5}, **changes},
    }


def write(folder: Path, name: str, results: list[Any], comparisons: list[Any]) -> None:
    told = {"schema": 1, "results": results, "comparisons": comparisons}
    (folder / name).write_text(json.dumps(told), encoding="utf-8")


def cells_of(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]


def test_the_pages_say_what_the_records_say() -> None:
    begun = []
    for name in PAGES:
        text = (ROOT / name).read_text(encoding="utf-8")
        assert filled(text) == text, f"{name}: run experiments/readme_tables.py"
        begun += [table for table in TABLES if f"<!-- table {table} -->" in text]
    assert set(begun) == set(TABLES)


def test_seeds_are_counted_and_spread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """0.8 and 1.0: mean 0.9, deviations of 0.1, so sqrt(0.02 / (2 - 1)) = 0.14.

    Other radii and noise are not mixed in.
    """
    maps = ("maze", "column", "forest", "cave")
    results = [entry("sqn", name, [0.8, 1.0]) for name in maps]
    results += [entry("r2d2", name, [0.5]) for name in maps]
    results += [entry("sqn", "maze", [0.0, 0.0], goal_radius=0.5)]
    results += [entry("sqn", "maze", [0.0, 0.0], velocity_noise=0.1)]
    told = {"first": "sqn", "second": "r2d2", "probability": 1.0, "ci95": [0.5, 1.0]}
    back = {"first": "r2d2", "second": "sqn", "probability": 0.0, "ci95": [0.0, 0.5]}
    write(tmp_path, "seeds_table.json", results, [told, back])
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    lines = readme_tables.seeds().splitlines()
    assert cells_of(lines[2]) == [["SQN, 2 seeds", *["0.90 ± 0.14"] * 4]]
    assert cells_of(lines[3]) == [["R2D2, 1 seed", *["0.50"] * 4]]
    assert lines[-1] == "SQN beats R2D2 with probability 1.00 [0.50, 1.00]."


def test_a_record_without_std_ddof_holds_the_population_s_deviation() -> None:
    """Two means 0.1 from theirs: 0.1 of the population, 0.1 x sqrt 2 of the sample."""
    seed = entry("sqn", "maze", [0.9])
    assert spread({**seed, "std_ddof": 0}) == pytest.approx(0.1 * 2**0.5)
    assert spread({**seed, "std_ddof": 1}) == 0.1
    four = entry("sqn", "maze", [0.8, 1.0])
    assert spread({**four, "std_ddof": 0}) == pytest.approx(0.1 * (4 / 3) ** 0.5)


def test_policies_stand_beside_the_paper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = ("maze", "column", "forest", "cave")
    agents = ("sqn best", "sqn sqn", "r2d2", "dqn", "bug", "oracle")
    results = [entry(a, m, [0.957]) for a in agents for m in maps]
    results[3]["steps_over_oracle"] = None
    write(tmp_path, "pretrained_table.json", results, [])
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    cells = cells_of(readme_tables.policies())
    assert cells[0] == ["", *maps]
    assert cells[2] == ["`pretrained:sqn`", *["0.96 ± 0.14, 123 (1.23)"] * 4]
    assert cells[5] == [
        "`pretrained:best`",
        *["0.96 ± 0.14, 123 (1.23)"] * 3,
        "0.96 ± 0.14, 123",
    ]
    assert cells[7][1] == "0.96 ± 0.14, 123", "the oracle is not held against itself"
    paper = ["SQN in the paper", "0.98, 181", "0.99, 149", "0.93, 171", "0.82, 768"]
    assert cells[8] == paper
    short = cells_of(readme_tables.agents())
    assert short[2] == ["SQN", *["0.96, 123"] * 4]
    assert short[3] == paper
    assert [row[0] for row in short[4:]] == ["R2D2", "R2D2 in the paper", "DQN", "DQN in the paper"]


def test_only_what_is_between_the_marks_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TABLES, "seeds", lambda: r"| \1 new |")
    page = "before\n<!-- table seeds -->\n| old |\n<!-- end -->\nafter <!-- end -->\n"
    assert filled(page) == page.replace("| old |", r"| \1 new |")
    with pytest.raises(ValueError, match="table nonsense: none of this name"):
        filled("<!-- table nonsense -->\n<!-- end -->")
    with pytest.raises(ValueError, match="table seeds: 0 of them with an end"):
        filled("<!-- table seeds -->\n")


def test_the_seeds_of_best_stand_beside_what_was_there_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def row(agent: str, success: float) -> dict[str, Any]:
        mean = {"mean": success, "ci95": [success - 0.1, success]}
        numbers = {"success": mean, "spl": {"mean": success / 4}}
        return {"agent": agent, "num_tasks": 7, **numbers, "worst_tenth_split": success / 2}

    seeds = [row(f"seed{number}", 0.2 * (number + 1)) for number in range(3)]
    others = [row("chain", 0.1), row("bug", 1.0), row("oracle", 1.0)]
    for name, suites in {
        "best_suites.json": {"mrpb": seeds, "maze": seeds, "real": [*seeds, row("bug", 0.5)]},
        "external.json": {"mrpb": others},
        "fresh.json": {"maze": others},
    }.items():
        (tmp_path / name).write_text(json.dumps({"suites": suites}), encoding="utf-8")
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    monkeypatch.setattr(suite_tables, "card_of", lambda name: {"training_seed": 1})
    cells = cells_of(suite_tables.best())
    assert cells[0][1:] == ["seed 0", "seed 1", "seed 2", "the chain before", "bug", "oracle"]
    last = ["0.10, 0.05, 0.03", "1.00, 0.50, 0.25", "1.00, 0.50, 0.25"]
    first = ["0.20, 0.10, 0.05", "0.40, 0.20, 0.10", "0.60, 0.30, 0.15"]
    assert cells[2] == ["mrpb (7 tasks)", *first, *last]
    assert cells[4] == ["real (7 tasks)", *first, "", "0.50, 0.25, 0.12", ""]
    maps = [
        {**entry(agent, name, [0.957]), "success": {"mean": 0.957, "ci95": [0.9, 1.0]}}
        for agent in ("sqn best", "bug")
        for name in ("maze", "column", "forest", "cave")
    ]
    write(tmp_path, "pretrained_table.json", maps, [])
    card = cells_of(suite_tables.card())
    assert card[2] == ["mrpb (7 tasks)", "0.40", "0.30 to 0.40", "0.10", "1.00"]
    assert card[4][4] == "0.50"
    assert card[5] == ["maze", "0.96", "0.90 to 1.00", "0.50", "0.96"]
    suites = cells_of(suite_tables.external())
    assert suites[0][1:] == ["pretrained:best", "bug", "oracle"]
    assert suites[2] == ["mrpb (7 tasks)", first[1], *last[1:]]
