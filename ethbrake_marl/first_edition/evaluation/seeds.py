"""Statistics over training runs with different seeds. The intervals also include the randomness of the seeds, so they
say what result to expect from a training run with another seed.

There are usually few training runs, and a single bad run changes their mean a lot. The interquartile mean therefore
omits the best and the worst quarter of the runs' results. Its error is estimated with a stratified bootstrap: seeds are
resampled within each task (scenario), because seeds are random and tasks are not.

Arguments that several functions share: ``values``, ``baseline``, ``worst``, ``best`` and each of ``sides`` have one
result per training run (seed) and world, [seeds, worlds], for the same worlds; the numbers of seeds may differ.
``clusters`` has the name of each world's cluster (``statistics``), [worlds]; None: all worlds are independent. ``seed``
is the seed of the bootstrap's random numbers. ``mean_over_seeds`` and ``share_over_seeds`` raise ``InvalidInput`` if
the arrays do not all have the same number of worlds, or if a value is not finite.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.evaluation.statistics import CONFIDENCE, Texts, check, of_amounts, share_of, wilson
from ethbrake_marl.first_edition.physics.state import Floats, Ints

RESAMPLES = 10_000  # number of bootstrap resamples of seeds

_RESAMPLES = 2_000  # number of bootstrap resamples of seeds and worlds

# A resample whose possible reduction is below this fraction of the possible reduction in all data is not used.
_LEAST_REDUCTION = 1e-3

_CUT = 0.25  # fraction of the values that the interquartile mean omits at either end

_AT_ONCE = 1 << 20  # number of resampled worlds in memory at once (8 MB)


def interquartile_mean(tasks: Sequence[ArrayLike], *, resamples: int = RESAMPLES, seed: int = 0) -> Estimate:
    """Return the interquartile mean of the results of training runs, with a stratified bootstrap interval.

    ``tasks`` has the results on each task, one number per seed. Of all n results, the floor(n / 4) smallest and the
    floor(n / 4) largest are omitted. The ends of the interval are percentiles of the interquartile means of the
    bootstrap resamples. The interval is None if every task has the result of only one seed. Raises ``InvalidInput`` if
    there are no tasks, if a task has no results, or if a result is not finite.
    """
    from scipy.stats import bootstrap, trim_mean  # imported here because it takes a second to load

    strata = [check(figures, f"interquartile_mean: task {k}", "seed") for k, figures in enumerate(tasks)]
    if not strata:
        raise InvalidInput("interquartile_mean: tasks is empty; pass the results of at least one task")

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

    The bootstrap resamples the seeds of ``values``, the seeds of ``baseline``, and the worlds (or clusters of worlds).
    The interval therefore says what mean to expect with other seeds and other worlds. There is no interval if there is
    only one world or cluster, or if no baseline is given and all values are 0. Without a baseline, the interval of
    true/false values is widened so that it contains Wilson's interval, because bootstrap intervals of nearly constant
    values are too narrow.
    """
    array = np.atleast_2d(np.asarray(values))
    sides = _pair_sides("mean_over_seeds", array, np.zeros((1, array.shape[-1])) if baseline is None else baseline)
    value = float((sides[0].mean(axis=0) - sides[1].mean(axis=0)).mean())
    estimate = _resampled(value, sides, lambda means: means[:, 0] - means[:, 1], clusters, seed)
    if baseline is not None or (array < 0).any():
        return estimate
    if array.dtype != np.bool_:
        return of_amounts(estimate, nothing=not array.any())
    share = min(value, 1.0)  # the mean of values that are all 1 may be rounded up
    if clusters is None:
        low, high = wilson(share, array.shape[1])
    else:
        low, high = share_of(array.ravel(), np.tile(clusters, len(array))).interval or (0.0, 1.0)
    ends = estimate.interval or (low, high)
    return Estimate(share, (max(min(low, ends[0]), 0.0), min(max(high, ends[1]), 1.0)))


def share_over_seeds(
    values: ArrayLike, worst: ArrayLike, best: ArrayLike, *, clusters: Texts | None = None, seed: int = 0
) -> Estimate | None:
    """Return the share of the possible reduction ``(mean(worst) - mean(values)) / (mean(worst) - mean(best))``.

    ``values``, ``worst`` and ``best`` are harms, m2/s2. The bootstrap interval is as in ``mean_over_seeds``. The result
    is None if ``mean(best) >= mean(worst)``. The result is also None if almost no reduction is possible in 5 % of the
    bootstrap resamples or more. *Almost no reduction* means that ``mean(worst) - mean(best)`` in the resample is at
    most 0.1 % of ``mean(worst) - mean(best)`` in the original data.
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
    """Return each of ``sides`` as a checked array; ``who`` is the name of the calling function, for error messages."""
    arrays = tuple(np.atleast_2d(np.asarray(side, np.float64)) for side in sides)
    if any(side.ndim != 2 or not side.size or side.shape[1] != arrays[0].shape[-1] for side in arrays):
        shapes = " and ".join(str(side.shape) for side in arrays)
        raise InvalidInput(
            f"{who}: the arrays have the shapes {shapes}: must be [seeds, worlds] with the same number of worlds"
        )
    if not all(np.isfinite(side).all() for side in arrays):
        raise InvalidInput(f"{who}: some values are NaN or infinite: all values must be finite")
    return arrays


def _resampled(
    value: float, sides: Sequence[Floats], of: Callable[[Floats], Floats], clusters: Texts | None, seed: int
) -> Estimate:
    """Return ``value`` with a bootstrap interval, or without an interval if there is only one world or cluster.

    ``of`` computes the statistic of each resample, [resamples], from the mean of each of ``sides``, [resamples, number
    of sides]. The ends of the interval are percentiles of the statistic.
    """
    worlds = sides[0].shape[1]
    cluster = np.arange(worlds) if clusters is None else np.unique(clusters, return_inverse=True)[1]
    if cluster.max() == 0:
        return Estimate(value, None)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(of(_resample_means(sides, cluster, _RESAMPLES, seed)), [tail, 100.0 - tail])
    return Estimate(value, (float(low), float(high)))


def _resample_means(sides: Sequence[Floats], cluster: Ints, resamples: int, seed: int) -> Floats:
    """Return the mean of each of ``sides`` in each bootstrap resample, [resamples, number of sides].

    Seeds are resampled separately for each of ``sides``. Clusters of worlds are resampled once for all ``sides``
    together, and a drawn cluster contributes all its worlds. ``cluster`` is the number (from 0) of each world's
    cluster, [worlds].
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
            # A matrix product would add in an order that depends on the machine.
            of_seeds = np.stack([(weights * row).sum(axis=1) for row in side], axis=1)
            means[:, column] = np.take_along_axis(of_seeds, seeds, axis=1).mean(axis=1)
        parts.append(means)
    return np.concatenate(parts)
