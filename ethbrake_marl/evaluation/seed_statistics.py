"""Statistics over trainings: a figure per seed, and what they say about the next seed.

Few seeds are the rule, and one bad one moves a mean a lot. The interquartile mean leaves out the best and the worst
quarter; the bootstrap says how far it may be off, drawing seeds anew within each task (stratified), since tasks are
chosen and not drawn.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import bootstrap, trim_mean

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import CONFIDENCE, Estimate, wilson
from ethbrake_marl.physics import Floats

RESAMPLES = 10_000
_CUT = 0.25
_AT_ONCE = 1 << 20  # drawn worlds in memory: 8 MB


def interquartile_mean(
    tasks: Sequence[ArrayLike], *, confidence: float = CONFIDENCE, resamples: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Mean of the middle half of all figures, with its stratified bootstrap interval (percentiles).

    ``tasks`` holds one list of figures, one per seed, for each task (scenario); floor(n / 4) of all n figures are left
    out at either end. The interval is None when no task has two seeds. Raises ``InvalidInput`` for a task without
    figures, or with one that is not finite.
    """
    strata = [_check(figures, f"task {k}") for k, figures in enumerate(tasks)]
    if not strata:
        raise InvalidInput("interquartile_mean: no tasks; at least one list of figures is needed")

    def statistic(*drawn: Floats, axis: int) -> Floats:
        middle: Floats = trim_mean(np.concatenate(drawn, axis=axis), _CUT, axis=axis)
        return middle

    value = float(statistic(*strata, axis=0))
    again = [figures for figures in strata if len(figures) > 1]
    if not again:
        return Estimate(value, None)
    fixed = [figures for figures in strata if len(figures) == 1]

    def resample(*drawn: Floats, axis: int) -> Floats:
        shape = drawn[0].shape[:-1]
        return statistic(*drawn, *(np.broadcast_to(one, (*shape, 1)) for one in fixed), axis=axis)

    found = bootstrap(
        again, resample, n_resamples=resamples, confidence_level=confidence, method="percentile", rng=seed,
        vectorized=True,
    )  # fmt: skip
    return Estimate(value, (float(found.confidence_interval.low), float(found.confidence_interval.high)))


def paired_over_seeds(
    values: ArrayLike, baseline: ArrayLike, *, confidence: float = CONFIDENCE, resamples: int = 2000, seed: int = 0
) -> Estimate:
    """Mean of ``values - baseline`` on the same worlds, [seeds, worlds] each (numbers of seeds may differ).

    Its bootstrap interval draws the seeds of either side and the worlds, which both sides share, anew: an interval
    that leaves out 0 holds for other seeds *and* other worlds. None with a single world. Raises ``InvalidInput`` for
    arrays that cannot be paired or are not finite.
    """
    first, second = _pair_sides("paired_over_seeds", values, baseline)
    value = float((first.mean(axis=0) - second.mean(axis=0)).mean())
    if first.shape[1] < 2:
        return Estimate(value, None)
    means = _resample_means((first, second), resamples, seed)
    return _with_percentiles(value, means[:, 0] - means[:, 1], confidence)


def mean_over_seeds(
    values: ArrayLike, *, confidence: float = CONFIDENCE, resamples: int = 2000, seed: int = 0
) -> Estimate:
    """Mean of ``values`` [seeds, worlds], with the interval that holds for other seeds and other worlds."""
    given = np.atleast_2d(np.asarray(values, np.float64))
    return paired_over_seeds(
        given, np.zeros((1, given.shape[-1])), confidence=confidence, resamples=resamples, seed=seed
    )


