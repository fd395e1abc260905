from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import statistics
from ethbrake_marl.evaluation.statistics import interquartile_mean, mean_over_seeds, rate, share_over_seeds


@pytest.mark.parametrize(
    ("tasks", "expected"),
    [
        ([[7.0]], 7.0),
        ([[1.0, 2.0, 3.0]], 2.0),  # nothing is left out of three
        ([[1.0, 2.0, 3.0, 100.0]], 2.5),  # 1 and 100 are
        ([[100.0, 4.0, 6.0, 5.0, -90.0]], 5.0),
        ([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 80.0]], 4.5),  # of all eight: 3, 4, 5, 6
    ],
)
def test_interquartile_mean__by_hand(tasks: list[list[float]], expected: float) -> None:
    estimate = interquartile_mean(tasks, resamples=200)
    assert estimate.value == pytest.approx(expected, abs=1e-12)
    assert (estimate.interval is None) == (len(tasks[0]) == 1)


def test_interquartile_mean__two_seeds_have_the_interval_of_their_three_draws() -> None:
    estimate = interquartile_mean([[0.0, 1.0]], resamples=2000)  # means 0, 1/2, 1 with chances 1/4, 1/2, 1/4
    assert estimate == type(estimate)(0.5, (0.0, 1.0))


def test_interquartile_mean__strata_are_not_mixed() -> None:
    estimate = interquartile_mean([[1.0, 1.0, 1.0], [9.0, 9.0, 9.0]], resamples=200)
    assert estimate.value == 5.0 and estimate.interval == (5.0, 5.0)  # mixed draws would spread from 1 to 9


def test_interquartile_mean__covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for k in range(200):
        interval = interquartile_mean([rng.normal(size=12)], resamples=300, seed=k).interval
        assert interval is not None
        hits += interval[0] <= 0.0 <= interval[1]
    assert 0.84 <= hits / 200 <= 0.99  # the percentile bootstrap is a little short with twelve


def test_interquartile_mean__the_same_seed_the_same_interval() -> None:
    data = [np.random.default_rng(0).normal(size=8)]
    assert interquartile_mean(data, resamples=500, seed=3) == interquartile_mean(data, resamples=500, seed=3)


def test_mean_over_seeds__by_hand() -> None:
    easy_and_hard = np.array([1.0, 100.0, 1.0, 100.0])
    better = mean_over_seeds([easy_and_hard - 1.0, easy_and_hard - 3.0], easy_and_hard)
    assert better.value == pytest.approx(-2.0)
    assert better.interval == pytest.approx((-3.0, -1.0))  # the spread of the worlds cancels, that of the seeds stays


def test_mean_over_seeds__worlds_of_both_sides_are_drawn_together() -> None:
    rng = np.random.default_rng(2)
    worlds = rng.uniform(0.0, 100.0, 500)
    difference = rng.normal(0.5, 1.0, 500)
    estimate = mean_over_seeds(worlds + difference, worlds)
    assert estimate.interval is not None
    half = 1.96 * difference.std(ddof=1) / 500**0.5
    assert estimate.interval == pytest.approx((difference.mean() - half, difference.mean() + half), abs=0.02)
    assert mean_over_seeds([[1.0], [3.0]], [[1.0]]) == type(estimate)(1.0, None)


@pytest.mark.parametrize("tasks", [[], [[]], [[1.0, np.nan]], [[[1.0]]]])
def test_interquartile_mean__refuses_what_is_no_figure_per_seed(tasks: list[list[float]]) -> None:
    with pytest.raises(InvalidInput, match="interquartile_mean: "):
        interquartile_mean(tasks)


@pytest.mark.parametrize("values", [[[1.0, 2.0]], [[np.inf, 1.0, 2.0]], [], [[[1.0, 2.0, 3.0]]]])
def test_mean_over_seeds__refuses_what_cannot_be_paired(values: list[list[float]]) -> None:
    with pytest.raises(InvalidInput, match="mean_over_seeds: "):
        mean_over_seeds(values, [[1.0, 2.0, 3.0]])


def test_share_over_seeds__by_hand_and_wider_with_fewer_seeds() -> None:
    rng = np.random.default_rng(3)
    worst = 10.0 + rng.normal(size=200)
    best = np.full(200, 2.0)
    seeds = np.array([[4.0], [6.0]]) + 0.1 * rng.normal(size=(2, 200))
    found = share_over_seeds(seeds, worst, best)
    assert found is not None and found.interval is not None
    assert found.value == pytest.approx((worst.mean() - seeds.mean()) / (worst.mean() - 2.0), rel=1e-12)
    assert found.interval[0] == pytest.approx(0.5, abs=0.02) and found.interval[1] == pytest.approx(0.75, abs=0.02)
    assert share_over_seeds(seeds, worst, worst) is None
    with pytest.raises(InvalidInput, match="same worlds"):
        share_over_seeds(seeds, worst, best[:5])


def test_intervals__two_worlds_have_one_and_a_single_world_has_none() -> None:
    for interval in (
        share_over_seeds([[4.0, 6.0]], [10.0, 10.0], [0.0, 0.0]),
        mean_over_seeds([[4.0, 6.0]], [[0.0, 0.0]]),
        mean_over_seeds([[4.0, 6.0]]),
    ):
        assert interval is not None and interval.interval is not None and interval.interval[0] < interval.interval[1]
    alone = share_over_seeds([[4.0]], [10.0], [0.0])
    assert alone is not None and (alone.value, alone.interval) == (0.6, None)


@pytest.mark.parametrize("resamples", [1, 2, 3])
def test_resamples__are_as_many_as_asked_for(resamples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "_AT_ONCE", 4)  # two at a time
    sides = (np.arange(4.0).reshape(2, 2),)
    assert statistics._resample_means(sides, resamples, 0).shape == (resamples, 1)


def test_mean_over_seeds__is_the_mean_with_the_spread_between_seeds() -> None:
    found = mean_over_seeds(np.array([[1.0] * 50, [3.0] * 50]))
    assert (found.value, found.interval) == (2.0, pytest.approx((1.0, 3.0)))


def test_rate_over_seeds__is_no_certainty_where_all_worlds_were_alike() -> None:
    assert mean_over_seeds(np.ones((2, 20), np.bool_)).interval == rate(20, 20).interval
    assert mean_over_seeds(np.zeros((1, 20), np.bool_)).interval == rate(0, 20).interval
    assert mean_over_seeds(np.ones((1, 1), np.bool_)).interval == rate(1, 1).interval
    happened = np.zeros((4, 50), np.bool_)
    happened[0] = True  # one seed always, three never
    low, high = mean_over_seeds(happened).interval or (0.0, 0.0)
    assert low == 0.0 and high > 0.7


def test_mean_over_seeds__of_truths_against_a_baseline_is_a_difference() -> None:
    found = mean_over_seeds(np.array([[True, False, False, True]]), np.array([[True] * 4]))
    assert found.value == -0.5 and found.interval is not None and found.interval[0] < -0.5 < found.interval[1] <= 0.0
