"""Scores and confidence intervals of an evaluation. NumPy and SciPy, on the host.

`scipy.stats` takes half a second to import, more than most evaluations spend here: two one-line
formulas stand for it, and what needs more imports it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

BLOCK = 2**20
"""Values that a bootstrap draws at a time; each takes 16 bytes."""


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval for a success rate; valid at 0 and at 1 too.

    Raises:
        ValueError: no trials.
    """
    if trials < 1:
        raise ValueError("an interval needs at least one trial")
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate, shrink = successes / trials, 1 + z**2 / trials
    center = (rate + z**2 / (2 * trials)) / shrink
    half = z / shrink * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    low = center - half if successes > 0 else 0.0
    return low, center + half if successes < trials else 1.0


def seed_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, float] | None:
    """Student's interval of the mean of values [n] of n training seeds; None for fewer than two.

    A percentile bootstrap of so few values is too narrow: of ten by a fifth.
    """
    array = np.asarray(values, np.float64)
    if array.size < 2:
        return None
    from scipy import special

    quantile = special.stdtrit(array.size - 1, (1 + confidence) / 2)
    half = quantile * array.std(ddof=1) / math.sqrt(array.size)
    return float(array.mean() - half), float(array.mean() + half)


def bootstrap_interval(
    values: ArrayLike, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean; the mean itself twice for a single value.

    Draws some resamples at a time, of `BLOCK` values in all, and the same ones for any `BLOCK`.

    Raises:
        ValueError: no values.
    """
    array = np.asarray(values, np.float64)
    if array.size < 1:
        raise ValueError("an interval needs at least one value")
    rng = np.random.default_rng(seed)
    rows = max(1, BLOCK // array.size)
    means = np.concatenate(
        [
            array[rng.integers(array.size, size=(min(rows, resamples - row), array.size))].mean(1)
            for row in range(0, resamples, rows)
        ]
    )
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def sample_std(values: ArrayLike) -> float | None:
    """Sample standard deviation (n - 1 in the denominator); None for fewer than two values."""
    array = np.asarray(values, np.float64)
    return float(array.std(ddof=1)) if array.size > 1 else None


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores, runs and tasks together (Agarwal et al. 2021).

    A quarter of the values, rounded down, is left out at each end. With fewer than four values it
    is the mean.
    """
    ordered = np.sort(np.asarray(scores, np.float64).reshape(-1))
    cut = ordered.size // 4
    return float(ordered[cut : ordered.size - cut].mean())


def probability_of_improvement(ours: ArrayLike, theirs: ArrayLike) -> float:
    """Probability that a run of ours beats a run of theirs; a tie counts one half.

    Args:
        ours: [K] scores of K training runs, or [K, M] on M tasks, over which it is averaged.
        theirs: [L] or [L, M].
    """
    first, second = (_runs_by_tasks(scores) for scores in (ours, theirs))
    wins = np.sign(first[:, None] - second[None])
    return float((0.5 + 0.5 * wins).mean())


def stratified_bootstrap(
    samples: Sequence[ArrayLike],
    statistic: Callable[..., float],
    confidence: float = 0.95,
    resamples: int = 1000,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile interval of a statistic over training runs (Agarwal et al. 2021).

    Runs are drawn with replacement, separately for each task and each sample.

    Args:
        samples: one or more arrays [K] or [K, M]: K runs, M tasks.
        statistic: a function of as many arrays [K, M] that returns a number.
        confidence: of the interval.
        resamples: the number of resamples.
        seed: of the random draws.
    """
    rng = np.random.default_rng(seed)
    arrays = [_runs_by_tasks(sample) for sample in samples]
    values = [
        statistic(
            *(np.take_along_axis(x, rng.integers(len(x), size=x.shape), axis=0) for x in arrays)
        )
        for _ in range(resamples)
    ]
    low, high = np.quantile(values, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def success_weighted_path_length(
    success: ArrayLike, path_length: ArrayLike, shortest: ArrayLike
) -> NDArray[np.float64]:
    """SPL of each episode (Anderson et al. 2018): success x shortest / max(length, shortest).

    Args:
        success: [E] bool.
        path_length: [E] m, length of the robot's path up to the goal.
        shortest: [E] m, length of the shortest path; where it is 0, the ratio is 1.

    Returns:
        [E] in 0..1.
    """
    length, shortest_length = np.asarray(path_length, np.float64), np.asarray(shortest, np.float64)
    longer = np.maximum(length, shortest_length)
    ratio = np.divide(shortest_length, longer, out=np.ones_like(longer), where=longer > 0)
    return np.asarray(success, bool) * ratio


def _runs_by_tasks(scores: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(scores, np.float64)
    return array[:, None] if array.ndim == 1 else array


def clustered_interval(
    scores: ArrayLike,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
    *,
    is_rate: bool = False,
    clusters: ArrayLike | None = None,
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean that resamples training seeds and tasks.

    Both are drawn with replacement, each as a whole, so that episodes of one task or of one policy
    do not count as independent evidence. With a single training seed the interval is over tasks
    only: it says nothing about another training.

    Args:
        scores: [S, M] means of S training seeds on M tasks; NaN where there is none.
        confidence: of the interval.
        resamples: the number of resamples.
        seed: of the random draws.
        is_rate: whether the scores are rates of success. Where all are 0, or all 1, resampling
            shows no spread; the interval is then Wilson's for M tasks.
        clusters: [M] numbers that are equal for tasks that are alike (those of one route): drawn
            are clusters, and within each of them tasks. By default each task is one.

    Raises:
        ValueError: no scores.
    """
    array = np.asarray(scores, np.float64)
    is_known = ~np.isnan(array)
    if not is_known.any():
        raise ValueError("an interval needs at least one score")
    num_seeds, num_tasks = array.shape
    first = array[is_known][0]
    if is_rate and first in (0.0, 1.0) and (array[is_known] == first).all():
        return wilson_interval(round(first * num_tasks), num_tasks, confidence)
    groups = np.arange(num_tasks) if clusters is None else np.asarray(clusters, np.int64)
    rng = np.random.default_rng(seed)
    # How often each seed and each task is drawn: as good as drawing them, in two products.
    of_seeds = rng.multinomial(num_seeds, np.full(num_seeds, 1 / num_seeds), size=resamples)
    totals, counts = np.empty(resamples), np.empty(resamples)
    at_once = min(resamples, max(1, _DRAWS_AT_ONCE // num_tasks))
    for number, start in enumerate(range(0, resamples, at_once)):
        chosen = of_seeds[start : start + at_once]
        of_tasks = _draws_of_tasks(groups.tobytes(), at_once, (seed, number))[: len(chosen)]
        for drawn, values in ((totals, np.where(is_known, array, 0.0)), (counts, is_known)):
            drawn[start : start + at_once] = ((chosen @ values) * of_tasks).sum(axis=1)
    means = totals[counts > 0] / counts[counts > 0]
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


_DRAWS_AT_ONCE = 2**20
"""Draws of tasks that are held in memory."""


@functools.lru_cache(maxsize=1)  # Agents and metrics are compared on the same tasks.
def _draws_of_tasks(clusters: bytes, count: int, seed: tuple[int, int]) -> NDArray[np.int64]:
    """How often each of M tasks is drawn in `count` resamples [count, M], int64 clusters [M]."""
    _, cluster_of, sizes = np.unique(
        np.frombuffer(clusters, np.int64), return_inverse=True, return_counts=True
    )
    rng = np.random.default_rng(seed)
    # Tasks in the order of their clusters, where each cluster begins.
    order, begins = np.argsort(cluster_of, kind="stable"), np.cumsum(sizes) - sizes
    drawn = rng.integers(len(sizes), size=(count, len(sizes)))
    row = np.repeat(np.arange(count), sizes[drawn].sum(axis=1))
    within = np.repeat(drawn.reshape(-1), sizes[drawn].reshape(-1))
    tasks = order[begins[within] + rng.integers(sizes[within])]
    num_tasks = len(order)
    counts = np.bincount(row * num_tasks + tasks, minlength=count * num_tasks)
    return counts.reshape(count, num_tasks)


def worst_mean(scores: ArrayLike, fraction: float) -> float:
    """Mean of the lowest `fraction` of the scores [M], at least one: CVaR of the scores.

    Scores that are means of few episodes are noisy, and the lowest are lower than they would be in
    the long run. Two maps with success 0.5 and one try each: the tries end 0 0, 0 1, 1 0 or 1 1,
    equally often, and the lower one is 0, 0, 0 or 1: on average 0.25 instead of 0.5.
    `split_worst_mean` has no such bias.
    """
    ordered = np.sort(np.asarray(scores, np.float64))
    return float(ordered[: _worst_count(fraction, len(ordered))].mean())


def split_worst_mean(first: ArrayLike, second: ArrayLike, fraction: float) -> float:
    """Mean score of the maps that other tries have shown to be the worst.

    Maps are ranked by one half of their tries and judged by the other, both ways round, so that bad
    luck that puts a map among the worst does not count against it. Unbiased for the maps so chosen.
    These need not be the truly worst ones: on average the result is no less than their mean, and
    `worst_mean` no more.

    Args:
        first: [M] mean scores in one half of the tries.
        second: [M] in the other half.
        fraction: of the maps, at least one.
    """
    halves = [np.asarray(half, np.float64) for half in (first, second)]
    count = _worst_count(fraction, len(halves[0]))
    means = [
        judged[np.argsort(ranked, kind="stable")[:count]].mean()
        for ranked, judged in (halves, halves[::-1])
    ]
    return float(np.mean(means))


def _worst_count(fraction: float, count: int) -> int:
    return max(1, math.ceil(fraction * count - 1e-9))


def paired_comparison(
    first: ArrayLike, second: ArrayLike, resamples: int = 9_999, seed: int = 0
) -> dict[str, Any]:
    """Compare two agents on the same M tasks.

    Args:
        first: [M] mean score of one agent on each task.
        second: [M] of the other.
        resamples: of the permutation test and of the bootstrap.
        seed: of the random draws.

    Returns:
        `difference`, the mean of first - second; its `ci95` over tasks (percentile bootstrap); and
        `p_value`, two-sided, of the test that exchanges the two agents task by task. With a single
        task there is no interval and no test: None.
    """
    from scipy import stats

    differences = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    result: dict[str, Any] = {"difference": float(differences.mean())}
    if len(differences) < 2:
        return {**result, "ci95": None, "p_value": None}
    zeros = np.zeros_like(differences)
    test = stats.permutation_test(
        (differences, zeros),
        lambda x, y, axis: np.mean(x - y, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=resamples,
        batch=max(1, _DRAWS_AT_ONCE // len(differences)),
        rng=np.random.default_rng(seed),
    )
    interval = clustered_interval(differences[None], seed=seed)
    return {**result, "ci95": list(interval), "p_value": float(test.pvalue)}
