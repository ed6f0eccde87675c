"""Intervals against textbook numbers and SciPy's own bootstrap."""

from __future__ import annotations

import itertools
import math
import tracemalloc

import numpy as np
import pytest
from scipy import stats

from sqn_jax.evaluation import statistics
from sqn_jax.evaluation.statistics import (
    bootstrap_interval,
    interquartile_mean,
    probability_of_improvement,
    sample_std,
    seed_interval,
    stratified_bootstrap,
    success_weighted_path_length,
    wilson_interval,
)


@pytest.mark.parametrize(("successes", "trials"), [(0, 20), (19, 20), (20, 20), (81, 263)])
def test_the_wilson_interval_solves_its_quadratic(successes: int, trials: int) -> None:
    z = 1.959963984540054
    rate = successes / trials
    centre = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    inner = rate * (1 - rate) / trials + z * z / (4 * trials * trials)
    half = z * math.sqrt(inner) / (1 + z * z / trials)
    low, high = wilson_interval(successes, trials)
    assert low == pytest.approx(centre - half, abs=1e-9)
    assert high == pytest.approx(centre + half, abs=1e-9)


def test_the_standard_deviation_is_that_of_a_sample() -> None:
    """1, 2 and 6: mean 3, squares 4 + 1 + 9, divided by two."""
    assert sample_std([1, 2, 6]) == pytest.approx(math.sqrt(14 / 2))
    assert sample_std([3.0]) is None
    assert sample_std([]) is None


def test_the_bootstrap_interval_is_near_that_of_scipy() -> None:
    values = np.random.default_rng(3).gamma(2.0, 50.0, size=200)
    theirs = stats.bootstrap((values,), np.mean, method="percentile", rng=7).confidence_interval
    low, high = bootstrap_interval(values)
    assert low == pytest.approx(theirs.low, rel=0.02)
    assert high == pytest.approx(theirs.high, rel=0.02)


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99])
@pytest.mark.parametrize("seeds", [2, 3, 6, 10, 40])
def test_the_interval_over_seeds_is_student_s(seeds: int, confidence: float) -> None:
    values = np.random.default_rng(seeds).normal(0.7, 0.2, seeds)
    theirs = stats.ttest_1samp(values, 0).confidence_interval(confidence)
    assert seed_interval(values, confidence) == pytest.approx((theirs.low, theirs.high))


def test_equal_seeds_have_an_interval_of_no_width() -> None:
    assert seed_interval([0.25] * 4) == (0.25, 0.25)


def test_one_seed_has_no_interval() -> None:
    assert seed_interval([0.7]) is None


def test_one_value_has_an_interval_of_no_width() -> None:
    assert bootstrap_interval([3.5]) == (3.5, 3.5)


def test_nothing_has_no_interval() -> None:
    with pytest.raises(ValueError, match="at least one value"):
        bootstrap_interval([])
    with pytest.raises(ValueError, match="at least one trial"):
        wilson_interval(0, 0)


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (1, 1), (0, 7), (3, 40), (500, 500)])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99])
def test_the_wilson_interval_is_scipy_s(successes: int, trials: int, confidence: float) -> None:
    theirs = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    assert wilson_interval(successes, trials, confidence) == pytest.approx(tuple(theirs), abs=1e-12)


def test_the_interquartile_mean_is_scipy_s_trimmed_mean() -> None:
    rng = np.random.default_rng(3)
    for count in (1, 3, 4, 5, 6, 7, 101):
        scores = rng.random((count, 2))
        assert interquartile_mean(scores) == pytest.approx(stats.trim_mean(scores.ravel(), 0.25))


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    assert interquartile_mean([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -90.0]) == pytest.approx(3.5)
    # Five values: one and a quarter rounds down to one at each end.
    assert interquartile_mean([9.0, 0.0, 1.0, 2.0, 3.0]) == pytest.approx(2.0)
    assert interquartile_mean([0.4, 0.8]) == pytest.approx(0.6)


