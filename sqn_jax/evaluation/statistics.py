"""Scores and confidence intervals of an evaluation. NumPy and SciPy, on the host.

`scipy.stats` takes half a second to import and is not needed in training, so the functions that use
it import it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
