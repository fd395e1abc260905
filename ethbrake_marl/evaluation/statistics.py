"""Estimates with 95 % intervals, from one number per world.

The worlds of a list are independent draws, and every agent is measured on the same ones: rates get Wilson's score
interval (of a sharded list the exact one), means the t interval of the mean, and comparisons with a baseline are paired
by world, so that the spread between easy and hard worlds cancels. Means and their errors come from exact sums
(``evaluation.exact``): the order of the worlds changes no bit of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv, ndtri, stdtrit

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Estimate as Estimate
from ethbrake_marl.files.sheet import estimates_to_json as estimates_to_json
from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled

# Exact sums of float64: whole numbers, so that no order of the worlds, and no division into parts, changes a bit.
#
# A float64 is a whole multiple of 2^-1074, a product of two of them one of 2^-2148. A sum of such multiples is kept as
# a
# whole number: compiled as limbs of 32 bits (Kulisch's long accumulator), between calls as a Python integer. Means and
# standard errors are then quotients and roots of whole numbers, each rounded once.

VALUE_BITS = 1074  # a value is a multiple of 2^-1074
PRODUCT_BITS = 2 * VALUE_BITS
_LIMBS = 138  # of 32 bits: products reach from 2^-2148 to 2^2048; the rest is for carries and the sign
_MOST = 1 << 28  # products of one call: each adds less than 2^35 to a limb of 63 bits
_LOW, _FRACTION, _HALF = 0xFFFFFFFF, (1 << 52) - 1, (1 << 26) - 1


@compiled
def add_whole(limbs: Ints, number: int, place: int, sign: int) -> None:
    """Add ``sign * number * 2^place`` to the limbs; 0 <= number < 2^62."""
    limb, bit = place >> 5, place & 31
    low, high = (number & _LOW) << bit, (number >> 32) << bit
    limbs[limb] += sign * (low & _LOW)
    limbs[limb + 1] += sign * ((low >> 32) + (high & _LOW))
    limbs[limb + 2] += sign * (high >> 32)


@compiled
def mantissa_and_place(bits: int) -> tuple[int, int]:
    """``m`` and ``p`` of a float64, given as its bits: ``|value| = m 2^(p - 1074)``, m < 2^53."""
    exponent, fraction = (bits >> 52) & 0x7FF, bits & _FRACTION
    if exponent == 0:
        return fraction, 0
    return fraction | (1 << 52), exponent - 1


@compiled
def carry(limbs: Ints) -> None:
    """Bring every limb but the last to 0 .. 2^32 - 1; the last one keeps the sign."""
    for j in range(limbs.shape[0] - 1):
        over = limbs[j] >> 32
        limbs[j] -= over << 32
        limbs[j + 1] += over


@compiled
def sum_values(bits: Ints, limbs: Ints) -> None:
    """Add all values, given as their bits [n], in units of 2^-1074."""
    for k in range(bits.shape[0]):
        m, place = mantissa_and_place(bits[k])
        add_whole(limbs, m, place, -1 if bits[k] < 0 else 1)
    carry(limbs)


@compiled
def sum_products(one: Ints, other: Ints, limbs: Ints) -> None:
    """Add all products of two values, given as their bits [n], in units of 2^-2148: halves of 27 and 26 bits."""
    for k in range(one.shape[0]):
        m, place = mantissa_and_place(one[k])
        m2, place2 = mantissa_and_place(other[k])
        high, low, high2, low2 = m >> 26, m & _HALF, m2 >> 26, m2 & _HALF
        sign, at = (-1 if (one[k] < 0) != (other[k] < 0) else 1), place + place2
        add_whole(limbs, high * high2, at + 52, sign)
        add_whole(limbs, high * low2 + low * high2, at + 26, sign)
        add_whole(limbs, low * low2, at, sign)
    carry(limbs)


def exact_sum(values: Floats) -> int:
    """Sum of ``values`` [n] as a multiple of 2^-1074; raises ``InvalidInput`` for what is not finite."""
    limbs = np.zeros(_LIMBS, np.int64)
    sum_values(_bits(values), limbs)
    return _whole(limbs)


def exact_products(values: Floats, others: Floats) -> int:
    """Sum of the products of ``values`` and ``others`` [n] as a multiple of 2^-2148; raises as ``exact_sum``."""
    limbs = np.zeros(_LIMBS, np.int64)
    sum_products(_bits(values), _bits(others), limbs)
    return _whole(limbs)


def _bits(values: Floats) -> Ints:
    data = np.ascontiguousarray(values, np.float64)
    if data.ndim != 1 or len(data) > _MOST or not np.isfinite(data).all():
        raise InvalidInput(f"exact sum: shape {data.shape}; finite numbers, as [n], at most {_MOST:,}, are needed")
    return data.view(np.int64)


def _whole(limbs: Ints) -> int:
    """The whole number in limbs that have been carried."""
    low = int.from_bytes(limbs[:-1].astype("<u4").tobytes(), "little")
    return low + (int(limbs[-1]) << (32 * (len(limbs) - 1)))


@dataclass(frozen=True, slots=True)
class Moments:
    """Number, sum and sum of squares of some values, exact: they are added in any order.

    >>> import numpy as np
    >>> from ethbrake_marl.evaluation.statistics import moments
    >>> moments(np.array([0.1, 0.2])) + moments(np.array([0.3])) == moments(np.array([0.3, 0.1, 0.2]))
    True

    """

    count: int = 0
    total: int = 0  # multiple of 2^-1074
    squares: int = 0  # multiple of 2^-2148

    def __add__(self, other: Moments) -> Moments:
        return Moments(self.count + other.count, self.total + other.total, self.squares + other.squares)

    @property
    def mean(self) -> float:
        """The mean, rounded once; raises ``ZeroDivisionError`` without a value."""
        return self.total / (self.count << VALUE_BITS)

    @property
    def standard_error(self) -> float:
        """``s / sqrt(n)`` with n - 1 degrees of freedom; raises ``ZeroDivisionError`` for fewer than two values."""
        n = self.count
        return root(n * self.squares - self.total**2, (n * n * (n - 1)) << PRODUCT_BITS)


def moments(values: Floats) -> Moments:
    """Those of ``values`` [n]; raises as ``exact_sum``."""
    return Moments(len(values), exact_sum(values), exact_products(values, values))


def difference(values: Moments, others: Moments, products: int) -> Moments:
    """The moments of ``values - others`` pair by pair, from those of both and the exact sum of their products."""
    return Moments(values.count, values.total - others.total, values.squares - 2 * products + others.squares)


def ratio_error(values: Moments, others: Moments, products: int) -> float:
    """Standard error of the ratio ``r`` of two paired means, by the delta method.

    The residuals ``values - r others`` have mean 0: ``s(residuals) / (sqrt(n) |mean(others)|)``. With sums S and sums
    of products Q, ``n (Qxx Sy^2 - 2 Sx Sy Qxy + Sx^2 Qyy) / (n - 1) / Sy^4`` is its square.
    """
    n, x, y = values.count, values.total, others.total
    residuals = values.squares * y * y - 2 * x * y * products + x * x * others.squares
    return root(n * residuals, (n - 1) * y**4)


def root(above: int, below: int) -> float:
    """``sqrt(above / below)`` of whole numbers of any size, ``above >= 0``; no step of it overflows."""
    shift = (above.bit_length() - below.bit_length()) // 2
    quotient = (above << max(-2 * shift, 0)) / (below << max(2 * shift, 0))
    return math.ldexp(math.sqrt(quotient), shift)


CONFIDENCE = 0.95


def rate(successes: int, count: int, *, confidence: float = CONFIDENCE) -> Estimate:
    """Share ``p = successes / count`` with Wilson's score interval, which stays inside [0, 1].

    With z the normal quantile: centre ``(p + z^2/2n) / (1 + z^2/n)``, half-width
    ``z / (1 + z^2/n) sqrt(p (1 - p) / n + z^2/4n^2)``. Raises ``InvalidInput`` unless 0 <= successes <= count >= 1.
    """
    _check_rate(successes, count)
    p = successes / count
    return Estimate(p, wilson(p, count, confidence=confidence))


def exact_rate(successes: int, count: int, *, confidence: float = CONFIDENCE) -> Estimate:
    """Share ``successes / count`` with the exact (Clopper-Pearson) interval, which covers at least ``confidence``.

    Its ends are the shares at which so many successes or more, or so few or fewer, have probability
    ``(1 - confidence) / 2``: quantiles of the beta distribution. Raises ``InvalidInput`` as ``rate``.
    """
    _check_rate(successes, count)
    k, n, tail = successes, count, 0.5 - 0.5 * confidence
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1.0 - tail))
    return Estimate(k / n, (low, high))


def _check_rate(successes: int, count: int) -> None:
    if not (count >= 1 and 0 <= successes <= count):
        raise InvalidInput(f"rate: {successes} of {count}: must be 0 <= successes <= count, and count at least 1")


def wilson(p: float, count: int, *, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Wilson's score interval of a share ``p`` of ``count`` draws, which need not be a whole number of them."""
    z = _normal_quantile(confidence)
    shrink = 1.0 + z * z / count
    centre = (p + z * z / (2.0 * count)) / shrink
    half = z / shrink * math.sqrt(p * (1.0 - p) / count + z * z / (4.0 * count * count))
    low = 0.0 if p == 0.0 else max(centre - half, 0.0)
    high = 1.0 if p == 1.0 else min(centre + half, 1.0)
    return low, high