def test_the_probability_of_improvement_counts_pairs_and_halves_ties() -> None:
    rng = np.random.default_rng(5)
    ours, theirs = rng.integers(0, 4, (6, 2)), rng.integers(0, 4, (4, 2))
    count = 0.0
    for task in range(2):
        for one in ours[:, task]:
            for other in theirs[:, task]:
                count += 1.0 if one > other else 0.5 if one == other else 0.0
    assert probability_of_improvement(ours, theirs) == pytest.approx(count / (2 * 6 * 4))
    # One task: Mann and Whitney's U over the number of pairs.
    u = stats.mannwhitneyu(ours[:, 0], theirs[:, 0]).statistic
    assert probability_of_improvement(ours[:, 0], theirs[:, 0]) == pytest.approx(u / 24)


@pytest.mark.parametrize("block", [1, 250, 2**20])
@pytest.mark.parametrize("size", [2, 101])
def test_the_bootstrap_draws_the_same_in_blocks_of_any_size(
    monkeypatch: pytest.MonkeyPatch, block: int, size: int
) -> None:
    values = np.random.default_rng(size).normal(size=size)
    drawn = np.random.default_rng(0).integers(size, size=(500, size))
    expected = np.quantile(values[drawn].mean(axis=1), [0.025, 0.975])
    monkeypatch.setattr("sqn_jax.evaluation.statistics.BLOCK", block)
    assert bootstrap_interval(values, resamples=500) == tuple(expected)


def test_the_bootstrap_of_many_values_takes_little_memory() -> None:
    values = np.arange(300_000.0)
    tracemalloc.start()
    try:
        bootstrap_interval(values, resamples=20)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 60e6  # All resamples at once would take 96 MB.


def test_the_stratified_bootstrap_of_a_mean_is_near_that_of_scipy() -> None:
    values = np.random.default_rng(6).normal(10.0, 3.0, size=30)
    theirs = stats.bootstrap((values,), np.mean, method="percentile", rng=8).confidence_interval
    low, high = stratified_bootstrap([values], lambda x: float(x.mean()))
    assert low == pytest.approx(theirs.low, rel=0.02)
    assert high == pytest.approx(theirs.high, rel=0.02)


def test_the_bootstrap_draws_runs_within_each_task() -> None:
    # Were values drawn across tasks, the mean of the first column would not stay 0.
    scores = np.stack([np.zeros(5), np.arange(5.0)], axis=1)
    low, high = stratified_bootstrap([scores], lambda x: float(x[:, 0].mean()))
    assert (low, high) == (0.0, 0.0)
    low, high = stratified_bootstrap([scores], lambda x: float(x[:, 1].mean()))
    assert low < 2.0 < high


def test_spl_by_hand() -> None:
    spl = success_weighted_path_length(
        [True, True, False, True, True], [10.0, 4.0, 5.0, 20.0, 0.0], [5.0, 5.0, 5.0, 20.0, 0.0]
    )
    np.testing.assert_allclose(spl, [0.5, 1.0, 0.0, 1.0, 1.0])


def test_the_worst_tenth_is_the_mean_of_the_lowest_scores() -> None:
    scores = np.array([0.9, 0.2, 1.0, 0.4, 0.8, 0.7, 0.6, 0.5, 0.3, 0.1] * 2)
    assert statistics.worst_mean(scores, 0.1) == pytest.approx(0.1)  # The two of 0.1.
    assert statistics.worst_mean(scores, 0.2) == pytest.approx(0.15)
    assert statistics.worst_mean([0.5, 0.25, 1.0], 0.1) == 0.25  # One at least.


def test_bad_luck_is_among_the_worst_unless_other_tries_judge() -> None:
    """Two maps with success 0.5: the mean over all that one try, or two, can come to."""
    one_try = list(itertools.product((0, 1), repeat=2))
    assert np.mean([statistics.worst_mean(tries, 0.5) for tries in one_try]) == 0.25
    assert np.mean(
        [
            statistics.split_worst_mean(first, second, 0.5)
            for first, second in itertools.product(one_try, repeat=2)
        ]
    ) == pytest.approx(0.5)
    # Ranked by the first half it is the second map, by the other the third.
    assert statistics.split_worst_mean([0.9, 0.1, 0.5], [0.8, 0.6, 0.2], 0.1) == (0.6 + 0.5) / 2


