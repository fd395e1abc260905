"""Statistics: exact sums, intervals of rates, means and ratios, and what is told over seeds."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.stats import bootstrap

from ethbrake_marl.evaluation import statistics
from ethbrake_marl.evaluation.statistics import (
    Moments,
    exact_sum,
    interquartile_mean,
    mean,
    mean_over_seeds,
    rate,
    relative_decrease,
)
from ethbrake_marl.files.sheet import Estimate

# ---------------------------------------------------------------- exact sums

FINITE = st.floats(allow_nan=False, allow_infinity=False)
EXTREMES = [0.0, -0.0, 5e-324, -5e-324, 2.2250738585072014e-308, 1.7976931348623157e308, -1.7976931348623157e308, 1.0]


@given(st.lists(st.tuples(FINITE, FINITE), max_size=30))
def test_sums__are_those_of_fractions(rows: list[tuple[float, float]]) -> None:
    for pairs in (rows, [(a, b) for a in EXTREMES for b in EXTREMES]):
        x, y = np.array([a for a, _ in pairs]), np.array([b for _, b in pairs])
        assert exact_sum(x) == sum(Fraction(a) for a, _ in pairs)
        assert exact_sum(x, y) == sum(Fraction(a) * Fraction(b) for a, b in pairs)


def test_moments__of_parts_in_any_order_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(3)
    values = rng.exponential(20.0, 10_000) * (rng.random(10_000) < 0.6)
    whole = Moments.of(values)
    for parts in (1, 2, 7, 100):
        pieces = [Moments.of(part) for part in np.array_split(rng.permutation(values), parts)]
        assert sum(pieces, Moments()) == whole
    assert whole.mean == float(sum(map(Fraction, values)) / 10_000)
    assert whole.standard_error == pytest.approx(values.std(ddof=1) / 100.0, rel=1e-12)
    equal = Moments.of(np.full(7, 0.1))
    assert (equal.mean, equal.standard_error) == (0.1, 0.0)


# ---------------------------------------------------------------- rates

Z_SQUARED = 3.8414588  # of the normal quantile at 97.5 %


@pytest.mark.parametrize("count", [1, 10, 10_000, 10**8])
def test_rate__none_and_all_reach_the_end_of_the_range_and_no_further(count: int) -> None:
    reach = Z_SQUARED / (count + Z_SQUARED)
    none, every = rate(0, count).interval, rate(count, count).interval
    assert none == (0.0, pytest.approx(reach, rel=1e-6)) and every == (pytest.approx(1.0 - reach, rel=1e-8), 1.0)


# ---------------------------------------------------------------- means, differences and ratios


RNG = np.random.default_rng(3)
BASELINE = RNG.gamma(1.0, 24.0, 4000)
HARM = np.maximum(RNG.normal(2.0, 20.0, 4000), 0.0)  # many zeros and a long tail, as harm has
SHARES = BASELINE * RNG.uniform(0.0, 1.0, 4000)


@pytest.mark.parametrize(
    ("found", "data", "statistic"),
    [
        (mean(HARM), (HARM,), lambda x, axis: x.mean(axis=axis)),
        (relative_decrease(SHARES, BASELINE), (SHARES, BASELINE), lambda x, y, axis: 1.0 - x.mean(axis) / y.mean(axis)),
    ],
    ids=["mean", "paired ratio"],
)
def test_estimate__at_the_size_of_our_lists_has_the_bootstrap_interval(found, data, statistic) -> None:
    boot = bootstrap(data, statistic, paired=len(data) > 1, n_resamples=1000, method="percentile", rng=4)
    low, high = found.interval
    assert (low, high) == pytest.approx(tuple(boot.confidence_interval), abs=0.06 * (high - low))


@pytest.mark.parametrize("parts", [1, 4])
def test_mean__of_rare_harm_does_not_reach_below_zero(parts: int) -> None:
    rare = np.zeros(400)
    rare[7] = 30.0
    moments = sum(map(Moments.of, np.array_split(rare, parts)), Moments())
    for found in (moments.estimate, mean(rare)):
        assert found.interval[0] == 0.0 < found.value < found.interval[1]
    assert mean(rare - 1.0).interval[0] < -1.0  # these may be negative
    assert moments.minus(Moments.of(np.zeros(400)), 0).estimate.interval[0] < 0.0  # and so may a difference


def test_mean__of_nothing_but_zeros_has_no_interval() -> None:
    """Where 0.045 % of the worlds collide, 2,000 without a collision are usual, and say nothing of the harm."""
    nothing = Moments.of(np.zeros(2_000))
    assert nothing.estimate == mean(np.zeros(2_000)) == Estimate(0.0, None)
    assert nothing.minus(nothing, 0).estimate == Estimate(0.0, (0.0, 0.0))  # twice the same: that is certain
    assert mean(np.full(9, 2.5)).interval == (2.5, 2.5)


# ---------------------------------------------------------------- over seeds


def test_mean_over_seeds__of_nothing_but_zeros_has_no_interval() -> None:
    assert mean_over_seeds(np.zeros((3, 500))) == Estimate(0.0, None)
    assert mean_over_seeds(np.zeros((3, 500)), np.zeros((3, 500))).interval == (0.0, 0.0)


def test_interquartile_mean__covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    intervals = [interquartile_mean([rng.normal(size=12)], resamples=300, seed=k).interval for k in range(200)]
    hits = sum(low <= 0.0 <= high for low, high in intervals)
    assert 0.84 <= hits / 200 <= 0.99  # the percentile bootstrap is a little short with twelve


def test_mean_over_seeds__worlds_of_both_sides_are_drawn_together() -> None:
    rng = np.random.default_rng(2)
    worlds, difference = rng.uniform(0.0, 100.0, 500), rng.normal(0.5, 1.0, 500)
    half = 1.96 * difference.std(ddof=1) / 500**0.5
    expected = (difference.mean() - half, difference.mean() + half)
    assert mean_over_seeds(worlds + difference, worlds).interval == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("resamples", [1, 2, 3])
def test_resamples__are_as_many_as_asked_for(resamples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "_AT_ONCE", 4)  # two at a time
    assert statistics._resample_means((np.arange(4.0).reshape(2, 2),), resamples, 0).shape == (resamples, 1)
