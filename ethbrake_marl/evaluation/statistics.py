"""Estimates with 95 % intervals, from one number per world.

The worlds of a list are independent draws, and every agent is measured on the same ones: rates get Wilson's score
interval, means the t interval of the mean, and comparisons with a baseline are paired
by world, so that the spread between easy and hard worlds cancels. Means and their errors come from exact sums: the
order of the worlds changes no bit of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri, stdtrit

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.physics import Floats, Ints


def exact_sum(values: Floats, others: Floats | None = None) -> Fraction:
    """Sum of ``values`` [n], or of their products with ``others`` [n], without any rounding.

    A float64 is a whole number of 53 bits times a power of two. The whole numbers of each power are added as Python's
    own, which have no largest one. So no order of the worlds, and no division into parts, changes a bit. ``math.fsum``
    rounds the sum of each part, and a sum of parts once more. Raises ``InvalidInput`` for what is not finite.
    """
    wholes, powers = _in_wholes(values)
    if others is not None:
        factors, more = _in_wholes(others)
        wholes, powers = wholes * factors, powers + more
    sums = {power: int(wholes[powers == power].sum()) for power in np.unique(powers).tolist()}
    return sum((number * Fraction(2) ** power for power, number in sums.items()), Fraction())


def _in_wholes(values: Floats) -> tuple[NDArray[np.object_], Ints]:
    """Whole numbers and powers, [n] each: ``values = whole * 2 ** power``."""
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or not np.isfinite(data).all():
        raise InvalidInput(f"exact sum: shape {data.shape}; finite numbers, as [n], are needed")
    fractions, powers = np.frexp(data)
    return np.ldexp(fractions, 53).astype(np.int64).astype(np.object_), powers.astype(np.int64) - 53


CONFIDENCE = 0.95
_UPPER = 0.5 + 0.5 * CONFIDENCE  # the quantile at the upper end of an interval


@dataclass(frozen=True, slots=True)
class Moments:
    """Number, sum and sum of squares of some values, exact: they are added in any order.

    >>> import numpy as np
    >>> from ethbrake_marl.evaluation.statistics import Moments
    >>> Moments.of(np.array([0.1, 0.2])) + Moments.of(np.array([0.3])) == Moments.of(np.array([0.3, 0.1, 0.2]))
    True

    """

    count: int = 0
    total: Fraction = Fraction()
    squares: Fraction = Fraction()
    negative: int = field(default=0, compare=False)  # number of values that are, or may be, below 0

    @classmethod
    def of(cls, values: Floats) -> Moments:
        """Those of ``values`` [n]; raises as ``exact_sum``."""
        return cls(len(values), exact_sum(values), exact_sum(values, values), int(np.count_nonzero(values < 0.0)))

    def __add__(self, other: Moments) -> Moments:
        negative = self.negative + other.negative
        return Moments(self.count + other.count, self.total + other.total, self.squares + other.squares, negative)

    def minus(self, other: Moments, products: Fraction) -> Moments:
        """The moments of the differences pair by pair; ``products``: the exact sum of the products."""
        return Moments(self.count, self.total - other.total, self.squares - 2 * products + other.squares, self.count)

    @property
    def mean(self) -> float:
        """The mean, rounded once; raises ``ZeroDivisionError`` without a value."""
        return float(self.total / self.count)

    @property
    def standard_error(self) -> float:
        """``s / sqrt(n)`` with n - 1 degrees of freedom; raises ``ZeroDivisionError`` for fewer than two values."""
        n = self.count
        return root((n * self.squares - self.total**2) / (n * n * (n - 1)))

    @property
    def estimate(self) -> Estimate:
        """The mean of at least one value, with the interval ``mean -+ t s / sqrt(n)``; see ``mean``."""
        found = self._around(self.mean, self.standard_error if self.count > 1 else 0.0)
        return found if self.negative else _of_amounts(found, nothing=not self.squares)

    def ratio_error(self, others: Moments, products: Fraction) -> float:
        """Standard error of the ratio ``r`` of two paired means, by the delta method.

        The residuals ``values - r others`` have mean 0: ``s(residuals) / (sqrt(n) |mean(others)|)``. With sums S and
        sums of products Q, ``n (Qxx Sy^2 - 2 Sx Sy Qxy + Sx^2 Qyy) / (n - 1) / Sy^4`` is its square.
        """
        n, x, y = self.count, self.total, others.total
        residuals = self.squares * y * y - 2 * x * y * products + x * x * others.squares
        return root(n * residuals / ((n - 1) * y**4))

    def decrease(self, baseline: Moments, products: Fraction) -> Estimate | None:
        """``relative_decrease`` from exact moments and the exact sum of the products."""
        if baseline.total == 0:
            return None
        error = self.ratio_error(baseline, products) if self.count > 1 else 0.0
        return self._around(1.0 - float(self.total / baseline.total), error)

    def _around(self, value: float, error: float) -> Estimate:
        """``value`` with the half-width ``t error`` of n - 1 degrees of freedom."""
        if self.count < 2:
            return Estimate(value, None)
        half = float(stdtrit(self.count - 1, _UPPER)) * error
        return Estimate(value, (value - half, value + half))


def _of_amounts(found: Estimate, *, nothing: bool) -> Estimate:
    """The estimate where no value is below 0: its interval is not either, and there is none where all values are 0.

    Then nothing was seen of what may happen in other worlds: a bound of its share is that of ``rate``, a bound of the
    mean there is not.
    """
    if nothing or found.interval is None:
        return Estimate(found.value, None)
    return Estimate(found.value, (max(found.interval[0], 0.0), found.interval[1]))


def root(number: Fraction) -> float:
    """Square root of a fraction of any size, at least 0; no step of it overflows."""
    shift = (number.numerator.bit_length() - number.denominator.bit_length()) // 2
    return math.ldexp(math.sqrt(number / Fraction(4) ** shift), shift)


def rate(successes: int, count: int) -> Estimate:
    """Share ``p = successes / count`` with Wilson's score interval, which stays inside [0, 1].

    With z the normal quantile: centre ``(p + z^2/2n) / (1 + z^2/n)``, half-width
    ``z / (1 + z^2/n) sqrt(p (1 - p) / n + z^2/4n^2)``. Raises ``InvalidInput`` unless 0 <= successes <= count >= 1.
    """
    if not (count >= 1 and 0 <= successes <= count):
        raise InvalidInput(f"rate: {successes} of {count}: must be 0 <= successes <= count, and count at least 1")
    return Estimate(successes / count, wilson(successes / count, count))


def wilson(p: float, count: int) -> tuple[float, float]:
    """Wilson's score interval of a share ``p`` of ``count`` draws, which need not be a whole number of them."""
    z = float(ndtri(_UPPER))
    shrink = 1.0 + z * z / count
    centre = (p + z * z / (2.0 * count)) / shrink
    half = z / shrink * math.sqrt(p * (1.0 - p) / count + z * z / (4.0 * count * count))
    low = 0.0 if p == 0.0 else max(centre - half, 0.0)
    high = 1.0 if p == 1.0 else min(centre + half, 1.0)
    return low, high