def test_an_interval_over_tasks_is_that_of_their_mean() -> None:
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(1, 400))
    low, high = statistics.clustered_interval(scores)
    half = 1.96 * scores.std(ddof=1) / np.sqrt(400)
    assert (low, high) == pytest.approx((scores.mean() - half, scores.mean() + half), abs=0.02)


def test_an_interval_covers_the_spread_of_tasks_and_of_training_seeds() -> None:
    """By a plain loop that draws seeds and tasks one by one."""
    rng = np.random.default_rng(1)
    scores = rng.normal(size=(5, 1)) + 0.3 * rng.normal(size=(5, 30))
    means = [
        np.mean([[scores[s, t] for t in tasks] for s in rng.integers(5, size=5)])
        for tasks in rng.integers(30, size=(4000, 30))
    ]
    expected = np.quantile(means, [0.025, 0.975])
    assert statistics.clustered_interval(scores, resamples=8000) == pytest.approx(
        expected, abs=0.06
    )
    low, high = statistics.clustered_interval(scores.mean(axis=0, keepdims=True))
    assert high - low < 0.4 * (expected[1] - expected[0])  # Without the seeds' own spread.


def test_clusters_are_drawn_as_a_whole_and_tasks_within_them() -> None:
    """By a plain loop: seeds, then clusters, then as many tasks of each as it has."""
    rng = np.random.default_rng(4)
    clusters = np.array([7, 7, 7, 7, 2, 2, 9, 9, 9, 2, 5, 5])
    scores = rng.normal(size=12)[None] + 2.0 * (clusters == 9) + rng.normal(size=(3, 1))
    scores[1, 4] = scores[2, 9] = np.nan
    means = []
    for _ in range(6000):
        drawn = rng.choice(np.unique(clusters), 4)
        tasks = np.concatenate(
            [rng.choice(np.flatnonzero(clusters == one), (clusters == one).sum()) for one in drawn]
        )
        means.append(np.nanmean(scores[rng.integers(3, size=3)][:, tasks]))
    expected = np.quantile(means, [0.025, 0.975])
    found = statistics.clustered_interval(scores, resamples=6000, clusters=clusters)
    assert found == pytest.approx(expected, abs=0.08)
    together = np.ptp(statistics.clustered_interval(scores[:1], clusters=clusters))
    assert np.ptp(statistics.clustered_interval(scores[:1])) < 0.8 * together


def test_many_tasks_are_drawn_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = np.random.default_rng(5).normal(size=(1, 50))
    half = 1.96 * scores.std() / np.sqrt(50)
    for block in (60, 50 * 700):
        monkeypatch.setattr("sqn_jax.evaluation.statistics._DRAWS_AT_ONCE", block)
        statistics._draws_of_tasks.cache_clear()
        found = statistics.clustered_interval(scores, resamples=2000)
        assert found == pytest.approx((scores.mean() - half, scores.mean() + half), abs=0.04)
    assert np.isnan(statistics.clustered_interval([[1.0, np.nan, 3.0]])).sum() == 0
    with pytest.raises(ValueError, match="at least one score"):
        statistics.clustered_interval([[np.nan]])


def test_an_interval_of_nothing_but_successes_is_wilson_s_over_tasks() -> None:
    expected = statistics.wilson_interval(12, 12)
    assert statistics.clustered_interval(np.ones((3, 12)), is_rate=True) == pytest.approx(expected)
    assert statistics.clustered_interval(np.zeros((1, 12)), is_rate=True)[0] == pytest.approx(0)


def test_two_agents_are_compared_task_by_task() -> None:
    """The p-value by all ways to exchange the two in eight tasks."""
    rng = np.random.default_rng(2)
    first, second = rng.uniform(size=8) + 0.2, rng.uniform(size=8)
    found = statistics.paired_comparison(first, second)
    differences = first - second
    signs = np.array(list(itertools.product((1, -1), repeat=8)))
    all_means = (signs * differences).mean(axis=1)
    observed = differences.mean()
    p_value = 2 * min(
        (all_means >= observed - 1e-12).mean(), (all_means <= observed + 1e-12).mean()
    )
    assert found["difference"] == pytest.approx(observed)
    assert found["p_value"] == pytest.approx(min(1.0, p_value))
    low, high = found["ci95"]
    assert low < observed < high
    assert statistics.paired_comparison([0.5], [0.2])["p_value"] is None
