"""Statistics over trainings with different seeds: estimates that say what to expect of another seed.

Usually there are few seeds, and a single bad one moves a mean a lot. The interquartile mean omits the best and the
worst quarter. The bootstrap estimates its error by resampling seeds within each task (stratified), because tasks are
chosen and not drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import CONFIDENCE, Texts, check, of_amounts, share_of, wilson
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.physics.state import Floats, Ints

RESAMPLES = 10_000  # bootstrap resamples of seeds

_RESAMPLES = 2_000  # bootstrap resamples of seeds and worlds

_LEAST_REDUCTION = 1e-3  # part of the possible reduction below which a resample has no share

_CUT = 0.25  # share of values that the interquartile mean omits at either end

_AT_ONCE = 1 << 20  # resampled worlds in memory at once: 8 MB


def interquartile_mean(tasks: Sequence[ArrayLike], *, resamples: int = RESAMPLES, seed: int = 0) -> Estimate:
    """Return the mean of the middle half of all values, with its stratified bootstrap interval (percentiles).

    Of all n values, floor(n / 4) are omitted at either end. The interval is None if no task has two seeds.

    Args:
        tasks: for each task (scenario), the results of its trainings, one number per seed.
        resamples: number of bootstrap resamples.
        seed: seed of the bootstrap.

    Raises ``InvalidInput`` for a task without values, or for a value that is not finite.

    """
    from scipy.stats import bootstrap, trim_mean  # imported here because it takes a second to load

    strata = [check(figures, f"interquartile_mean: task {k}", "seed") for k, figures in enumerate(tasks)]
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

    resampled = bootstrap(
        again, resample, n_resamples=resamples, confidence_level=CONFIDENCE, method="percentile", rng=seed,
        vectorized=True,
    )  # fmt: skip
    return Estimate(value, (float(resampled.confidence_interval.low), float(resampled.confidence_interval.high)))


def mean_over_seeds(
    values: ArrayLike, baseline: ArrayLike | None = None, *, clusters: Texts | None = None, seed: int = 0
) -> Estimate:
    """Return the mean over seeds and worlds of ``values``, or of ``values - baseline``, with a bootstrap interval.

    The bootstrap resamples the seeds of each side, and the worlds or clusters, which both sides share. So an interval
    of differences that excludes 0 holds for other seeds *and* other worlds. There is no interval for a single world or
    cluster, nor without a baseline if all values are 0. The interval of true/false values without a baseline also
    covers Wilson's interval, because resamples of values that hardly ever differ are too narrow.

    Args:
        values: [seeds, worlds] result of the training with each seed in each world.
        baseline: [seeds, worlds] results to subtract, in the same worlds; the number of seeds may differ.
        clusters: name of each world's cluster, [worlds]; only clusters are independent. None: all worlds are.
        seed: seed of the bootstrap.

    Raises ``InvalidInput`` for arrays that cannot be paired or are not finite.

    """
    array = np.atleast_2d(np.asarray(values))
    sides = _pair_sides("mean_over_seeds", array, np.zeros((1, array.shape[-1])) if baseline is None else baseline)
    value = float((sides[0].mean(axis=0) - sides[1].mean(axis=0)).mean())
    estimate = _resampled(value, sides, lambda means: means[:, 0] - means[:, 1], clusters, seed)
    if baseline is not None or (array < 0).any():
        return estimate
    if array.dtype != np.bool_:
        return of_amounts(estimate, nothing=not array.any())
    share = min(value, 1.0)  # a mean of ones may be rounded up
    if clusters is None:
        low, high = wilson(share, array.shape[1])
    else:
        low, high = share_of(array.ravel(), np.tile(clusters, len(array))).interval or (0.0, 1.0)
    ends = estimate.interval or (low, high)
    return Estimate(share, (max(min(low, ends[0]), 0.0), min(max(high, ends[1]), 1.0)))


def share_over_seeds(
    values: ArrayLike, worst: ArrayLike, best: ArrayLike, *, clusters: Texts | None = None, seed: int = 0
) -> Estimate | None:
    """Return the share of the possible reduction that ``values`` reaches: 0 like ``worst``, 1 like ``best``.

    It is ``(mean(worst) - mean(values)) / (mean(worst) - mean(best))``, with the bootstrap interval of
    ``mean_over_seeds``. Returns None unless ``best`` has a lower mean than ``worst``, also in nearly all resamples:
    few worlds with a reduction allow no share.

    Args:
        values: [seeds, worlds] harms to judge.
        worst: [seeds, worlds] harms that count as share 0, in the same worlds.
        best: [seeds, worlds] harms that count as share 1, in the same worlds.
        clusters: as in ``mean_over_seeds``.
        seed: seed of the bootstrap.

    """
    sides = _pair_sides("share_over_seeds", values, worst, best)
    reached, high, low = (float(side.mean(axis=0).mean()) for side in sides)
    if not high > low:
        return None

    def shares(means: Floats) -> Floats:
        possible = means[:, 1] - means[:, 2]
        there = possible > _LEAST_REDUCTION * (high - low)
        share: Floats = (means[there, 1] - means[there, 0]) / possible[there]
        return share if there.mean() > CONFIDENCE else np.full(1, np.nan)

    share = _resampled((high - reached) / (high - low), sides, shares, clusters, seed)
    return None if share.interval is not None and np.isnan(share.interval).any() else share


def _pair_sides(who: str, *sides: ArrayLike) -> tuple[Floats, ...]:
    """Return each of ``sides`` as an array [seeds, worlds].

    Raises ``InvalidInput``, naming the function ``who``, if their numbers of worlds differ or a value is not finite.
    """
    arrays = tuple(np.atleast_2d(np.asarray(side, np.float64)) for side in sides)
    if any(side.ndim != 2 or not side.size or side.shape[1] != arrays[0].shape[-1] for side in arrays):
        shapes = " and ".join(str(side.shape) for side in arrays)
        raise InvalidInput(f"{who}: shapes {shapes}: must be [seeds, worlds] with the same worlds")
    if not all(np.isfinite(side).all() for side in arrays):
        raise InvalidInput(f"{who}: every harm must be finite")
    return arrays


def _resampled(
    value: float, sides: Sequence[Floats], of: Callable[[Floats], Floats], clusters: Texts | None, seed: int
) -> Estimate:
    """Return ``value`` with a bootstrap interval, or without one for a single world or cluster.

    The interval holds the percentiles of ``of(means)``, where ``means`` [resamples, sides] are the resampled means.
    ``clusters`` names the cluster of each world (None: all are independent); ``seed`` is the seed of the bootstrap.
    """
    worlds = sides[0].shape[1]
    cluster = np.arange(worlds) if clusters is None else np.unique(clusters, return_inverse=True)[1]
    if cluster.max() == 0:
        return Estimate(value, None)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(of(_resample_means(sides, cluster, _RESAMPLES, seed)), [tail, 100.0 - tail])
    return Estimate(value, (float(low), float(high)))


def _resample_means(sides: Sequence[Floats], cluster: Ints, resamples: int, seed: int) -> Floats:
    """Return the mean of each of ``sides`` (arrays [seeds, worlds]) in each bootstrap resample, [resamples, sides].

    Seeds are resampled separately for each side; clusters are resampled once for all sides, each with all its worlds.
    ``cluster`` [worlds] is the number of each world's cluster, from 0.
    """
    worlds, number = len(cluster), int(cluster.max()) + 1
    rng = np.random.default_rng(seed)
    parts: list[Floats] = []
    chunk = max(1, _AT_ONCE // worlds)
    for size in (min(chunk, resamples - begin) for begin in range(0, resamples, chunk)):
        drawn = rng.integers(number, size=(size, number)) + number * np.arange(size)[:, np.newaxis]
        times = np.bincount(drawn.ravel(), minlength=size * number).reshape(size, number).take(cluster, axis=1)
        weights = times / times.sum(axis=1, keepdims=True)
        means = np.empty((size, len(sides)))
        for column, side in enumerate(sides):
            seeds = rng.integers(len(side), size=(size, len(side)))
            # No matrix product, because its order of addition depends on the machine.
            of_seeds = np.stack([(weights * row).sum(axis=1) for row in side], axis=1)
            means[:, column] = np.take_along_axis(of_seeds, seeds, axis=1).mean(axis=1)
        parts.append(means)
    return np.concatenate(parts)
