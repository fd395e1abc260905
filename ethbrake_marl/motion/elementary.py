"""Exponential, logarithm, normal quantile and a hash, from operations that have the same bits on all machines.

The C library and numpy choose an implementation by the processor, and the last bits differ. Each error bound in this
file is the largest error, rounded up, in a comparison with values of 40 digits.
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.layout import Floats

PER_LN2 = 1.4426950408889634
_LN2_HIGH = 0.693147180369123816490  # its last 32 bits are 0, so its product with a whole number below 2^32 is exact
_LN2_LOW = 1.90821492927058770002e-10
_SQRT_HALF = 0.7071067811865476
_PER_SQRT_2PI = 0.3989422804014327
_LARGEST_EXPONENT = 709.782712893384  # e to this power, or more, overflows a double
_LEAST_EXPONENT = -708.0  # below this exp returns 0 instead of a number under 3e-308
_EXP = tuple(1.0 / math.factorial(k) for k in range(13, -1, -1))  # Taylor's series, highest power first
_LOG = tuple(2.0 / k for k in range(25, 1, -2))  # series of 2 artanh(s) / s - 2 in s^2, highest power first

# x = q (sqrt(2 pi) + q^2 P(q^2)) for q = p - 1/2 up to 1/4; else x = C - t N(t) / Q(t) - r for r = sqrt(-2 ln p): one
# set for t = r - 1.65 up to r = 4, one for t = r - 4 up to 10.3. Fitted to quantiles of 60 digits at Chebyshev nodes.
_SQRT_2PI = 2.5066282746310005
_SQRT_2PI_LOW = -1.8328579980459168e-16
_CENTRE = (
    *(18944880.09719004886, -2601371.67573968287, 693994.2277388069859, 43161.61138466289868, 22235.96413435671455),
    *(5825.684752120609166, 1690.927397560813073, 496.2580620421304563, 149.8299419042506391, 47.03578667872906836),
    *(15.66760896558029334, 5.772533538609159947, 2.624934990953737101),
)
_NEAR_N = (
    *(6.1185316165014996e-7, 0.00008261143491068899677, 0.002322868125000261793, 0.02490544383476077933),
    *(0.1311039275523617481, 0.3712863146520682371, 0.5402166937189504813, 0.3135851649710710218),
)
_NEAR_Q = (
    *(6.147238663971861779e-7, 0.0000873801370475760379, 0.002763799911765273603, 0.03519014821667497178),
    *(0.2297472124395027504, 0.8540322507157666525, 1.833041457545810481, 2.108039519865067479, 1.0),
)
_FAR_N = (
    *(7.698177493540387221e-10, 2.577566285595523487e-7, 0.00001747840342402818464, 0.0004218995970155167333),
    *(0.004540379350103703873, 0.02472412625213424433, 0.0718366187418152831, 0.09339620476270569954),
)
_FAR_Q = (
    *(1.285585017040169419e-9, 4.476251633827289854e-7, 0.00003350272214316739949, 0.000953171528510754796),
    *(0.0129777876898960319, 0.09549439826703192372, 0.4028001940673617521, 0.951490915339779628, 1.0),
)
_NEAR, _NEAR_C = 1.65, 0.9953300906244928
_FAR, _FAR_C = 4.0, 0.5988073438553344
_LEAST_PROBABILITY = 1e-22  # scenarios draw no smaller probability: 2^-53 times the least mass of a normal
_FRACTIONS = 150  # terms of the continued fraction: for x >= 2 its remainder is below 1e-17


@kernel
def _polynomial(coefficients: tuple[float, ...], x: float) -> float:
    """Polynomial with ``coefficients``, highest power first, by Horner's rule."""
    total = 0.0
    for coefficient in coefficients:
        total = total * x + coefficient
    return total


@kernel
def exp_rest(x: float, k: int) -> float:
    """``e^x / 2^k`` for the whole number k nearest to ``x / ln 2``.

    The result is the Taylor series of ``e^y`` up to ``y^13``, with ``y = x - k ln 2``, so ``|y| <= ln(2) / 2``. The
    relative error of truncating the series is 5e-18.
    """
    return _polynomial(_EXP, (x - k * _LN2_HIGH) - k * _LN2_LOW)


@kernel
def exp(x: float) -> float:
    """``e^x`` within 1.5 ulp, as ``2^k e^(x - k ln 2)``; infinite above 709.78, 0 below -708."""
    if not x < _LARGEST_EXPONENT:
        return np.inf if x >= _LARGEST_EXPONENT else np.nan
    if x < _LEAST_EXPONENT:
        return 0.0
    k = math.floor(x * PER_LN2 + 0.5)
    return math.ldexp(exp_rest(x, k), k)