def mean(values: Floats, *, confidence: float = CONFIDENCE) -> Estimate:
    """Mean of ``values`` [n] with the interval ``mean -+ t s / sqrt(n)``; t with n - 1 degrees of freedom.

    At thousands of worlds the mean is normal whatever the harm's own distribution, and the interval equals the
    bootstrap's. Raises ``InvalidInput`` when ``values`` is empty or not finite.
    """
    return mean_of(moments(_check(values)), confidence=confidence)


def mean_of(found: Moments, *, confidence: float = CONFIDENCE) -> Estimate:
    """``mean`` of at least one value, from exact moments."""
    return _around(found.mean, found.standard_error if found.count > 1 else 0.0, found.count, confidence)


def paired_difference(values: Floats, baseline: Floats, *, confidence: float = CONFIDENCE) -> Estimate:
    """Mean of ``values - baseline`` world by world, with the t interval of that mean."""
    data, reference = _check_pair(values, baseline)
    products = exact_products(data, reference)
    return mean_of(difference(moments(data), moments(reference), products), confidence=confidence)


def unpaired_difference(value: Estimate, n: int, baseline: Estimate, m: int) -> Estimate:
    """``value - baseline`` of two means over n and m worlds that are taken as independent, from their t intervals.

    With half-widths ``h = t_(n-1) s``, Welch: ``s^2 = s_1^2 + s_2^2``, and degrees of freedom
    ``s^4 / (s_1^4 / (n - 1) + s_2^4 / (m - 1))``. No interval where one of the two has none.
    """
    difference = value.value - baseline.value
    if value.interval is None or baseline.interval is None:
        return Estimate(difference, None)
    errors = [
        0.5 * (high - low) / float(stdtrit(size - 1, 0.5 + 0.5 * CONFIDENCE))
        for (low, high), size in ((value.interval, n), (baseline.interval, m))
    ]
    shares = [error * error for error in errors]
    variance = sum(shares)
    if variance == 0.0:
        return Estimate(difference, (difference, difference))
    freedom = variance * variance / (shares[0] * shares[0] / (n - 1) + shares[1] * shares[1] / (m - 1))
    half = float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE)) * math.sqrt(variance)
    return Estimate(difference, (difference - half, difference + half))