def mean(values: Floats) -> Estimate:
    """Mean of ``values`` [n] with the interval ``mean -+ t s / sqrt(n)``; t with n - 1 degrees of freedom.

    At thousands of worlds the mean is normal whatever the harm's own distribution, and the interval equals the
    bootstrap's. Where no value is below 0 the interval ends at 0; where all are 0 there is none. Raises
    ``InvalidInput`` when ``values`` is empty or not finite.
    """
    return Moments.of(_check(values)).estimate


def paired_difference(values: Floats, baseline: Floats) -> Estimate:
    """Mean of ``values - baseline`` world by world, with the t interval of that mean."""
    data, reference, products = _check_pair(values, baseline)
    return data.minus(reference, products).estimate


def unpaired_difference(value: Estimate, n: int, baseline: Estimate, m: int) -> Estimate:
    """``value - baseline`` of two means over n and m worlds that are taken as independent, from their t intervals.

    With half-widths ``h = t_(n-1) s``, Welch: ``s^2 = s_1^2 + s_2^2``, and degrees of freedom
    ``s^4 / (s_1^4 / (n - 1) + s_2^4 / (m - 1))``. No interval where one of the two has none.
    """
    difference = value.value - baseline.value
    if value.interval is None or baseline.interval is None:
        return Estimate(difference, None)
    errors = [
        0.5 * (high - low) / float(stdtrit(size - 1, _UPPER))
        for (low, high), size in ((value.interval, n), (baseline.interval, m))
    ]
    shares = [error * error for error in errors]
    variance = sum(shares)
    if variance == 0.0:
        return Estimate(difference, (difference, difference))
    freedom = variance * variance / (shares[0] * shares[0] / (n - 1) + shares[1] * shares[1] / (m - 1))
    half = float(stdtrit(freedom, _UPPER)) * math.sqrt(variance)
    return Estimate(difference, (difference - half, difference + half))


def relative_decrease(values: Floats, baseline: Floats) -> Estimate | None:
    """``1 - mean(values) / mean(baseline)``, paired by world; None when the baseline's mean is 0.

    Interval by the delta method: with ``r`` the ratio of the means, the residuals ``values - r baseline`` have mean 0
    and the standard error of r is ``s_residual / (sqrt(n) mean(baseline))``.
    """
    data, reference, products = _check_pair(values, baseline)
    return data.decrease(reference, products)


def _check(values: ArrayLike, who: str = "statistics", each: str = "world") -> Floats:
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or len(data) < 1 or not np.isfinite(data).all():
        raise InvalidInput(f"{who}: shape {data.shape}; at least one finite number per {each} is needed, as [n]")
    return data


def _check_pair(values: Floats, baseline: Floats) -> tuple[Moments, Moments, Fraction]:
    """The moments of both, and the exact sum of their products."""
    data, reference = _check(values), _check(baseline)
    if data.shape != reference.shape:
        raise InvalidInput(f"statistics: {len(data)} values cannot be paired with {len(reference)} of the baseline")
    return Moments.of(data), Moments.of(reference), exact_sum(data, reference)


