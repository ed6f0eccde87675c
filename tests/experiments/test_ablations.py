"""Arms beside each other: which runs are made, and what is said of them, by hand and by SciPy."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from experiments import ablations
from experiments.ablations import decision
from experiments.arenas import ARENAS, ARMS, parse_changes, planned_runs, with_settings
from experiments.arm_statistics import (
    arm_results,
    arms_table,
    holm,
    paired_by_seed,
    verdict,
)
from experiments.common import RESULTS
from experiments.power import paired_differences, power, runs_on_record
from sqn_jax import config as configs
from sqn_jax import figures
from sqn_jax.config import TrainConfig


@pytest.mark.parametrize("name", list(ARENAS))
def test_the_runs_of_an_arena_differ_in_what_their_arms_say_and_in_their_seeds(name: str) -> None:
    arena = ARENAS[name]
    runs = planned_runs(arena)
    assert len({run.name for run in runs}) == len(runs) == sum(arena.seeds.values())
    plain = {run.config.seed: run.config for run in runs if run.arm == "sqn"}
    for run in runs:
        assert run.arm == "sqn" or run.config != plain[run.config.seed]
        if run.config.seed == arena.first_seed:  # To change settings takes its time.
            assert run.config == with_settings(plain[arena.first_seed], ARMS[run.arm])
    # Whatever the budget leaves, the arms that decide have the same seeds, or one more.
    for count in range(1, len(runs) + 1):
        begun = [run.arm for run in runs[:count]]
        first, second = (begun.count(arm) for arm in arena.decided)
        assert abs(first - second) <= 1
    assert set(arena.primary) <= set(arena.maps)
    assert {arm for arms in (arena.decided, *arena.described) for arm in arms} <= set(arena.seeds)
    assert arena.first_seed >= 10


def test_seeds_of_ones_own_and_side_by_side() -> None:
    arena = ARENAS["quick"]
    names = [run.name for run in planned_runs(arena, ["sqn", "dqn"], [3, 4])]
    assert names == ["sqn_seed3", "dqn_seed3", "sqn_seed4", "dqn_seed4"]
    wide = planned_runs(arena, ["r2d2"], num_seeds=5)
    assert [run.name for run in wide] == ["r2d2_seeds10to14", "r2d2_seeds15to19"]
    with pytest.raises(ValueError, match=r"--seeds \[3, 4\] with --num-seeds 2: seeds come twice"):
        planned_runs(arena, ["sqn"], [3, 4], 2)
    (run,) = planned_runs(arena, ["sqn"], [3], 1, {"learner.discount": 0.9})
    assert (run.config.learner.discount, run.config.seed) == (0.9, 3)
    with pytest.raises(ValueError, match=r"--set seed: expected --seeds and --num-seeds"):
        planned_runs(arena, ["sqn"], [3], 1, {"seed": 7})
    with pytest.raises(ValueError, match=r"--num-seeds is 2, expected a divisor of the 3 seeds"):
        planned_runs(arena, ["dqn"], num_seeds=2)
    for name, value in (("algo", "dqn"), ("network.num_skills", 3)):
        with pytest.raises(ValueError, match=rf"--set {name}: is what arms differ in"):
            planned_runs(arena, ["sqn"], [3], 1, {name: value})
    with pytest.raises(ValueError, match=r"--arms sqn sqn: one comes twice"):
        planned_runs(arena, ["sqn", "sqn"])


@pytest.mark.parametrize(
    ("texts", "fault"),
    [
        (["discount"], "--set discount: expected NAME=VALUE"),
        (["learner.speed=3"], "learner.speed is 3, expected one of the fields"),
        (["lerner.discount=0.9"], "lerner.discount: no such setting"),
        (["learner.discount=much"], "learner.discount is 'much', expected a value of type float"),
        (["learner.discount=1.5"], "learner.discount is 1.5, expected"),
        (["=0.9"], "--set =0.9: expected NAME=VALUE"),
        (["learner.discount=" + 9_999 * "["], r"learner.discount is '\[\[.*, expected a value of"),
    ],
)
def test_settings_that_are_none_are_refused_by_name(texts: list[str], fault: str) -> None:
    with pytest.raises(ValueError, match=f"^{fault}"):
        with_settings(TrainConfig(), parse_changes(texts))


def test_no_run_is_begun_that_the_budget_has_no_room_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [0.0]
    monkeypatch.setattr(ablations.time, "monotonic", lambda: clock[0])

    def train(config: TrainConfig, folder: Path) -> None:
        clock[0] += 250.0

    monkeypatch.setattr(ablations, "train_unless_done", train)
    monkeypatch.setattr(ablations, "scores_of", lambda *arguments: [])
    monkeypatch.setattr(ablations, "curve_of", lambda folder: [])
    runs = planned_runs(ARENAS["smoke"])
    # Two runs take 500 s of 720; for a third there is no room, unless it is there already.
    results = ablations.train_within(runs, ARENAS["smoke"], tmp_path, 12)
    done = [result.run.name for result in results]
    assert done == ["sqn_seed10", "r2d2_seed10"]
    assert "not trained: equal_seed10, sqn_seed11, r2d2_seed11" in capsys.readouterr().out
    # What lies beyond a run that is left out counts, and with no minutes it alone does.
    (tmp_path / "sqn_seed11_scores.json").touch()
    with pytest.raises(ValueError, match=r"scores of a run that .*sqn_seed11 does not have"):
        list(ablations.train_within(runs, ARENAS["smoke"], tmp_path, 0))
    (tmp_path / "sqn_seed11").mkdir()
    (tmp_path / "sqn_seed11/summary.json").touch()
    for minutes, expected in ((12, [*done, "sqn_seed11"]), (0, ["sqn_seed11"])):
        results = ablations.train_within(runs, ARENAS["smoke"], tmp_path, minutes)
        assert [result.run.name for result in results] == expected


def test_intervals_over_seeds_are_student_s_and_the_test_is_exact() -> None:
    first = {10: 0.75, 11: 0.76, 12: 0.71, 13: 0.80, 14: 0.9}
    second = {10: 0.70, 11: 0.72, 12: 0.72, 13: 0.74, 99: 0.1}
    found = paired_by_seed(first, second)
    differences = np.array([0.05, 0.04, -0.01, 0.06])
    assert found["seeds"] == [10, 11, 12, 13]
    assert found["difference"] == pytest.approx(0.035)
    theirs = stats.ttest_1samp(differences, 0).confidence_interval()
    assert found["ci95"] == pytest.approx(list(theirs))
    # Of the 16 ways of exchanging, those with as large a sum: all as they are, the third turned,
    # and the same with all turned.
    assert found["p_value"] == pytest.approx(4 / 16)
    assert paired_by_seed({1: 0.5}, {2: 0.5})["difference"] is None


@pytest.mark.parametrize(
    ("interval", "p_value", "expected"),
    [
        ((0.01, 0.05), 0.01, "yes"),
        ((0.005, 0.018), 0.001, "no"),  # More, but too little to count.
        ((-0.03, 0.01), 0.4, "no"),
        ((-0.09, -0.01), 0.01, "no"),
        ((-0.01, 0.05), 0.2, "undecided"),
        ((-0.05, 0.03), 0.6, "undecided"),
        (None, None, "undecided"),
    ],
)
def test_the_verdict_is_that_of_the_protocol(
    interval: Any, p_value: float | None, expected: str
) -> None:
    mean = None if interval is None else sum(interval) / 2
    found = {"difference": mean, "ci95": interval, "p_value": p_value}
    assert verdict({**found, "seeds": [1] if interval is None else range(6)}) == expected
    assert verdict({**found, "seeds": range(5)}) == "undecided"
    if expected == "yes":  # By 0.03.
        assert verdict({**found, "seeds": range(6)}, 0.03) == "yes"
        assert verdict({**found, "seeds": range(6)}, 0.031) == "undecided"


def test_p_values_are_adjusted_as_holm_says() -> None:
    # Ascending 0.01 x 4, 0.03 x 3, 0.04 x 2 (at least the one before), 0.5.
    assert holm([0.04, 0.01, 0.5, 0.03]) == pytest.approx([0.09, 0.04, 0.5, 0.09])
    assert holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])
    assert holm([]) == []


def rows(spl: dict[int, float], name: str = "maze", tasks: str = "random pairs") -> list[Any]:
    return [
        {"seed": seed, "map": name, "tasks": tasks, "epsilon": 0.0}
        | {"spl": value, "success": value + 0.2, "time_steps": 80.0}
        for seed, value in spl.items()
    ]


def test_arms_are_compared_on_their_common_seeds_map_by_map() -> None:
    spl = {"sqn": {10: 0.70, 11: 0.76}, "r2d2": {10: 0.66, 11: 0.70}, "dqn": {10: 0.5}}
    scores = {
        arm: [
            row
            for name in ("maze", "maze:100", "maze:101")
            for tasks in ("evaluation points", "random pairs")
            for row in rows(of_seeds, name, tasks)
        ]
        for arm, of_seeds in spl.items()
    }
    (lower,) = (
        row
        for row in scores["sqn"]
        if (row["map"], row["tasks"], row["seed"]) == ("maze:101", "random pairs", 10)
    )
    lower["spl"] = 0.4
    results = arm_results(scores, reference="sqn")
    found = {(entry["maps"], entry["tasks"], entry["arm"]): entry for entry in results}
    first = found["maze", "random pairs", "r2d2"]
    assert results[0] == found["maze", "random pairs", "sqn"]
    assert first["difference"] == pytest.approx(-0.05)
    assert first["spl"]["mean"] == pytest.approx(0.68)
    assert first["success"]["mean"] == pytest.approx(0.88)
    assert found["maze", "random pairs", "dqn"]["difference"] == pytest.approx(-0.2)
    assert found["maze", "random pairs", "dqn"]["difference_ci95"] is None
    # The unseen mazes are judged together: 0.70 and 0.4 of seed 10, 0.76 of seed 11.
    assert found["mazes unseen", "random pairs", "sqn"]["spl"]["mean"] == pytest.approx(0.655)
    table = arms_table(results)
    assert "| maze | random pairs | dqn | 1 | 0.500 | 0.700 | -0.200 |" in " ".join(table.split())
    arena = dataclasses.replace(ARENAS["quick"], primary=("maze",))
    decided = decision(scores, arena)
    assert decided is not None
    assert decided["difference"] == pytest.approx(0.05)
    assert decided["verdict"] == "undecided"
    assert decision({"sqn": scores["sqn"]}, arena) is None
    others = [entry for entry in results if entry["difference"] is not None]
    figure = figures.paired_differences(others, title="differences")
    panel = figure.axes[0]
    assert panel.get_title() == "maze, random pairs"
    assert [text.get_text() for text in panel.get_yticklabels()] == ["dqn (1)", "r2d2 (2)"]
    drawn = [line.get_xdata()[0] for line in panel.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(drawn, [-0.2, -0.05], atol=1e-9)


def test_maps_that_decide_are_also_judged_together() -> None:
    scores = {
        "sqn": rows({10: 0.7, 11: 0.5}, "maze:100") + rows({10: 0.1, 11: 0.3}, "cave:100"),
        "equal": rows({10: 0.6, 11: 0.5}, "maze:100") + rows({10: 0.4, 11: 0.3}, "cave:100"),
    }
    first, second, *others = arm_results(scores, reference="sqn", primary=("maze:100", "cave:100"))
    assert [entry["maps"] for entry in (first, second)] == ["maps that decide"] * 2
    assert first["spl"]["mean"] == pytest.approx(0.4)
    # Seed 10 has 0.5 and 0.4 on both maps, seed 11 has 0.4 with both arms.
    assert second["difference"] == pytest.approx(0.05)
    assert [entry["maps"] for entry in others] == ["mazes unseen"] * 2 + ["caves unseen"] * 2
    alone = arm_results(scores, reference="sqn", primary=("maze:100",))
    assert "maps that decide" not in {entry["maps"] for entry in alone}
    maps = {"maze": 0.9, "maze:100": 0.7, "maze:101": 0.1}
    mazes = {"sqn": [row for name, spl in maps.items() for row in rows({10: spl}, name)]}
    entry, last = arm_results(mazes, reference="sqn", primary=("maze:100", "maze:101"))
    assert (entry["maps"], entry["spl"]["mean"]) == ("mazes unseen", pytest.approx(0.4))
    assert last["maps"] == "maze"
    turned = arm_results(mazes, reference="sqn", primary=("maze:101", "maze:100"))
    assert turned == [entry, last]


def smoke_results(arm: str, spl: dict[int, float]) -> list[ablations.Result]:
    return [
        ablations.Result(
            run,
            [
                row
                for tasks in ("evaluation points", "random pairs")
                for row in rows({run.config.seed: spl[run.config.seed]}, tasks=tasks)
            ],
            [{"episodes": 64, "mean_reward": 0.1, "success": 0.2}],
        )
        for run in planned_runs(ARENAS["smoke"], [arm], list(spl))
    ]


def test_runs_on_record_are_taken_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = smoke_results("sqn", {10: 0.6, 11: 0.7}) + smoke_results("r2d2", {10: 0.5, 11: 0.4})
    ablations.write_results("smoke", recorded, tmp_path)
    record, out = tmp_path / "ablations.json", tmp_path / "out"
    planned = planned_runs(ARENAS["smoke"])
    found = ablations.earlier_results(record, "smoke", planned)
    assert found == {result.run.name: result for result in recorded}

    # Only the third arm is trained, and it is compared with those of the record.
    made = {result.run.name: result for result in smoke_results("equal", {10: 0.1, 11: 0.3})}
    monkeypatch.setattr(
        ablations, "train_within", lambda runs, *rest: iter([made.pop(run.name) for run in runs])
    )
    arguments = ["ablations", "--arena", "smoke", "--earlier", str(record), "--out", str(out)]
    monkeypatch.setattr("sys.argv", arguments)
    ablations.main()
    assert not made
    page = " ".join(capsys.readouterr().out.split())
    assert "| equal | 2 | 0.200 " in page
    assert "| -0.450 [-1.085, +0.185] |" in page  # 0.5 and 0.4: 0.45, and 12.706 x 0.05.
    assert "sqn minus r2d2, 2 seeds of both: SPL +0.200 " in page


@pytest.mark.parametrize(
    ("place", "value", "fault"),
    [
        (("arena",), "quick", "expected an ablations.json of the arena smoke$"),
        (("scores",), None, "not a whole ablations.json"),
        (("scores", "sqn"), [], "sqn_seed10 has scores of other maps or tasks"),
        (("settings", "sqn_seed10", "seed"), 7, "sqn_seed10 has other settings than it has"),
        (("settings", "sqn_seed10", "num_robots"), 7, "num_robots is 7, expected one of"),
        (("settings", "sqn_seed10"), "x", "ablations.json: sqn_seed10: config is 'x'"),
        (("schema",), 2, "schema is 2, expected 1"),
        (("scores", "sqn", 0, "spl"), None, "sqn_seed10 has scores that are none"),
        (("scores", "sqn", 0, "spl"), "0.5", "sqn_seed10 has scores that are none"),
        (("scores", "sqn", 0, "success"), 7.5, "sqn_seed10 has scores out of range"),
        (("scores", "sqn", 0, "time_steps"), -1, "sqn_seed10 has scores out of range"),
        (("curves", "sqn_seed10"), 5, "sqn_seed10 has a curve that is none"),
        (("curves", "sqn_seed10", 0), {"episodes": "64"}, "sqn_seed10 has a curve that is none"),
        (("curves", "sqn_seed10", 0), {}, "sqn_seed10 has a curve that is none"),
    ],
)
def test_records_of_something_else_are_refused(
    tmp_path: Path, place: tuple[Any, ...], value: Any, fault: str
) -> None:
    ablations.write_results("smoke", smoke_results("sqn", {10: 0.6}), tmp_path)
    path = tmp_path / "ablations.json"
    record = json.loads(path.read_text())
    inner: Any = record
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = value
    path.write_text(json.dumps(record))
    with pytest.raises(ValueError, match=fault):
        ablations.earlier_results(path, "smoke", planned_runs(ARENAS["smoke"]))


@pytest.mark.parametrize("kept", [None, 5, [], [{"seed": 10}], "half"])
def test_scores_on_file_that_are_not_whole_are_refused(tmp_path: Path, kept: Any) -> None:
    (result,) = smoke_results("sqn", {10: 0.6})
    arena, path = ARENAS["smoke"], tmp_path / "scores.json"
    settings = dataclasses.asdict(ablations.evaluation_settings(arena))
    asked = {"run": configs.to_public_dict(result.run.config), **settings}
    found = {"evaluation": {**asked, "epsilons": arena.epsilons}, "scores": result.scores}
    path.write_text(json.dumps(found))
    assert ablations.scores_of(result.run, tmp_path, arena, path) == result.scores
    found["scores"] = result.scores[:1] if kept == "half" else kept
    path.write_text(json.dumps(found))
    with pytest.raises(ValueError, match=r"scores.json has scores (of other|that are none)"):
        ablations.scores_of(result.run, tmp_path, arena, path)


def test_the_page_is_not_written_through_a_link(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("as it was")
    (tmp_path / "ablations.md").symlink_to(precious)
    ablations.write_results("smoke", smoke_results("sqn", {10: 0.6}), tmp_path)
    assert precious.read_text() == "as it was"
    assert "# Arena smoke" in (tmp_path / "ablations.md").read_text()


@pytest.mark.parametrize("minutes", ["nan", "-1"])
def test_a_budget_is_0_or_more(
    minutes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = str(tmp_path)
    monkeypatch.setattr(ablations, "train_within", lambda *arguments: iter(()))
    monkeypatch.setattr("sys.argv", ["ablations", f"--budget-minutes={minutes}", "--out", out])
    with pytest.raises(ValueError, match=f"--budget-minutes is {minutes}, expected 0 or more"):
        ablations.main()


def test_the_records_of_the_project_can_be_added_to() -> None:
    for name, of in (("quick", "quick"), ("caves", "caves"), ("wide", "quick")):
        planned = planned_runs(ARENAS[name], ["sqn", "r2d2"])
        found = ablations.earlier_results(RESULTS / f"ensemble_{of}.json", name, planned)
        assert list(found) == [run.name for run in planned]
    with pytest.raises(ValueError, match=r"expected an ablations.json of the arena quick or wide$"):
        ablations.earlier_results(RESULTS / "ensemble_caves.json", "wide", planned)


def test_a_follow_up_says_what_it_decides_and_what_it_describes(tmp_path: Path) -> None:
    spl = {"sqn": 0.50, "r2d2_wide": 0.55, "r2d2": 0.535}
    results = []
    for run in planned_runs(ARENAS["wide"]):
        seed, scores = run.config.seed, []
        for name in ("maze", "maze:100", "maze:101", "maze:102"):
            for tasks in ("random pairs", "evaluation points"):
                # Everywhere else SQN is ahead, which decides nothing.
                is_decisive = tasks == "random pairs" and name != "maze"
                value = spl[run.arm] if is_decisive else 0.9 * (run.arm == "sqn")
                scores += rows({seed: value + 0.001 * seed}, name, tasks)
        results.append(ablations.Result(run, scores, []))
    *_, decided, _, described = ablations.write_results("wide", results, tmp_path).splitlines()
    # All six differences are alike: of 64 ways of exchanging two have as large a sum.
    assert decided == (
        "r2d2_wide minus sqn, 6 seeds of both: SPL +0.050 [+0.050, +0.050], p 0.031: yes"
    )
    assert described == (
        "r2d2_wide minus r2d2, 6 seeds of both: SPL +0.015 [+0.015, +0.015], p 0.031"
    )
    record = json.loads((tmp_path / "ablations.json").read_text())
    assert (record["decision"]["verdict"], record["decision"]["seeds"][0]) == ("yes", 13)
    assert [found["arms"] for found in record["described"]] == [["r2d2_wide", "r2d2"]]
    assert "verdict" not in record["described"][0]


def test_the_power_is_that_of_tables_and_of_simulated_seeds() -> None:
    # Cohen 1988: a paired t-test at 5 % with n = 10 and d = 1 has a power of 0.80.
    assert power(0.03, 0.03, 10) == pytest.approx(0.803, abs=0.002)
    assert power(0.0, 0.03, 10) == pytest.approx(0.05)
    simulated = np.random.default_rng(0).normal(0.02, 0.02, (20_000, 6))
    rate = (stats.ttest_1samp(simulated, 0, axis=1).pvalue < 0.05).mean()
    assert power(0.02, 0.02, 6) == pytest.approx(rate, abs=0.01)


def test_runs_trained_alike_are_paired() -> None:
    same = {"file": "a", "episodes": 9, "advantage_learning": 0.0}
    runs = [
        {**same, "algo": "sqn", "seed": 0, "spl": 0.7},
        {**same, "algo": "r2d2", "seed": 0, "spl": 0.6},
        {**same, "algo": "dqn", "seed": 0, "spl": 0.1},
        {**same, "algo": "sqn", "seed": 1, "spl": 0.9},
        {**same, "algo": "r2d2", "seed": 1, "spl": 0.8, "episodes": 5},
    ]
    assert paired_differences(runs) == pytest.approx([0.1])
    on_record = paired_differences(runs_on_record())
    assert len(on_record) == 6  # Five seeds of an earlier `quick`, and one of today's.
    assert min(on_record) > 0
