from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, bootstrap

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import mean, paired_difference, rate, relative_decrease
from ethbrake_marl.files.sheet import Estimate

T_4, T_1 = 2.7764451, 12.7062047  # 97.5 % quantiles of Student's t with 4 and 1 degrees of freedom
Z_SQUARED = 3.8414588  # of the normal quantile at 97.5 %


def test_rate__five_of_ten_is_the_textbook_wilson_interval() -> None:
    assert rate(5, 10).value == 0.5
    assert rate(5, 10).interval == pytest.approx((0.2365931, 0.7634069), abs=1e-7)


@pytest.mark.parametrize("count", [1, 10, 10_000])
def test_rate__none_and_all_reach_the_end_of_the_range_and_no_further(count: int) -> None:
    reach = Z_SQUARED / (count + Z_SQUARED)
    assert rate(0, count).interval == pytest.approx((0.0, reach), abs=1e-8)
    assert rate(count, count).interval == pytest.approx((1.0 - reach, 1.0), abs=1e-8)
    assert rate(0, count).interval[0] == 0.0
    assert rate(count, count).interval[1] == 1.0


@pytest.mark.parametrize(("successes", "count"), [(-1, 10), (11, 10), (0, 0)])
def test_rate__refuses_impossible_counts(successes: int, count: int) -> None:
    with pytest.raises(InvalidInput, match="successes"):
        rate(successes, count)


def test_mean__one_to_five() -> None:
    half = T_4 * np.sqrt(2.5 / 5.0)  # the variance of 1..5 is 2.5
    assert mean(np.arange(1.0, 6.0)).value == 3.0
    assert mean(np.arange(1.0, 6.0)).interval == pytest.approx((3.0 - half, 3.0 + half), abs=1e-6)


def test_mean__of_a_single_world_has_no_interval() -> None:
    assert mean(np.array([7.0])).value == 7.0
    assert mean(np.array([7.0])).interval is None


def test_mean__at_the_size_of_our_lists_is_the_bootstrap_interval() -> None:
    harm = np.maximum(np.random.default_rng(1).normal(2.0, 20.0, 4000), 0.0)  # many zeros and a long tail, as harm has
    boot = bootstrap((harm,), np.mean, n_resamples=2000, method="percentile", rng=2).confidence_interval
    ours = mean(harm).interval
    width = ours[1] - ours[0]
    assert ours == pytest.approx((boot.low, boot.high), abs=0.05 * width)


def test_paired_difference__a_constant_gain_has_no_spread() -> None:
    baseline = np.array([0.0, 10.0, 50.0])
    estimate = paired_difference(baseline - 2.0, baseline)
    assert estimate.value == -2.0
    assert estimate.interval == (-2.0, -2.0)


def test_relative_decrease__two_worlds_by_hand() -> None:
    # ratio 0.75; residuals -0.5 and 0.5, s = sqrt(0.5), standard error sqrt(0.5) / (sqrt(2) * 2) = 0.25
    estimate = relative_decrease(np.array([1.0, 2.0]), np.array([2.0, 2.0]))
    assert estimate is not None
    assert estimate.value == 0.25
    assert estimate.interval == pytest.approx((0.25 - 0.25 * T_1, 0.25 + 0.25 * T_1), abs=1e-6)


def test_relative_decrease__is_the_bootstrap_interval_of_the_paired_ratio() -> None:
    rng = np.random.default_rng(3)
    baseline = rng.gamma(1.0, 24.0, 4000)
    values = baseline * rng.uniform(0.0, 1.0, 4000)
    boot = bootstrap(
        (values, baseline), lambda x, y, axis: 1.0 - x.mean(axis=axis) / y.mean(axis=axis),
        paired=True, n_resamples=2000, method="percentile", rng=4,
    ).confidence_interval  # fmt: skip
    ours = relative_decrease(values, baseline).interval
    assert ours == pytest.approx((boot.low, boot.high), abs=0.05 * (ours[1] - ours[0]))


def test_relative_decrease__against_a_harmless_baseline_does_not_exist() -> None:
    assert relative_decrease(np.array([1.0, 0.0]), np.zeros(2)) is None


@pytest.mark.parametrize("values", [np.array([]), np.array([1.0, np.nan]), np.array([np.inf]), np.ones((2, 2))])
def test_statistics__refuse_what_is_not_a_column_of_numbers(values: np.ndarray) -> None:
    with pytest.raises(InvalidInput, match="finite number per world"):
        mean(values)


def test_statistics__refuse_to_pair_lists_of_different_length() -> None:
    with pytest.raises(InvalidInput, match="3 values cannot be paired with 2"):
        paired_difference(np.zeros(3), np.zeros(2))


def test_json__of_an_estimate_has_its_interval_as_a_list_and_null_for_what_does_not_exist() -> None:
    assert Estimate(2.0, (1.0, 3.0)).to_json() == {"value": 2.0, "interval": [1.0, 3.0]}
    assert Estimate(2.0, None).to_json() == {"value": 2.0, "interval": None}
    told = Estimate.side_by_side({"harm": Estimate(2.0, (1.0, 3.0)), "alone": Estimate(4.0, None), "absent": None})
    assert list(told.items()) == [
        ("harm", 2.0), ("harm_interval", [1.0, 3.0]), ("alone", 4.0), ("alone_interval", None),
        ("absent", None), ("absent_interval", None),
    ]  # fmt: skip


def test_exact_rate__the_textbook_interval_of_clopper_and_pearson() -> None:
    assert rate(5, 10, exact=True).value == 0.5
    assert rate(5, 10, exact=True).interval == pytest.approx((0.1870860, 0.8129140), abs=1e-7)


@pytest.mark.parametrize("count", [1, 10, 10**8])
def test_exact_rate__none_and_all_reach_the_ends(count: int) -> None:
    reach = 1.0 - 0.025 ** (1.0 / count)
    assert rate(0, count, exact=True).interval == pytest.approx((0.0, reach), rel=1e-6)
    assert rate(count, count, exact=True).interval == pytest.approx((1.0 - reach, 1.0), rel=1e-9)


@pytest.mark.parametrize(("successes", "count"), [(1, 3), (3, 10**8), (5 * 10**7, 10**8), (10**8 - 2, 10**8)])
def test_exact_rate__its_ends_have_the_tails_that_they_must(successes: int, count: int) -> None:
    low, high = rate(successes, count, exact=True).interval
    assert binom.sf(successes - 1, count, low) == pytest.approx(0.025, rel=1e-6)
    assert binom.cdf(successes, count, high) == pytest.approx(0.025, rel=1e-6)


def test_mean__does_not_depend_on_the_order_of_the_worlds() -> None:
    harm = np.random.default_rng(9).exponential(20.0, 1000)
    other = harm[::-1].copy()
    assert mean(harm) == mean(other)
    assert paired_difference(harm, other) == paired_difference(other[::-1].copy(), harm[::-1].copy())
