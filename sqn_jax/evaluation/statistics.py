"""Scores and confidence intervals of an evaluation. NumPy and SciPy, on the host.

`scipy.stats` takes half a second to import and is not needed in training, so the functions that use
it import it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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
    from scipy import stats

    interval = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


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
    from scipy import stats

    return float(stats.trim_mean(np.asarray(scores, np.float64).reshape(-1), 0.25))


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
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean that resamples training seeds and tasks.

    Both are drawn with replacement, each as a whole, so that episodes of one task or of one policy
    do not count as independent evidence.

    Args:
        scores: [S, M] means of S training seeds on M tasks.
        confidence: of the interval.
        resamples: the number of resamples.
        seed: of the random draws.
        is_rate: whether the scores are rates of success. Where all are 0, or all 1, resampling
            shows no spread; the interval is then Wilson's for M tasks.

    Raises:
        ValueError: no scores.
    """
    array = np.asarray(scores, np.float64)
    if array.size == 0:
        raise ValueError("an interval needs at least one score")
    if is_rate and (array == array.flat[0]).all() and array.flat[0] in (0.0, 1.0):
        num_tasks = array.shape[1]
        return wilson_interval(round(array.flat[0] * num_tasks), num_tasks, confidence)
    rng = np.random.default_rng(seed)
    num_seeds, num_tasks = array.shape
    # How often each seed and each task is drawn: as good as drawing them, in two products.
    of_seeds = rng.multinomial(num_seeds, np.full(num_seeds, 1 / num_seeds), size=resamples)
    means = np.empty(resamples)
    at_once = max(1, _DRAWS_AT_ONCE // num_tasks)
    for first in range(0, resamples, at_once):
        chosen = of_seeds[first : first + at_once]
        of_tasks = rng.multinomial(num_tasks, np.full(num_tasks, 1 / num_tasks), size=len(chosen))
        means[first : first + at_once] = ((chosen @ array) * of_tasks).sum(axis=1)
    means /= num_seeds * num_tasks
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


_DRAWS_AT_ONCE = 2**20
"""Draws of tasks that are held in memory."""


def worst_mean(scores: ArrayLike, fraction: float) -> float:
    """Mean of the lowest `fraction` of the scores [M], at least one: CVaR of the scores.

    Scores that are means of few episodes are noisy, and the lowest are lower than they would be in
    the long run.
    """
    ordered = np.sort(np.asarray(scores, np.float64))
    count = max(1, math.ceil(fraction * len(ordered) - 1e-9))
    return float(ordered[:count].mean())


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
