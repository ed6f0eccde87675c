"""Intervals against textbook numbers and SciPy's own bootstrap."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from sqn_jax.statistics import bootstrap_interval, wilson_interval


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


def test_the_bootstrap_interval_is_near_that_of_scipy() -> None:
    values = np.random.default_rng(3).gamma(2.0, 50.0, size=200)
    theirs = stats.bootstrap((values,), np.mean, method="percentile", rng=7).confidence_interval
    low, high = bootstrap_interval(values)
    assert low == pytest.approx(theirs.low, rel=0.02)
    assert high == pytest.approx(theirs.high, rel=0.02)


def test_one_value_has_an_interval_of_no_width() -> None:
    assert bootstrap_interval([3.5]) == (3.5, 3.5)


def test_nothing_has_no_interval() -> None:
    with pytest.raises(ValueError, match="at least one value"):
        bootstrap_interval([])
    with pytest.raises(ValueError, match="at least one trial"):
        wilson_interval(0, 0)
