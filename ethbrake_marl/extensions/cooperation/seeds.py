"""Means over training runs with different seeds, with confidence intervals for other seeds and other worlds.

The bootstrap resamples the seeds of each argument, and the worlds (or recordings) of all arguments together.
``values``, ``baseline``, ``worst`` and ``best`` are [seeds, worlds], for the same worlds; the numbers of seeds may
differ. ``clusters`` contains the name of each world's recording, [worlds]; None: all worlds are independent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ethbrake_marl.evaluation.statistics import Clusters, rate, wilson
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.motion.layout import Floats, Ints

RESAMPLES = 2_000
RESAMPLES_AT_ONCE = 1 << 20  # resampled worlds in memory (8 MB)
LEAST_REDUCTION = 1e-3  # part of the possible reduction below which a resample is not used
CONFIDENCE = 0.95


def mean_over_seeds(values: Any, baseline: Any = None, clusters: Clusters = None) -> Estimate:
    """Mean over seeds and worlds of ``values``, or of ``values - baseline``.

    The interval of a share contains Wilson's, because bootstrap intervals of nearly constant values are too narrow. An
    estimate from one recording has no interval; other estimates than shares have none with one world, or if all values
    are 0 without a baseline.
    """
    array = np.atleast_2d(np.asarray(values))
    sides = [array, np.zeros((1, array.shape[1])) if baseline is None else np.atleast_2d(baseline)]
    value = float((sides[0].mean(axis=0) - sides[1].mean(axis=0)).mean())
    interval = _interval(sides, lambda means: means[:, 0] - means[:, 1], clusters)
    if baseline is not None or (array < 0).any():
        return Estimate(value, interval)
    if array.dtype != np.bool_:
        if interval is None or not array.any():
            return Estimate(value, None)
        return Estimate(value, (max(interval[0], 0.0), interval[1]))
    share = min(value, 1.0)  # the mean of values that are all 1 may be rounded up
    if clusters is not None and interval is None:
        return Estimate(share, None)
    if clusters is None:
        low, high = wilson(share, array.shape[1])
    else:
        low, high = rate(array.ravel(), np.tile(clusters, len(array))).interval or (0.0, 1.0)
    ends = interval or (low, high)
    return Estimate(share, (max(min(low, ends[0]), 0.0), min(max(high, ends[1]), 1.0)))


def share_over_seeds(values: Floats, worst: Floats, best: Floats, clusters: Clusters = None) -> Estimate | None:
    """Share of the possible reduction ``(mean(worst) - mean(values)) / (mean(worst) - mean(best))``.

    None if ``mean(best) >= mean(worst)``, or if at least 5 % of the resamples leave almost nothing to reduce.
    """
    sides = [np.atleast_2d(array) for array in (values, worst, best)]
    reached, high, low = (float(side.mean(axis=0).mean()) for side in sides)
    if not high > low:
        return None

    def shares(means: Floats) -> Floats:
        possible = means[:, 1] - means[:, 2]
        there = possible > LEAST_REDUCTION * (high - low)
        share: Floats = (means[there, 1] - means[there, 0]) / possible[there]
        return share if there.mean() > CONFIDENCE else np.full(1, np.nan)

    interval = _interval(sides, shares, clusters)
    if interval is not None and np.isnan(interval).any():
        return None
    return Estimate((high - reached) / (high - low), interval)


def _interval(
    sides: Sequence[Floats], of: Callable[[Floats], Floats], clusters: Clusters
) -> tuple[float, float] | None:
    """Confidence interval of a statistic ``of`` means [resamples, arguments]; None with one world or recording."""
    cluster = np.arange(sides[0].shape[1]) if clusters is None else np.unique(clusters, return_inverse=True)[1]
    if cluster.max() == 0:
        return None
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(of(_resampled_means(sides, cluster)), [tail, 100.0 - tail])
    return float(low), float(high)


def _resampled_means(sides: Sequence[Floats], cluster: Ints) -> Floats:
    """Means of the arguments in the same random resamples of worlds or recordings, [RESAMPLES, arguments]."""
    worlds, number, rng = len(cluster), int(cluster.max()) + 1, np.random.default_rng(0)
    means, chunk = np.empty((RESAMPLES, len(sides))), max(1, RESAMPLES_AT_ONCE // worlds)
    for begin in range(0, RESAMPLES, chunk):
        size = min(chunk, RESAMPLES - begin)
        draws = rng.integers(number, size=(size, number)) + number * np.arange(size)[:, np.newaxis]
        times = np.bincount(draws.ravel(), minlength=size * number).reshape(size, number).take(cluster, axis=1)
        weights = times / times.sum(axis=1, keepdims=True)
        for column, side in enumerate(sides):
            seeds = rng.integers(len(side), size=(size, len(side)))
            # A matrix product would add in an order that depends on the machine.
            of_seeds = np.stack([(weights * row).sum(axis=1) for row in side], axis=1)
            means[begin : begin + size, column] = np.take_along_axis(of_seeds, seeds, axis=1).mean(axis=1)
    return means
