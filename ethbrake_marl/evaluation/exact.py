"""Exact sums of float64: whole numbers, so that no order of the worlds, and no division into parts, changes a bit.

A float64 is a whole multiple of 2^-1074, a product of two of them one of 2^-2148. A sum of such multiples is kept as a
whole number: compiled as limbs of 32 bits (Kulisch's long accumulator), between calls as a Python integer. Means and
standard errors are then quotients and roots of whole numbers, each rounded once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.physics.compiled import compiled

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
    >>> from ethbrake_marl.evaluation.exact import moments
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
