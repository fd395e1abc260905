"""Means and rates with 95 % intervals, from one number per world.

The worlds of an evaluation list are independent draws, and every agent drives the same worlds. Rates have Wilson's
score interval, means have the t interval. Comparisons with a baseline are paired by world, which removes the spread
between easy and hard worlds. Sums are exact, so results do not depend on the order of the worlds.

Worlds that come from the same recording form a *cluster*, and only clusters are independent of each other. If worlds
have clusters, standard errors are cluster-robust with the factor G / (G - 1) for G clusters, and t has G - 1 degrees of
freedom (Cameron and Miller 2015, "A practitioner's guide to cluster-robust inference", Journal of Human Resources
50(2)).

Arguments that several functions share: ``values``, ``baseline`` and ``others`` have one number per world, [n], for the
same worlds in the same order. ``clusters`` has the name of each world's cluster, [n]; None: all worlds are independent.
In the methods of ``Moments``, ``other``, ``others`` and ``baseline`` are the ``Moments`` of such numbers, and
``products`` is the exact sum over all worlds of ``value * other`` or ``value * baseline`` (``exact_sum``). ``mean``,
``share_of``, ``paired_difference`` and ``relative_decrease`` raise ``InvalidInput`` if an array is empty or not finite,
or if the arrays have different lengths.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri, stdtrit

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints

Texts = NDArray[np.str_]


def exact_sum(values: Floats, others: Floats | None = None) -> Fraction:
    """Return the exact sum of ``values``, or of the products ``values * others``.

    Each float64 is a whole number of at most 53 bits times a power of two. Whole numbers that belong to the same power
    of two are added as Python integers, which never overflow. Raises ``InvalidInput`` unless all numbers are finite.
    """
    wholes, powers = _in_wholes(values)
    if others is not None:
        factors, more = _in_wholes(others)
        wholes, powers = wholes * factors, powers + more
    sums = {power: int(wholes[powers == power].sum()) for power in np.unique(powers).tolist()}
    return sum((number * Fraction(2) ** power for power, number in sums.items()), Fraction())


def cluster_sums(values: Floats, clusters: Texts) -> dict[str, tuple[int, Fraction]]:
    """Return a dictionary: name of a cluster -> number of values in the cluster, and exact sum of these values.

    Raises ``InvalidInput`` if a value is not finite, or if the arrays have different lengths.
    """
    wholes, powers = _in_wholes(values)
    if clusters.shape != powers.shape:
        raise InvalidInput(
            f"statistics: clusters has {len(clusters)} entries, but there are {len(powers)} values; must have one entry"
            " per value"
        )
    names, which, counts = np.unique(clusters, return_inverse=True, return_counts=True)
    least, sums = powers.min(), np.zeros(len(names), np.object_)
    np.add.at(sums, which, wholes << (powers - least).astype(np.object_))
    unit = Fraction(2) ** int(least)
    return {name: (n, unit * total) for name, n, total in zip(names.tolist(), counts.tolist(), sums, strict=True)}


def _in_wholes(values: Floats) -> tuple[NDArray[np.object_], Ints]:
    """Return integers [n] and exponents [n] such that ``values == integers * 2 ** exponents`` exactly."""
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or not np.isfinite(data).all():
        raise InvalidInput(f"exact sum: values has shape {data.shape}; must have finite numbers of shape [n]")
    fractions, powers = np.frexp(data)
    return np.ldexp(fractions, 53).astype(np.int64).astype(np.object_), powers.astype(np.int64) - 53


CONFIDENCE = 0.95

_UPPER = 0.5 + 0.5 * CONFIDENCE  # quantile at the upper end of an interval


@dataclass(frozen=True, slots=True)
class Moments:
    """Number n, exact sum and exact sum of squares of some values. ``a + b`` describes the values of both.

    >>> import numpy as np
    >>> from ethbrake_marl.first_edition.evaluation.statistics import Moments
    >>> Moments.of(np.array([0.1, 0.2])) + Moments.of(np.array([0.3])) == Moments.of(np.array([0.3, 0.1, 0.2]))
    True

    """

    count: int = 0  # number of values
    total: Fraction = Fraction()  # sum of the values
    squares: Fraction = Fraction()  # sum of the squared values
    # Number of negative values; 0: intervals do not extend below 0. For differences (``minus``), whose signs are not
    # known, the number of all values.
    negative: int = field(default=0, compare=False)
    # Result of ``cluster_sums``; empty: all values are independent.
    clusters: Mapping[str, tuple[int, Fraction]] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Floats, clusters: Texts | None = None) -> Moments:
        """Return the moments of ``values``; raise ``InvalidInput`` if a value is not finite."""
        negative, sums = int(np.count_nonzero(values < 0.0)), {} if clusters is None else cluster_sums(values, clusters)
        return cls(len(values), exact_sum(values), exact_sum(values, values), negative, sums)

    def __add__(self, other: Moments) -> Moments:
        negative, clusters = self.negative + other.negative, dict(self.clusters)
        for name, (n, total) in other.clusters.items():
            before = clusters.get(name, (0, Fraction()))
            clusters[name] = before[0] + n, before[1] + total
        total, squares = self.total + other.total, self.squares + other.squares
        return Moments(self.count + other.count, total, squares, negative, clusters)

    def minus(self, other: Moments, products: Fraction) -> Moments:
        """Return the moments of the differences ``value - other``, paired by world."""
        clusters = {name: (n, total - other.clusters[name][1]) for name, (n, total) in self.clusters.items()}
        squares = self.squares - 2 * products + other.squares
        return Moments(self.count, self.total - other.total, squares, self.count, clusters)

    @property
    def independent(self) -> int:
        """Number of independent draws: the number of clusters or, without clusters, the number of values."""
        return len(self.clusters) or self.count

    @property
    def mean(self) -> float:
        """Mean, computed exactly and then rounded; raises ``ZeroDivisionError`` if there are no values."""
        return float(self.total / self.count)

    @property
    def standard_error(self) -> float:
        """Standard error of the mean, ``s / sqrt(n)``, where s is the standard deviation with n - 1 degrees of freedom.

        With G clusters, the standard error is ``sqrt(G / (G - 1) * sum of D_g ** 2) / n``, where D_g is the sum of the
        deviations from the mean in cluster g. Raises ``ZeroDivisionError`` for fewer than two values or clusters.
        """
        n = self.count
        if self.clusters:
            ones = Moments(n, Fraction(n), clusters={name: (k, Fraction(k)) for name, (k, _) in self.clusters.items()})
            return self.ratio_error(ones, Fraction())
        return root((n * self.squares - self.total**2) / (n * n * (n - 1)))

    @property
    def estimate(self) -> Estimate:
        """Mean with its t interval (function ``mean``); raises ``ZeroDivisionError`` if there are no values."""
        estimate = self._around(self.mean, self.standard_error if self.independent > 1 else 0.0)
        return estimate if self.negative else of_amounts(estimate, nothing=not self.squares)

    @property
    def share(self) -> Estimate:
        """Mean p of values that are all 0 or 1, with Wilson's interval (``rate``).

        With G clusters, Wilson's interval is computed as for ``1 + p (1 - p) / error ** 2`` independent draws, which
        would have the same standard error ``error``. This effective number is at most the number of values, and is G if
        all values are equal. It is multiplied by ``(z / t) ** 2``, where z and t are the quantiles of the normal and
        the t distribution, because the standard error has G - 1 degrees of freedom (Korn and Graubard 1998, "Confidence
        intervals for proportions with small expected number of positive counts estimated from survey data", Survey
        Methodology 24). With one cluster there is no interval.
        """
        if not self.clusters:
            return rate(int(self.total), self.count)
        p, clusters = self.mean, len(self.clusters)
        if clusters < 2:
            return Estimate(p, None)
        draws = (
            clusters if p in (0.0, 1.0) else min(self.count, 1.0 + p * (1.0 - p) / max(self.standard_error, 1e-99) ** 2)
        )
        return Estimate(p, wilson(p, draws * float(ndtri(_UPPER) / stdtrit(clusters - 1, _UPPER)) ** 2))

    def ratio_error(self, others: Moments, products: Fraction) -> float:
        """Return the standard error (delta method) of ``r = mean(values) / mean(others)``, paired by world.

        The residuals ``values - r * others`` have mean 0, and so the standard error of r is
        ``std(residuals) / (sqrt(n) * abs(mean(others)))``. The square of this standard error is
        ``n * (Qxx Sy^2 - 2 Sx Sy Qxy + Sx^2 Qyy) / ((n - 1) * Sy^4)``, where x are the ``values``, y are the
        ``others``, Sx and Sy are their sums, and Qxx, Qxy and Qyy are the sums of ``x^2``, ``x y`` and ``y^2``. With
        clusters, n is the number of clusters, and x and y are the sums of ``values`` and ``others`` in each cluster.
        """
        n, x, y, xx, yy = self.independent, self.total, others.total, self.squares, others.squares
        if self.clusters:
            sums = [(total, others.clusters[name][1]) for name, (_, total) in self.clusters.items()]
            xx, products, yy = (
                sum((sides[a] * sides[b] for sides in sums), Fraction()) for a, b in ((0, 0), (0, 1), (1, 1))
            )
        residuals = xx * y * y - 2 * x * y * products + x * x * yy
        return root(n * residuals / ((n - 1) * y**4))

    def decrease(self, baseline: Moments, products: Fraction) -> Estimate | None:
        """Return ``1 - mean(values) / mean(baseline)``, paired by world; None if the mean of ``baseline`` is 0."""
        if baseline.total == 0:
            return None
        error = self.ratio_error(baseline, products) if self.independent > 1 else 0.0
        return self._around(1.0 - float(self.total / baseline.total), error)

    def _around(self, value: float, error: float) -> Estimate:
        """Return ``value`` with the interval ``value -+ t * error``, where ``error`` is the standard error.

        With n independent draws, t has n - 1 degrees of freedom; with one draw there is no interval.
        """
        if self.independent < 2:
            return Estimate(value, None)
        half = float(stdtrit(self.independent - 1, _UPPER)) * error
        return Estimate(value, (value - half, value + half))


def of_amounts(estimate: Estimate, *, nothing: bool) -> Estimate:
    """Return the mean of non-negative values, ``estimate``, with its interval cut off at 0.

    ``nothing`` says that all values are 0. The result then has no interval, because zeros show that larger values are
    rare, but not how large such values can be.
    """
    if nothing or estimate.interval is None:
        return Estimate(estimate.value, None)
    return Estimate(estimate.value, (max(estimate.interval[0], 0.0), estimate.interval[1]))


def root(number: Fraction) -> float:
    """Return the square root of ``number`` (at least 0), even if ``number`` is too large for a float."""
    shift = (number.numerator.bit_length() - number.denominator.bit_length()) // 2
    return math.ldexp(math.sqrt(number / Fraction(4) ** shift), shift)


def rate(successes: int, count: int) -> Estimate:
    """Return the share ``p = successes / count`` with Wilson's score interval, which lies within [0, 1].

    The interval has the centre ``(p + z^2 / (2 n)) / (1 + z^2 / n)`` and the half-width
    ``z * sqrt(p (1 - p) / n + z^2 / (4 n^2)) / (1 + z^2 / n)``, where n is ``count``, and z the quantile of the normal
    distribution. Raises ``InvalidInput`` unless 0 <= successes <= count and count >= 1.
    """
    if not (count >= 1 and 0 <= successes <= count):
        raise InvalidInput(
            f"rate: successes = {successes}, count = {count}: must be 0 <= successes <= count, and count at least 1"
        )
    return Estimate(successes / count, wilson(successes / count, count))


def wilson(p: float, count: float) -> tuple[float, float]:
    """Return the ends (low, high) of Wilson's 95 % score interval of the observed share ``p``, 0 to 1.

    ``count`` is the number of independent draws. Neither ``count`` nor ``p * count`` needs to be a whole number.
    """
    z = float(ndtri(_UPPER))
    shrink = 1.0 + z * z / count
    centre = (p + z * z / (2.0 * count)) / shrink
    half = z / shrink * math.sqrt(p * (1.0 - p) / count + z * z / (4.0 * count * count))
    low = 0.0 if p == 0.0 else max(centre - half, 0.0)
    high = 1.0 if p == 1.0 else min(centre + half, 1.0)
    return low, high


def mean(values: Floats, clusters: Texts | None = None) -> Estimate:
    """Return the mean of n values with its 95 % t interval, ``mean -+ t * s / sqrt(n)``.

    In the formula, s is the standard deviation, and t the quantile of the t distribution with n - 1 degrees of freedom.
    The interval assumes that the mean is normally distributed, which is nearly true for thousands of worlds. If no
    value is negative, the interval does not extend below 0. If all values are 0, there is no interval.
    """
    return Moments.of(check(values), clusters).estimate


def share_of(truths: Bools, clusters: Texts | None = None) -> Estimate:
    """Return the fraction of worlds in which ``truths`` [n] is true, with Wilson's interval (``Moments.share``)."""
    return Moments.of(check(truths), clusters).share


