"""Statistics: exact sums, intervals of rates, means and ratios, and what is told over seeds."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.stats import bootstrap

from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.evaluation.seeds import interquartile_mean, mean_over_seeds, share_over_seeds
from ethbrake_marl.first_edition.evaluation.statistics import (
    Moments,
    exact_sum,
    mean,
    paired_difference,
    rate,
    relative_decrease,
    root,
)

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


def rounded(estimate):
    low_high = estimate.interval and tuple(round(float(end), 7) for end in estimate.interval)
    return f"{float(estimate.value):.9g} {low_high}"


def test_rate__has_the_interval_of_wilson() -> None:
    assert rounded(rate(5, 10)) == "0.5 (0.2365931, 0.7634069)"


def test_mean__has_the_interval_of_student() -> None:
    # The mean of 1 to 5, whose variance is 2.5, with Student's t of 4 degrees of freedom; of one number; of
    # differences that are all the same.
    assert rounded(mean(np.arange(1.0, 6.0))) == "3 (1.0367568, 4.9632432)"
    # t = 2.7764451, times sqrt(2.5 / 5)
    assert rounded(mean(np.array([7.0]))) == "7 None"
    assert rounded(paired_difference(np.array([-2.0, 8.0, 48.0]), np.array([0.0, 10.0, 50.0]))) == "-2 (-2.0, -2.0)"


def test_relative_decrease__by_hand() -> None:
    # A decrease: ratio 0.75; residuals -0.5 and 0.5, standard error sqrt(0.5) / (sqrt(2) * 2) = 0.25, t = 12.7062047
    # of 1 degree of freedom. Of nothing there is none.
    assert rounded(relative_decrease(np.array([1.0, 2.0]), np.array([2.0, 2.0]))) == "0.25 (-2.9265512, 3.4265512)"
    assert relative_decrease(np.array([1.0, 0.0]), np.zeros(2)) is None


def test_root__of_what_no_float_holds() -> None:
    assert root(Fraction(10**800, 10**200)) == 9.999999999999999e299
    assert root(Fraction(0, 3)) == 0.0


@pytest.mark.parametrize(
    ("tasks", "expected"),
    [
        ([[7.0]], (7.0, True, True)),
        ([[1.0, 2.0, 3.0]], (2.0, False, True)),
        ([[1.0, 2.0, 3.0, 100.0]], (2.5, False, True)),
        ([[100.0, 4.0, 6.0, 5.0, -90.0]], (5.0, False, True)),
        ([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 80.0]], (4.5, False, True)),
    ],
)
def test_interquartile_mean__leaves_out_the_ends(tasks, expected) -> None:
    # The interquartile mean: nothing is left out of three, the ends of four; of eight in two strata 3, 4, 5, 6 are
    # left; and the same again. Of one there is no interval.
    found = interquartile_mean(tasks, resamples=200, seed=3)
    assert (
        round(found.value, 12),
        found.interval is None,
        found == interquartile_mean(tasks, resamples=200, seed=3),
    ) == expected


def test_interquartile_mean__has_the_interval_of_its_draws() -> None:
    # Its interval is that of its draws: means 0, 1/2, 1 with chances 1/4, 1/2, 1/4. Strata are not mixed: from 1 to
    # 9.
    assert rounded(interquartile_mean([[0.0, 1.0]], resamples=2000)) == "0.5 (0.0, 1.0)"
    assert rounded(interquartile_mean([[1.0] * 3, [9.0] * 3], resamples=2000)) == "5 (5.0, 5.0)"


def test_mean_over_seeds__has_the_spread_of_the_seeds_alone() -> None:
    worlds = np.array([1.0, 100.0, 1.0, 100.0])
    assert rounded(mean_over_seeds(np.array([worlds - 1.0, worlds - 3.0]), worlds)) == "-2 (-3.0, -1.0)"
    assert rounded(mean_over_seeds(np.array([[1.0] * 50, [3.0] * 50]))) == "2 (1.0, 3.0)"
    assert rounded(mean_over_seeds(np.array([[1.0], [3.0]]), [[1.0]])) == "1 None"


@pytest.mark.parametrize(
    ("successes", "of", "expected"),
    [
        (np.ones((2, 20), np.bool_), 20, ("1 (0.8388748, 1.0)", "1 (0.8388748, 1.0)")),
        (np.zeros((1, 20), np.bool_), 20, ("0 (0.0, 0.1611252)", "0 (0.0, 0.1611252)")),
        (np.ones((1, 1), np.bool_), 1, ("1 (0.2065493, 1.0)", "1 (0.2065493, 1.0)")),
    ],
)
def test_rate__is_no_certainty_where_all_worlds_were_alike(successes, of, expected) -> None:
    assert (rounded(mean_over_seeds(successes)), rounded(rate(of * int(successes.all()), of))) == expected


def test_intervals__of_two_worlds_exist() -> None:
    assert rounded(share_over_seeds([[4.0, 6.0]], [10.0, 10.0], [0.0, 0.0])) == "0.5 (0.4, 0.6)"
    assert rounded(mean_over_seeds([[4.0, 6.0]], [[0.0, 0.0]])) == "5 (4.0, 6.0)"
    assert rounded(mean_over_seeds([[4.0, 6.0]])) == "5 (4.0, 6.0)"


def test_exact_sum__of_many_of_the_largest_numbers() -> None:
    many = np.full(100_000, -1.7976931348623157e308)
    assert exact_sum(many) == 100_000 * exact_sum(many[:1])
    assert exact_sum(many, many) == 100_000 * exact_sum(many[:1], many[:1])


def test_share_over_seeds__by_hand() -> None:
    rng = np.random.default_rng(3)
    worst, best = 10.0 + rng.normal(size=200), np.full(200, 2.0)
    seeds = np.array([[4.0], [6.0]]) + 0.1 * rng.normal(size=(2, 200))
    found = share_over_seeds(seeds, worst, best)
    assert found.value == pytest.approx((worst.mean() - seeds.mean()) / (worst.mean() - 2.0), rel=1e-12)
    assert found.interval == pytest.approx((0.5, 0.75), abs=0.02)
    assert share_over_seeds(seeds, worst, worst) is None
    assert share_over_seeds([[4.0]], [10.0], [0.0]) == Estimate(0.6, None)
    one = np.array([6.0, 0.0, 0.0])  # the only world with something to reduce: 30 % of the resamples lack it
    assert share_over_seeds([one / 2.0 + 1.0], one, [np.zeros(3) + 1e-17]) is None


def test_mean_over_seeds__of_truths_is_a_rate_and_against_a_baseline_a_difference() -> None:
    low, high = mean_over_seeds(np.eye(4, dtype=np.bool_)[[0]].T.repeat(50, axis=1)).interval
    assert low == 0.0
    assert high > 0.7
    found = mean_over_seeds(np.array([[True, False, False, True]]), np.array([[True] * 4]))
    assert found.value == -0.5
    assert found.interval[0] < -0.5 < found.interval[1] <= 0.0


def test_difference_and_ratio__are_those_of_the_pairs() -> None:
    x, y = np.random.default_rng(4).integers(0, 50, (2, 500)).astype(float) / 8.0  # no difference of them is rounded
    both = exact_sum(x, y)
    assert Moments.of(x).minus(Moments.of(y), both) == Moments.of(x - y)
    residual = x - x.mean() / y.mean() * y
    expected = residual.std(ddof=1) / math.sqrt(500) / y.mean()
    assert Moments.of(x).ratio_error(Moments.of(y), both) == pytest.approx(expected, rel=1e-10)
