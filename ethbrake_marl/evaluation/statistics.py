"""Estimates with 95 % intervals, from one number per world.

The worlds of a list are independent draws, and every agent is measured on the same ones: rates get Wilson's score
interval (of a sharded list the exact one), means the t interval of the mean, and comparisons with a baseline are paired
by world, so that the spread between easy and hard worlds cancels. Means and their errors come from exact sums
(``evaluation.exact``): the order of the worlds changes no bit of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import betaincinv, ndtri, stdtrit

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.exact import Moments, difference, exact_products, moments, ratio_error
from ethbrake_marl.physics import Floats

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and its interval; the interval is None where the data cannot give one (a single world)."""

    value: float
    interval: tuple[float, float] | None

    def in_words(self, *, digits: int = 2, scale: float = 1.0, unit: str = "") -> str:
        """``24.19 [23.85, 24.53]``: value and interval, each times ``scale``."""
        value = f"{scale * self.value:z.{digits}f}{unit}"
        if self.interval is None:
            return value
        low, high = (f"{scale * end:z.{digits}f}" for end in self.interval)
        return f"{value} [{low}, {high}]"

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON: ``value``, and ``interval`` as ``[low, high]`` or null."""
        return {"value": self.value, "interval": None if self.interval is None else list(self.interval)}


def estimates_to_json(estimates: Mapping[str, Estimate | None]) -> dict[str, Any]:
    """Estimates by name as plain data, side by side: ``{name: value, name_interval: [low, high]}``.

    What does not exist is null.
    """
    found: dict[str, Any] = {}
    for name, estimate in estimates.items():
        told = {"value": None, "interval": None} if estimate is None else estimate.to_json()
        found |= {name: told["value"], f"{name}_interval": told["interval"]}
    return found


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
