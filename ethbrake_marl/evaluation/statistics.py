"""Estimates with 95 % intervals, from one number per world.

The worlds of a list are independent draws, and every agent is measured on the same worlds. Rates have Wilson's score
interval, means have the t interval, and comparisons with a baseline are paired by world, so that the spread between
easy and hard worlds cancels. Means and their errors come from exact sums, so the order of the worlds does not change a
bit.

Worlds whose rows come from the same recording form a *cluster*: only clusters are independent of each other. Errors
then are cluster-robust with the factor G / (G - 1) for G clusters, and t has G - 1 degrees of freedom (Cameron and
Miller 2015, "A practitioner's guide to cluster-robust inference", Journal of Human Resources 50(2)).
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
from ethbrake_marl.physics.state import Bools, Floats, Ints

Texts = NDArray[np.str_]


def exact_sum(values: Floats, others: Floats | None = None) -> Fraction:
    """Return the exact sum of ``values`` [n], or of their products with ``others`` [n], without rounding.

    A float64 is a whole number of 53 bits times a power of two. The whole numbers of each power are added as Python
    integers, which never overflow. So neither the order of the worlds nor a division into parts changes a bit. By
    contrast, ``math.fsum`` rounds the sum of each part. Raises ``InvalidInput`` unless all numbers are finite.
    """
    wholes, powers = _in_wholes(values)
    if others is not None:
        factors, more = _in_wholes(others)
        wholes, powers = wholes * factors, powers + more
    sums = {power: int(wholes[powers == power].sum()) for power in np.unique(powers).tolist()}
    return sum((number * Fraction(2) ** power for power, number in sums.items()), Fraction())


def cluster_sums(values: Floats, clusters: Texts) -> dict[str, tuple[int, Fraction]]:
    """Return the number of ``values`` [n] and their exact sum for each name in ``clusters`` [n], by this name.

    Raises ``InvalidInput`` unless all values are finite, and there are as many clusters as values.
    """
    wholes, powers = _in_wholes(values)
    if clusters.shape != powers.shape:
        raise InvalidInput(f"statistics: {len(clusters)} clusters of {len(powers)} values; one for each is needed")
    names, which, counts = np.unique(clusters, return_inverse=True, return_counts=True)
    least, sums = powers.min(), np.zeros(len(names), np.object_)
    np.add.at(sums, which, wholes << (powers - least).astype(np.object_))
    unit = Fraction(2) ** int(least)
    return {name: (n, unit * total) for name, n, total in zip(names.tolist(), counts.tolist(), sums, strict=True)}


def _in_wholes(values: Floats) -> tuple[NDArray[np.object_], Ints]:
    """Return integers and powers of two, [n] each, such that ``values = integer * 2 ** power`` exactly."""
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or not np.isfinite(data).all():
        raise InvalidInput(f"exact sum: shape {data.shape}; finite numbers, as [n], are needed")
    fractions, powers = np.frexp(data)
    return np.ldexp(fractions, 53).astype(np.int64).astype(np.object_), powers.astype(np.int64) - 53


CONFIDENCE = 0.95

_UPPER = 0.5 + 0.5 * CONFIDENCE  # quantile at the upper end of an interval


@dataclass(frozen=True, slots=True)
class Moments:
    """Number, exact sum and exact sum of squares of some values; moments of parts can be added in any order.

    >>> import numpy as np
    >>> from ethbrake_marl.evaluation.statistics import Moments
    >>> Moments.of(np.array([0.1, 0.2])) + Moments.of(np.array([0.3])) == Moments.of(np.array([0.3, 0.1, 0.2]))
    True

    """

    count: int = 0  # number of values
    total: Fraction = Fraction()  # sum of the values
    squares: Fraction = Fraction()  # sum of their squares
    # Number of negative values. If it is 0, intervals do not reach below 0. For differences (``minus``), whose signs
    # are not known, it is the number of all values.
    negative: int = field(default=0, compare=False)
    # Number and exact sum of the values of each cluster, by its name; empty: all values are independent.
    clusters: Mapping[str, tuple[int, Fraction]] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Floats, clusters: Texts | None = None) -> Moments:
        """Return the moments (number, sum and sum of squares) of ``values`` [n].

        ``clusters``: name of the cluster of each value, [n]; None: all values are independent. Raises ``InvalidInput``
        unless all values are finite.
        """
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
        """Return the moments of the differences ``value - other``, paired by world.

        ``products`` is the exact sum over all pairs of ``value * other`` (``exact_sum``).
        """
        clusters = {name: (n, total - other.clusters[name][1]) for name, (n, total) in self.clusters.items()}
        squares = self.squares - 2 * products + other.squares
        return Moments(self.count, self.total - other.total, squares, self.count, clusters)

    @property
    def independent(self) -> int:
        """Number of independent draws: of the clusters if there are any, else of the values."""
        return len(self.clusters) or self.count

    @property
    def mean(self) -> float:
        """Mean of the values: exact, then rounded to a float; raises ``ZeroDivisionError`` without values."""
        return float(self.total / self.count)

    @property
    def standard_error(self) -> float:
        """Standard error of the mean, ``s / sqrt(n)`` with n - 1 degrees of freedom.

        With G clusters, ``sqrt(G / (G - 1) * sum(sum of deviations in the cluster ** 2)) / n``. Raises
        ``ZeroDivisionError`` for fewer than two values or clusters.
        """
        n = self.count
        if self.clusters:
            ones = Moments(n, Fraction(n), clusters={name: (k, Fraction(k)) for name, (k, _) in self.clusters.items()})
            return self.ratio_error(ones, Fraction())
        return root((n * self.squares - self.total**2) / (n * n * (n - 1)))

    @property
    def estimate(self) -> Estimate:
        """Mean with the interval ``mean -+ t s / sqrt(n)``, as the function ``mean`` returns it.

        Raises ``ZeroDivisionError`` without values.
        """
        estimate = self._around(self.mean, self.standard_error if self.independent > 1 else 0.0)
        return estimate if self.negative else of_amounts(estimate, nothing=not self.squares)

    @property
    def share(self) -> Estimate:
        """Mean of values that are 0 or 1, with Wilson's interval (``rate``).

        With clusters it is the interval of as many independent draws as would have this standard error,
        ``1 + p (1 - p) / error ** 2``, but at most all and, where all values agree, one for each cluster; times
        ``(z / t) ** 2``, because the error has G - 1 degrees of freedom (Korn and Graubard 1998, "Confidence intervals
        for proportions with small expected number of positive counts estimated from survey data", Survey Methodology
        24). There is no interval for a single cluster.
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
        """Return the standard error of ``r = mean(values) / mean(others)``, paired by world, by the delta method.

        The residuals ``values - r * others`` have mean 0, so the error is
        ``std(residuals) / (sqrt(n) * abs(mean(others)))``. With x the values, y the others, sums S and sums of products
        Q, its square is ``n * (Qxx Sy^2 - 2 Sx Sy Qxy + Sx^2 Qyy) / ((n - 1) * Sy^4)``. With clusters, their sums take
        the place of the values.

        Args:
            others: moments of the denominator, in the same worlds.
            products: exact sum over all pairs of ``value * other``.

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
        """Return ``1 - mean(values) / mean(baseline)`` with its interval; None if the baseline's mean is 0.

        Args:
            baseline: moments of the baseline, in the same worlds.
            products: exact sum over all pairs of ``value * baseline``.

        """
        if baseline.total == 0:
            return None
        error = self.ratio_error(baseline, products) if self.independent > 1 else 0.0
        return self._around(1.0 - float(self.total / baseline.total), error)

    def _around(self, value: float, error: float) -> Estimate:
        """Return the estimate ``value`` with the interval ``value -+ t error``; no interval for a single draw.

        ``error`` is the standard error; t has one degree of freedom less than there are independent draws.
        """
        if self.independent < 2:
            return Estimate(value, None)
        half = float(stdtrit(self.independent - 1, _UPPER)) * error
        return Estimate(value, (value - half, value + half))


def of_amounts(estimate: Estimate, *, nothing: bool) -> Estimate:
    """Return an estimate of a mean of non-negative values, with its interval cut off below 0.

    Args:
        estimate: the estimate with the usual interval.
        nothing: whether all values are 0. Then there is no interval, because such a sample bounds the share of worlds
            with other values (see ``rate``), but not their mean.

    """
    if nothing or estimate.interval is None:
        return Estimate(estimate.value, None)
    return Estimate(estimate.value, (max(estimate.interval[0], 0.0), estimate.interval[1]))


def root(number: Fraction) -> float:
    """Return the square root of ``number`` >= 0 as a float, even if ``number`` itself is too large for a float."""
    shift = (number.numerator.bit_length() - number.denominator.bit_length()) // 2
    return math.ldexp(math.sqrt(number / Fraction(4) ** shift), shift)


def rate(successes: int, count: int) -> Estimate:
    """Return the share ``p = successes / count`` with Wilson's score interval, which stays inside [0, 1].

    With z the normal quantile: centre ``(p + z^2/2n) / (1 + z^2/n)``, half-width
    ``z / (1 + z^2/n) sqrt(p (1 - p) / n + z^2/4n^2)``. Raises ``InvalidInput`` unless 0 <= successes <= count >= 1.
    """
    if not (count >= 1 and 0 <= successes <= count):
        raise InvalidInput(f"rate: {successes} of {count}: must be 0 <= successes <= count, and count at least 1")
    return Estimate(successes / count, wilson(successes / count, count))


def wilson(p: float, count: float) -> tuple[float, float]:
    """Return the ends (low, high) of Wilson's 95 % score interval of a share.

    Args:
        p: observed share, 0 to 1; ``p * count`` need not be a whole number.
        count: number of independent draws, not necessarily whole.

    """
    z = float(ndtri(_UPPER))
    shrink = 1.0 + z * z / count
    centre = (p + z * z / (2.0 * count)) / shrink
    half = z / shrink * math.sqrt(p * (1.0 - p) / count + z * z / (4.0 * count * count))
    low = 0.0 if p == 0.0 else max(centre - half, 0.0)
    high = 1.0 if p == 1.0 else min(centre + half, 1.0)
    return low, high


def mean(values: Floats, clusters: Texts | None = None) -> Estimate:
    """Return the mean of ``values`` [n] with the interval ``mean -+ t s / sqrt(n)``; t has n - 1 degrees of freedom.

    With thousands of worlds, the mean is nearly normal whatever the distribution of harm, and the interval equals the
    bootstrap's. If no value is negative, the interval starts at 0 or above; if all are 0, there is no interval.
    ``clusters``: name of the cluster of each value, [n]; None: all are independent. Raises ``InvalidInput`` when
    ``values`` is empty or not finite.
    """
    return Moments.of(check(values), clusters).estimate


def share_of(truths: Bools, clusters: Texts | None = None) -> Estimate:
    """Return the share of ``truths`` [n] that are true, with the interval of ``Moments.share``.

    ``clusters``: name of the cluster of each value, [n]; None: all are independent.
    """
    return Moments.of(check(truths), clusters).share


def paired_difference(values: Floats, baseline: Floats, clusters: Texts | None = None) -> Estimate:
    """Return the mean of ``values - baseline`` with its t interval.

    ``values`` and ``baseline`` are [n] each, in the same worlds, as are ``clusters``, the name of each world's cluster;
    None: all worlds are independent. Raises ``InvalidInput`` if their lengths differ, or if they are empty or not
    finite.
    """
    data, reference, products = _check_pair(values, baseline, clusters)
    return data.minus(reference, products).estimate


def unpaired_difference(value: Estimate, n: int, baseline: Estimate, m: int) -> Estimate:
    """Return ``value - baseline`` of two means over n and m independent worlds, with Welch's interval.

    The half-width of each mean's t interval, divided by its t quantile, is its standard error (``s1``, ``s2``). The
    difference has the standard error ``s = sqrt(s1^2 + s2^2)``, with ``s^4 / (s1^4 / (n - 1) + s2^4 / (m - 1))``
    degrees of freedom. There is no interval if one of the two means has none.

    Args:
        value: first mean with its interval.
        n: number of its worlds, or of the clusters of worlds that its interval is by.
        baseline: second mean with its interval.
        m: number of its worlds or clusters.

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
    """Return ``1 - mean(values) / mean(baseline)`` of two arrays [n] in the same worlds, with its interval.

    ``clusters``: name of the cluster of each world, [n]; None: all worlds are independent.

    Returns None if the baseline's mean is 0. Interval by the delta method: with ``r`` the ratio of the means, the
    residuals ``values - r baseline`` have mean 0 and the standard error of r is
    ``s_residual / (sqrt(n) mean(baseline))``.
    """
    data, reference, products = _check_pair(values, baseline, clusters)
    return data.decrease(reference, products)


def check(values: ArrayLike, who: str = "statistics", each: str = "world") -> Floats:
    """Return ``values`` as a float array [n]; raise ``InvalidInput`` unless it is one-dimensional, not empty, finite.

    Args:
        values: the numbers.
        who: name of the caller, for the message.
        each: what each number belongs to, for the message: ``world`` or ``seed``.

    """
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or len(data) < 1 or not np.isfinite(data).all():
        raise InvalidInput(f"{who}: shape {data.shape}; at least one finite number per {each} is needed, as [n]")
    return data


def _check_pair(values: Floats, baseline: Floats, clusters: Texts | None) -> tuple[Moments, Moments, Fraction]:
    """Return the moments of ``values`` and of ``baseline``, and the exact sum of their products."""
    data, reference = check(values), check(baseline)
    if data.shape != reference.shape:
        raise InvalidInput(f"statistics: {len(data)} values cannot be paired with {len(reference)} of the baseline")
    return Moments.of(data, clusters), Moments.of(reference, clusters), exact_sum(data, reference)