def rate_over_seeds(happened: ArrayLike, *, seed: int = 0) -> Estimate:
    """Share of the episodes [seeds, worlds] in which something happened, with an interval as in ``mean_over_seeds``.

    That is no interval where it happened nearly always or never: draws of such worlds are all alike. So it reaches at
    least as far as Wilson's of the share over the worlds.
    """
    given = np.atleast_2d(np.asarray(happened, np.float64))
    found, worlds = mean_over_seeds(given, seed=seed), given.shape[1]
    share = min(found.value, 1.0)  # a mean of ones may be rounded up
    low, high = wilson(share, worlds)
    ends = found.interval or (low, high)
    return Estimate(share, (max(min(low, ends[0]), 0.0), min(max(high, ends[1]), 1.0)))


def share_over_seeds(
    values: ArrayLike,
    worst: ArrayLike,
    best: ArrayLike,
    *,
    confidence: float = CONFIDENCE,
    resamples: int = 2000,
    seed: int = 0,
) -> Estimate | None:
    """``(mean(worst) - mean(values)) / (mean(worst) - mean(best))`` on the same worlds, [seeds, worlds] each.

    Which part of the way from ``worst`` to ``best`` the values are; the interval is as in ``paired_over_seeds``. None
    where ``best`` is not below ``worst``.
    """
    sides = _pair_sides("share_over_seeds", values, worst, best)
    reached, high, low = (float(side.mean(axis=0).mean()) for side in sides)
    if not high > low:
        return None
    share = (high - reached) / (high - low)
    if sides[0].shape[1] < 2:
        return Estimate(share, None)
    means = _resample_means(sides, resamples, seed)
    means = means[means[:, 1] > means[:, 2]]
    return _with_percentiles(share, (means[:, 1] - means[:, 0]) / (means[:, 1] - means[:, 2]), confidence)


def _pair_sides(who: str, *sides: ArrayLike) -> tuple[Floats, ...]:
    """The sides as [seeds, worlds], all with the same worlds; raises ``InvalidInput``."""
    arrays = tuple(np.atleast_2d(np.asarray(given, np.float64)) for given in sides)
    if any(side.ndim != 2 or not side.size or side.shape[1] != arrays[0].shape[-1] for side in arrays):
        shapes = " and ".join(str(side.shape) for side in arrays)
        raise InvalidInput(f"{who}: shapes {shapes}: must be [seeds, worlds] with the same worlds")
    if not all(np.isfinite(side).all() for side in arrays):
        raise InvalidInput(f"{who}: every harm must be finite")
    return arrays


def _resample_means(sides: Sequence[Floats], resamples: int, seed: int) -> Floats:
    """Means [resamples, sides] over seeds of each side and over worlds, which all sides share, drawn anew."""
    worlds = sides[0].shape[1]
    rng = np.random.default_rng(seed)
    parts: list[Floats] = []
    chunk = max(1, _AT_ONCE // worlds)
    for size in (min(chunk, resamples - begin) for begin in range(0, resamples, chunk)):
        drawn = rng.integers(worlds, size=(size, worlds)) + worlds * np.arange(size)[:, np.newaxis]
        weights = np.bincount(drawn.ravel(), minlength=size * worlds).reshape(size, worlds) / worlds
        means = np.empty((size, len(sides)))
        for column, side in enumerate(sides):
            seeds = rng.integers(len(side), size=(size, len(side)))
            # Not a matrix product: its order of adding depends on the machine.
            of_seeds = np.stack([(weights * row).sum(axis=1) for row in side], axis=1)
            means[:, column] = np.take_along_axis(of_seeds, seeds, axis=1).mean(axis=1)
        parts.append(means)
    return np.concatenate(parts)


def _with_percentiles(value: float, resampled: Floats, confidence: float) -> Estimate:
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(resampled, [tail, 100.0 - tail])
    return Estimate(value, (float(low), float(high)))


def _check(figures: ArrayLike, name: str) -> Floats:
    data = np.asarray(figures, np.float64)
    if data.ndim != 1 or len(data) < 1 or not np.isfinite(data).all():
        raise InvalidInput(f"interquartile_mean: {name}: one finite figure per seed is needed, at least one")
    return data