# Statistics over trainings: a figure per seed, and what they say about the next seed.
#
# Few seeds are the rule, and one bad one moves a mean a lot. The interquartile mean leaves out the best and the worst
# quarter; the bootstrap says how far it may be off, drawing seeds anew within each task (stratified), since tasks are
# chosen and not drawn.

RESAMPLES = 10_000  # of seeds
_RESAMPLES = 2_000  # of seeds and worlds
_CUT = 0.25
_AT_ONCE = 1 << 20  # drawn worlds in memory: 8 MB


def interquartile_mean(tasks: Sequence[ArrayLike], *, resamples: int = RESAMPLES, seed: int = 0) -> Estimate:
    """Mean of the middle half of all figures, with its stratified bootstrap interval (percentiles).

    ``tasks`` holds one list of figures, one per seed, for each task (scenario); floor(n / 4) of all n figures are left
    out at either end. The interval is None when no task has two seeds. Raises ``InvalidInput`` for a task without
    figures, or with one that is not finite.
    """
    from scipy.stats import bootstrap, trim_mean  # a second to load, and no table of an evaluation needs it

    strata = [_check(figures, f"interquartile_mean: task {k}", "seed") for k, figures in enumerate(tasks)]
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
        again, resample, n_resamples=resamples, confidence_level=CONFIDENCE, method="percentile", rng=seed,
        vectorized=True,
    )  # fmt: skip
    return Estimate(value, (float(found.confidence_interval.low), float(found.confidence_interval.high)))


def mean_over_seeds(values: ArrayLike, baseline: ArrayLike | None = None, *, seed: int = 0) -> Estimate:
    """Mean of ``values``, or of ``values - baseline`` on the same worlds, [seeds, worlds] each.

    Numbers of seeds may differ. The bootstrap interval draws the seeds of either side and the worlds, which both sides
    share, anew: an interval of differences that leaves out 0 holds for other seeds *and* other worlds. None with a
    single world, and where all values are 0 and have no baseline. That is no interval of truths that hold nearly
    always or never: draws of such worlds are all alike. So that of truths without a baseline reaches at least as far
    as Wilson's of their share over the worlds. Raises ``InvalidInput`` for arrays that cannot be paired or are not
    finite.
    """
    given = np.atleast_2d(np.asarray(values))
    sides = _pair_sides("mean_over_seeds", given, np.zeros((1, given.shape[-1])) if baseline is None else baseline)
    value = float((sides[0].mean(axis=0) - sides[1].mean(axis=0)).mean())
    found = _resampled(value, sides, lambda means: means[:, 0] - means[:, 1], seed)
    if baseline is not None or (given < 0).any():
        return found
    if given.dtype != np.bool_:
        return _of_amounts(found, nothing=not given.any())
    share = min(value, 1.0)  # a mean of ones may be rounded up
    low, high = wilson(share, given.shape[1])
    ends = found.interval or (low, high)
    return Estimate(share, (max(min(low, ends[0]), 0.0), min(max(high, ends[1]), 1.0)))


def share_over_seeds(values: ArrayLike, worst: ArrayLike, best: ArrayLike, *, seed: int = 0) -> Estimate | None:
    """``(mean(worst) - mean(values)) / (mean(worst) - mean(best))`` on the same worlds, [seeds, worlds] each.

    Which part of the way from ``worst`` to ``best`` the values are; the interval is as in ``mean_over_seeds``. None
    where ``best`` is not below ``worst``.
    """
    sides = _pair_sides("share_over_seeds", values, worst, best)
    reached, high, low = (float(side.mean(axis=0).mean()) for side in sides)
    if not high > low:
        return None

    def shares(means: Floats) -> Floats:
        means = means[means[:, 1] > means[:, 2]]
        share: Floats = (means[:, 1] - means[:, 0]) / (means[:, 1] - means[:, 2])
        return share

    return _resampled((high - reached) / (high - low), sides, shares, seed)


def _pair_sides(who: str, *sides: ArrayLike) -> tuple[Floats, ...]:
    """The sides as [seeds, worlds], all with the same worlds; raises ``InvalidInput``."""
    arrays = tuple(np.atleast_2d(np.asarray(given, np.float64)) for given in sides)
    if any(side.ndim != 2 or not side.size or side.shape[1] != arrays[0].shape[-1] for side in arrays):
        shapes = " and ".join(str(side.shape) for side in arrays)
        raise InvalidInput(f"{who}: shapes {shapes}: must be [seeds, worlds] with the same worlds")
    if not all(np.isfinite(side).all() for side in arrays):
        raise InvalidInput(f"{who}: every harm must be finite")
    return arrays


def _resampled(value: float, sides: Sequence[Floats], of: Callable[[Floats], Floats], seed: int) -> Estimate:
    """``value`` with the percentiles of what it is in means drawn anew; no interval with a single world."""
    if sides[0].shape[1] < 2:
        return Estimate(value, None)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(of(_resample_means(sides, _RESAMPLES, seed)), [tail, 100.0 - tail])
    return Estimate(value, (float(low), float(high)))


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
