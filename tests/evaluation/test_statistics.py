"""Means, rates and comparisons: by hand, against programs written otherwise, and how often they cover the truth."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats

from ethbrake_marl.evaluation.statistics import decrease, difference, mean, rate, unpaired_difference, wilson, worst
from ethbrake_marl.files.sheet import Estimate

T_2 = 4.302652729911275  # quantile of Student's t with 2 degrees of freedom at 97.5 %


def test_mean_by_hand() -> None:
    # 1, 2, 6: mean 3, s = sqrt(7), error sqrt(7 / 3)
    found = mean(np.array([1.0, 2.0, 6.0]) - 3.0)
    half = T_2 * math.sqrt(7 / 3)
    assert (found.value, found.freedom) == (0.0, 2.0) and found.error == pytest.approx(math.sqrt(7 / 3))
    assert found.interval == pytest.approx((-half, half))


def test_mean_of_amounts__does_not_go_below_zero_and_of_zeros_is_not_known() -> None:
    rare = np.zeros(400)
    rare[7] = 30.0
    found = mean(rare)
    assert found.interval is not None and found.interval[0] == 0.0 < found.value < found.interval[1]
    assert found.error == pytest.approx(rare.std(ddof=1) / 20.0)  # kept as it is
    assert mean(np.zeros(9)).interval is None
    assert difference(np.zeros(9), np.zeros(9)).interval == (0.0, 0.0)
    assert mean(np.array([2.0])) == Estimate(2.0, None)


def test_worst_by_hand() -> None:
    # of 1 ... 100 the largest 5 % are 96 to 100; over the quantile 95: 95 + 1 / 0.05 = 115, ..., 195, and 95 x 95
    found = worst(np.arange(100.0, 0.0, -1.0))
    by_hand = mean(np.array([95.0] * 95 + [115.0, 135.0, 155.0, 175.0, 195.0]))
    assert found.value == 98.0 == pytest.approx(by_hand.value) and found.interval == pytest.approx(by_hand.interval)
    few = worst(np.arange(40.0, 0.0, -1.0))  # 39 and 40; too few values for an interval
    assert few.value == pytest.approx(39.5) and few.interval is None
    assert worst(np.array([3.0, 9.0])) == Estimate(9.0, None)
    assert worst(np.full(200, 9.0)) == Estimate(9.0, None)  # enough values, but none above the quantile


def test_worst__covers_the_truth() -> None:
    # of the exponential distribution: 1 + ln(1 / 5 %)
    rng = np.random.default_rng(0)
    ends = [worst(rng.exponential(size=2000)).ends for _ in range(1000)]
    assert 0.93 < np.mean([low <= 1.0 + math.log(20.0) <= high for low, high in ends]) < 0.97


def test_worst__by_recording_is_the_mean_of_the_worst_worlds_with_a_longer_interval() -> None:
    rng = np.random.default_rng(1)
    recordings = np.repeat(np.arange(20), 50)
    values = rng.exponential(size=20)[recordings] * rng.exponential(size=1000)
    alone, alike = worst(values), worst(values, recordings)
    assert alone.value == pytest.approx(np.sort(values)[-50:].mean()) == pytest.approx(alike.value)
    assert alone.interval and alike.interval and alike.interval[1] - alike.interval[0] > np.ptp(alone.interval)


def test_decrease_by_hand() -> None:
    # r = 12 / 24; residuals x - y / 2 are 0 2 0 -2 -1 1
    x, y = np.array([1.0, 3.0, 2.0, 0.0, 1.0, 5.0]), np.array([2.0, 2.0, 4.0, 4.0, 4.0, 8.0])
    found = decrease(x, y)
    assert found is not None and found.value == 0.5 and found.error == pytest.approx(math.sqrt(6 / 5 * 10) / 24)
    assert decrease(x, np.zeros(6)) is None


def test_rate__none_and_all_reach_the_end_of_the_range_and_no_further() -> None:
    none, every = rate(np.zeros(10, np.bool_)), rate(np.ones(10, np.bool_))
    reach = 3.8414588 / (10 + 3.8414588)
    assert none.interval == (0.0, pytest.approx(reach, rel=1e-6))
    assert every.interval == (pytest.approx(1.0 - reach, rel=1e-6), 1.0)


def test_sums__do_not_depend_on_the_order() -> None:
    rng = np.random.default_rng(3)
    values = np.concatenate([rng.exponential(20.0, 999), [1e16, 1.0, -1e16]])
    shuffled = rng.permutation(values)
    assert mean(values) == mean(shuffled) and mean(values).value != values.mean()


# ---- recordings


def by_leaving_out(x: np.ndarray, y: np.ndarray, names: np.ndarray) -> float:
    """The jackknife's error of sum x / sum y, one recording after the other left out."""
    groups = np.unique(names)
    without = [x[names != name].sum() / y[names != name].sum() for name in groups]
    return math.sqrt((len(groups) - 1) / len(groups) * sum((r - x.sum() / y.sum()) ** 2 for r in without))