@kernel
def _log_parts(x: float) -> tuple[float, float]:
    """Two numbers whose sum is ``ln x``, for a finite x > 0; the pair is more accurate than a single number.

    With ``x = 2^k m`` and m between ``sqrt(1/2)`` and ``sqrt(2)``, the first number is k times the leading bits of
    ``ln 2``; this product is exact. The second number is the rest of ``k ln 2``, plus the series of
    ``ln m = 2 artanh((m - 1) / (m + 1))``.
    """
    m, k = math.frexp(x)
    if m < _SQRT_HALF:
        m, k = 2.0 * m, k - 1
    f = m - 1.0
    s = f / (2.0 + f)
    half = 0.5 * f * f
    z = s * s
    return k * _LN2_HIGH, f - (half - (s * (half + z * _polynomial(_LOG, z)) + k * _LN2_LOW))


@kernel
def log(x: float) -> float:
    """``ln x`` within 1 ulp, for a finite x > 0."""
    leading_part, rest = _log_parts(x)
    return leading_part + rest


@kernel
def normal_quantile(p: float) -> float:
    """Number below which a standard normal variable lies with probability p, within 1.5 ulp.

    p is clipped to [1e-22, 1 - 1e-22]. For p outside [1/4, 3/4], ``r = sqrt(-2 ln min(p, 1 - p))`` is computed as the
    sum of two numbers; the first has 24 bits, so its square is exact.
    """
    q = p - 0.5
    if abs(q) <= 0.25:
        w = q * q
        return q * (_SQRT_2PI + (w * _polynomial(_CENTRE, w) + _SQRT_2PI_LOW))
    leading_part, rest = _log_parts(max(p if q < 0.0 else 1.0 - p, _LEAST_PROBABILITY))
    square = -2.0 * (leading_part + rest)
    root = math.sqrt(square)
    head = np.float64(np.float32(root))
    tail = ((-2.0 * leading_part - head * head) - 2.0 * rest) / (head + root)
    r = head + tail
    if r <= _FAR:
        t = r - _NEAR
        x = head - (_NEAR_C - (t * (_polynomial(_NEAR_N, t) / _polynomial(_NEAR_Q, t)) + tail))
    else:
        t = r - _FAR
        x = head - (_FAR_C - (t * (_polynomial(_FAR_N, t) / _polynomial(_FAR_Q, t)) + tail))
    return -x if q < 0.0 else x


@kernel
def normal_probability(x: float) -> float:
    """Probability that a standard normal variable is below x; the relative error is at most 1e-13 for x > -30.

    Let phi be the standard normal density. For ``0 <= x <= 2`` the probability of a value above x is ``1/2 - phi(x) (x
    + x^3 / 3 + x^5 / 15 + ...)``, and for larger x it is the continued fraction ``phi(x) / (x + 1 / (x + 2 / (x +
    ...)))``. For ``x < 0`` the result is the probability of a value above -x.
    """
    a = abs(x)
    density = _PER_SQRT_2PI * exp(-0.5 * a * a)
    if a <= 2.0:
        total, term, k = 0.0, a, 3
        while total + term > total:
            total += term
            term *= a * a / k
            k += 2
        rest = 0.5 - density * total
    else:
        fraction = a
        for k in range(_FRACTIONS, 0, -1):
            fraction = a + k / fraction
        rest = density / fraction
    return rest if x < 0.0 else 1.0 - rest


@large
def _write_results(values, function_number, out):
    for i in range(len(out)):
        out[i] = (
            exp(values[i])
            if function_number == 0
            else log(values[i])
            if function_number == 1
            else normal_quantile(values[i])
        )


def _results_of(values: Floats, function_number: int) -> Floats:
    out = np.empty(values.size)
    _write_results(np.array(values).ravel(), function_number, out)
    return out.reshape(values.shape)


def exp_each(values: Floats) -> Floats:
    """``exp`` of every value, in the same shape."""
    return _results_of(values, 0)


def log_each(values: Floats) -> Floats:
    """``log`` of every value, in the same shape."""
    return _results_of(values, 1)


def normal_quantile_each(values: Floats) -> Floats:
    """``normal_quantile`` of every value, in the same shape."""
    return _results_of(values, 2)


def logistic(values: Floats) -> Floats:
    """``1 / (1 + e^-x)`` of every value x, in the same shape."""
    return 1.0 / (1.0 + exp_each(-values))


@kernel
def hash_number(key, a, b):
    """Number in [0, 1) that depends on three numbers, each a whole number of 0 or more: a SplitMix64 hash.

    ``key`` is below 2^53.
    """
    z = np.uint64(key) ^ (np.uint64(a + 1) * np.uint64(0x9E3779B97F4A7C15))
    z ^= np.uint64(b + 1.0) * np.uint64(0xD1342543DE82EF95)
    for _ in range(2):
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return float(z >> np.uint64(11)) * 2.0**-53