def paired_difference(values: Floats, baseline: Floats, clusters: Texts | None = None) -> Estimate:
    """Return the mean of ``values - baseline`` with its t interval."""
    data, reference, products = _check_pair(values, baseline, clusters)
    return data.minus(reference, products).estimate


def unpaired_difference(value: Estimate, n: int, baseline: Estimate, m: int) -> Estimate:
    """Return the difference ``value - baseline`` of two means over n and m independent worlds, with Welch's interval.

    The standard errors s1 and s2 of the two means are computed from their t intervals: each standard error is half of
    the interval's width, divided by the quantile of the t distribution. The difference has the standard error
    ``s = sqrt(s1^2 + s2^2)``, with ``s^4 / (s1^4 / (n - 1) + s2^4 / (m - 1))`` degrees of freedom. If one of the two
    means has no interval, the difference has no interval either. With clusters, n and m are the numbers of clusters.
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


def relative_decrease(values: Floats, baseline: Floats, clusters: Texts | None = None) -> Estimate | None:
    """Return ``1 - mean(values) / mean(baseline)`` with its interval by the delta method (``Moments.ratio_error``).

    The result is None if the mean of ``baseline`` is 0.
    """
    data, reference, products = _check_pair(values, baseline, clusters)
    return data.decrease(reference, products)


def check(values: ArrayLike, who: str = "statistics", each: str = "world") -> Floats:
    """Return ``values`` as an array of floats, [n]; raise ``InvalidInput`` unless they are one or more finite numbers.

    The error message names the calling function ``who``, and what each number belongs to (``each``: world or seed).
    """
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or len(data) < 1 or not np.isfinite(data).all():
        raise InvalidInput(
            f"{who}: values has shape {data.shape}; must have one finite number per {each}: shape [n] with n >= 1"
        )
    return data


def _check_pair(values: Floats, baseline: Floats, clusters: Texts | None) -> tuple[Moments, Moments, Fraction]:
    """Return the moments of ``values`` and of ``baseline``, and the exact sum of the products ``value * baseline``."""
    data, reference = check(values), check(baseline)
    if data.shape != reference.shape:
        raise InvalidInput(
            f"statistics: there are {len(data)} values, but {len(reference)} values of the baseline; the two numbers"
            " must be equal"
        )
    return Moments.of(data, clusters), Moments.of(reference, clusters), exact_sum(data, reference)