def by_matrix(share: np.ndarray) -> float:
    """Satterthwaite's degrees of freedom from the covariance matrix of the jackknife's changes."""
    scale = 1.0 / (1.0 - share)
    root = scale[:, np.newaxis] * (np.eye(len(share)) - share[:, np.newaxis]) * share
    covariance = root @ root.T
    return float(np.trace(covariance) ** 2 / (covariance * covariance).sum())


@given(st.integers(2, 9), st.integers(0, 10**6))
def test_error_and_freedom__by_recording_are_the_jackknifes(groups: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = np.concatenate([np.repeat(f"{k}", rng.integers(1, 9)) for k in range(groups)])
    x, y = rng.exponential(3.0, (2, len(names)))
    of_mean, of_ratio = mean(x, names), decrease(x, y, names)
    sizes = np.array([(names == f"{k}").sum() for k in range(groups)]) / len(names)
    weights = np.array([y[names == f"{k}"].sum() for k in range(groups)]) / y.sum()
    assert of_mean.error == pytest.approx(by_leaving_out(x, np.ones(len(x)), names), rel=1e-9)
    assert of_mean.freedom == pytest.approx(by_matrix(sizes), rel=1e-6)
    assert of_ratio is not None and of_ratio.error == pytest.approx(by_leaving_out(x, y, names), rel=1e-9)
    assert of_ratio.freedom == pytest.approx(by_matrix(weights), rel=1e-6)
    assert of_mean.freedom is not None and of_mean.freedom < groups - 1 + 1e-6


def test_interval__of_equal_recordings_is_students_and_longer_on_the_side_of_a_tail() -> None:
    names = np.repeat([f"{k}" for k in range(9)], 4)
    even = mean(np.repeat(np.arange(-4.0, 5.0), 4), names)
    assert even.freedom == pytest.approx(8.0) and even.error is not None and even.interval is not None
    assert even.interval[1] == pytest.approx(stats.t.ppf(0.975, 8) * even.error)
    assert even.error == pytest.approx(stats.sem(np.arange(-4.0, 5.0)))
    tail = difference(np.repeat([0.0] * 8 + [9.0], 4), np.zeros(36), names)
    assert tail.interval is not None
    below, above = tail.value - tail.interval[0], tail.interval[1] - tail.value
    assert above > 2.0 * below and below == pytest.approx(stats.t.ppf(0.975, 8) * (tail.error or 0.0))


def test_interval__of_one_recording_or_of_one_with_all_the_harm_is_not_known() -> None:
    x, one = np.array([1.0, 2.0, 3.0]), np.array(["a"] * 3)
    assert mean(x, one).interval is None and rate(x > 1.0, one).interval is None
    assert difference(x, x[::-1], one).interval is None
    found = decrease(x, np.array([0.0, 0.0, 5.0]), np.array(["a", "b", "c"]))
    assert found is not None and found.interval is None


def test_rate__by_recording_by_hand() -> None:
    # two of three equal recordings are hit throughout: error sqrt(3 / 2 (1/9 + 1/9 + 4/9) / 9) = 1 / 3, so 1 + 2 draws
    names = np.repeat(["a", "b", "c"], 5)
    found = rate(np.repeat([True, True, False], 5), names)
    assert found.error == pytest.approx(1 / 3)
    assert found.interval == pytest.approx(wilson(2 / 3, 3 * 3.841458820694124 / T_2**2))
    none = rate(np.zeros(15, np.bool_), names)
    assert none.interval == pytest.approx(wilson(0.0, 3 * 3.841458820694124 / T_2**2))
    uneven = rate(np.zeros(15, np.bool_), np.array(["a"] * 13 + ["b", "c"])).interval
    assert uneven is not None and none.interval is not None and uneven[1] > none.interval[1]


def test_rate__by_recording_has_at_most_as_many_draws_as_worlds() -> None:
    # the recordings are hit in 2, 2 and 3 of 5 worlds: 1 + p (1 - p) / error^2 would be 57 draws of 15 worlds
    truths = np.array([1, 1, 0, 0, 0, 1, 1, 0, 0, 0, 1, 1, 1, 0, 0], np.bool_)
    names = np.repeat(["a", "b", "c"], 5)
    share, error = 7 / 15, by_leaving_out(truths.astype(float), np.ones(15), names)
    assert 1.0 + share * (1.0 - share) / error**2 > 50.0
    assert rate(truths, names).interval == pytest.approx(wilson(share, 15 * 3.841458820694124 / T_2**2))


def drawn(rng: np.random.Generator, groups: int, spread: float, few: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Worlds of unequal recordings, of mean 1, and the same with a part saved: half of it on average.

    ``few``: harm in 6 % of the recordings, as in the recorded scenario.
    """
    sizes = np.maximum(np.round(20 * np.exp(spread * rng.normal(size=groups))), 1).astype(int)
    own = rng.exponential(1.0, groups) if not few else 10.0 * (rng.random(groups) < 0.1) + rng.uniform(0, 1e-3, groups)
    names = np.repeat(np.arange(groups).astype(str), sizes)
    harm = np.repeat(own, sizes) * rng.uniform(0.5, 1.5, len(names))
    return harm, harm * np.repeat(rng.uniform(0.2, 0.8, groups), sizes), names


@pytest.mark.parametrize(("groups", "spread", "few", "least"), [(3, 1.2, False, 0.90), (66, 0.8, True, 0.91)])
def test_interval__by_few_unequal_recordings_covers_the_truth(
    groups: int, spread: float, few: bool, least: float
) -> None:
    rng, hits, known = np.random.default_rng(9), np.zeros(3), np.zeros(3)
    for _ in range(400):
        harm, saved, names = drawn(rng, groups, spread, few)
        found = mean(harm, names), decrease(saved, harm, names), difference(saved, harm, names)
        for k, (each, truth) in enumerate(zip(found, (1.0, 0.5, -0.5), strict=True)):
            if each is not None and each.interval is not None:
                known[k] += 1
                hits[k] += each.interval[0] <= truth <= each.interval[1]
    assert (known > 360).all() and (hits / known >= least).all() and (hits / known < 1.0).any(), hits / known


def test_unpaired_by_hand() -> None:
    one, other = Estimate(5.0, (0.0, 9.0), 2.0, 8.0), Estimate(4.0, None, 1.5, 3.0)
    found = unpaired_difference(one, other)
    freedom = 2.5**4 / (2.0**4 / 8 + 1.5**4 / 3)
    assert (found.value, found.error, found.freedom) == pytest.approx((1.0, 2.5, freedom))
    assert found.interval == pytest.approx(
        (1 - 2.5 * stats.t.ppf(0.975, freedom), 1 + 2.5 * stats.t.ppf(0.975, freedom))
    )
    assert unpaired_difference(one, Estimate(4.0, (3.0, 5.0))).interval is None
    same = Estimate(2.0, (2.0, 2.0), 0.0, 8.0)
    assert unpaired_difference(same, same).interval == (0.0, 0.0)