def relative_decrease(values: Floats, baseline: Floats, *, confidence: float = CONFIDENCE) -> Estimate | None:
    """``1 - mean(values) / mean(baseline)``, paired by world; None when the baseline's mean is 0.

    Interval by the delta method: with ``r`` the ratio of the means, the residuals ``values - r baseline`` have mean 0
    and the standard error of r is ``s_residual / (sqrt(n) mean(baseline))``.
    """
    data, reference = _check_pair(values, baseline)
    return decrease_of(moments(data), moments(reference), exact_products(data, reference), confidence=confidence)


def decrease_of(
    values: Moments, baseline: Moments, products: int, *, confidence: float = CONFIDENCE
) -> Estimate | None:
    """``relative_decrease`` from exact moments and the exact sum of the products."""
    if baseline.total == 0:
        return None
    error = ratio_error(values, baseline, products) if values.count > 1 else 0.0
    return _around(1.0 - values.total / baseline.total, error, values.count, confidence)


def _around(value: float, error: float, n: int, confidence: float) -> Estimate:
    """``value`` with the half-width ``t error`` of n - 1 degrees of freedom."""
    if n < 2:
        return Estimate(value, None)
    half = float(stdtrit(n - 1, 0.5 + 0.5 * confidence)) * error
    return Estimate(value, (value - half, value + half))


def _normal_quantile(confidence: float) -> float:
    return float(ndtri(0.5 + 0.5 * confidence))


def _check(values: Floats) -> Floats:
    data = np.asarray(values, np.float64)
    if data.ndim != 1 or len(data) < 1 or not np.isfinite(data).all():
        raise InvalidInput(f"statistics: shape {data.shape}; at least one finite number per world is needed, as [n]")
    return data


def _check_pair(values: Floats, baseline: Floats) -> tuple[Floats, Floats]:
    data, reference = _check(values), _check(baseline)
    if data.shape != reference.shape:
        raise InvalidInput(f"statistics: {len(data)} values cannot be paired with {len(reference)} of the baseline")
    return data, reference
