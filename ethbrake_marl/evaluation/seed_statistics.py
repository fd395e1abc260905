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
from ethbrake_marl.evaluation.statistics import CONFIDENCE, Estimate
from ethbrake_marl.physics import Floats

RESAMPLES = 10_000
_CUT = 0.25


def interquartile_mean(
    tasks: Sequence[ArrayLike], *, confidence: float = CONFIDENCE, resamples: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Mean of the middle half of all figures, with its stratified bootstrap interval (percentiles).

    ``tasks`` holds one list of figures, one per seed, for each task (scenario); floor(n / 4) of all n figures are left
    out at either end. The interval is None when no task has two seeds. Raises ``InvalidInput`` for a task without
    figures, or with one that is not finite.
    """
    strata = [_checked(figures, f"task {k}") for k, figures in enumerate(tasks)]
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

    def resampled(*drawn: Floats, axis: int) -> Floats:
        shape = drawn[0].shape[:-1]
        return statistic(*drawn, *(np.broadcast_to(one, (*shape, 1)) for one in fixed), axis=axis)

    found = bootstrap(
        again, resampled, n_resamples=resamples, confidence_level=confidence, method="percentile", rng=seed,
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
    first, second = (np.atleast_2d(np.asarray(given, np.float64)) for given in (values, baseline))
    if first.ndim != 2 or second.ndim != 2 or first.shape[1] != second.shape[1] or not first.size or not second.size:
        raise InvalidInput(
            f"paired_over_seeds: shapes {first.shape} and {second.shape}: must be [seeds, worlds] with the same worlds"
        )
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise InvalidInput("paired_over_seeds: every harm must be finite")
    value = float((first.mean(axis=0) - second.mean(axis=0)).mean())
    worlds = first.shape[1]
    if worlds < 2:
        return Estimate(value, None)
    rng = np.random.default_rng(seed)
    differences = np.empty(resamples)
    for k in range(resamples):
        weight = np.bincount(rng.integers(worlds, size=worlds), minlength=worlds) / worlds
        means = [side[rng.integers(len(side), size=len(side))] @ weight for side in (first, second)]
        differences[k] = means[0].mean() - means[1].mean()
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(differences, [tail, 100.0 - tail])
    return Estimate(value, (float(low), float(high)))


def _checked(figures: ArrayLike, name: str) -> Floats:
    data = np.asarray(figures, np.float64)
    if data.ndim != 1 or len(data) < 1 or not np.isfinite(data).all():
        raise InvalidInput(f"interquartile_mean: {name}: one finite figure per seed is needed, at least one")
    return data
