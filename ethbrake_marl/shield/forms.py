"""Affine forms: numbers that depend on where in a box a world lies, with a bound on what is not linear in it.

A form [W] of a box with K uncertain numbers, W = K + 2, stands for ``c + g_1 e_1 + ... + g_K e_K + r e``: the centre,
one slope for each uncertain number, and a remainder. ``e_k`` in [-1, 1] says where in the box the world lies, the same
in every form; ``e`` in [-1, 1] is any, another one in every form. What two forms share in ``e_k`` cancels when they are
subtracted, which plain intervals cannot do.

Each operation encloses: for every world of the box there are values of ``e`` for which the result stands for what the
operation makes of the operands. Rounding is not part of an operation; ``shield.enclosure`` adds it (``ROUNDING``).
"""

from __future__ import annotations

import math

import numpy as np

from ethbrake_marl.physics import Floats
from ethbrake_marl.physics.compiled import compiled_apart


@compiled_apart
def radius(x: Floats) -> float:
    """Largest distance from the centre."""
    whole: float = x[-1]
    for k in range(1, x.shape[0] - 1):
        whole += abs(x[k])
    return whole


@compiled_apart
def low(x: Floats) -> float:
    """Least value."""
    least: float = x[0] - radius(x)
    return least


@compiled_apart
def high(x: Floats) -> float:
    """Largest value."""
    most: float = x[0] + radius(x)
    return most


@compiled_apart
def add(out: Floats, share: float, x: Floats) -> None:
    """``out += share * x``; exact but for rounding."""
    for k in range(x.shape[0] - 1):
        out[k] += share * x[k]
    out[-1] += abs(share) * x[-1]


@compiled_apart
def difference(x: Floats, y: Floats) -> Floats:
    """``x - y``."""
    out = x.copy()
    add(out, -1.0, y)
    return out


@compiled_apart
def negative(x: Floats) -> Floats:
    """``-x``."""
    return linear(x, -1.0, 0.0, 0.0)


@compiled_apart
def between(least: float, most: float, width: int) -> Floats:
    """The form [width] of any number in an interval."""
    out = np.zeros(width)
    out[0], out[-1] = 0.5 * (least + most), 0.5 * (most - least)
    return out


@compiled_apart
def product(x: Floats, y: Floats) -> Floats:
    """``x * y``: what is of second order goes to the remainder."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = x[0] * y[k] + y[0] * x[k]
    out[0] = x[0] * y[0]
    out[-1] = abs(x[0]) * y[-1] + abs(y[0]) * x[-1] + radius(x) * radius(y)
    return out


@compiled_apart
def square(x: Floats) -> Floats:
    """``x * x``: its part of second order is at least 0, which halves the remainder."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = 2.0 * x[0] * x[k]
    half = 0.5 * radius(x) * radius(x)
    out[0] = x[0] * x[0] + half
    out[-1] = 2.0 * abs(x[0]) * x[-1] + half
    return out


@compiled_apart
def linear(x: Floats, slope: float, start: float, error: float) -> Floats:
    """``start + slope * x``, and an error of at most ``error`` on either side."""
    out = np.empty_like(x)
    for k in range(x.shape[0] - 1):
        out[k] = slope * x[k]
    out[0] += start
    out[-1] = abs(slope) * x[-1] + error
    return out


@compiled_apart
def square_root(x: Floats) -> Floats:
    """Square root wherever ``x >= 0``; nothing is said where it is below. ``high(x) >= 0``.

    On [a, b] the root lies between its chord, of slope 1 / (sqrt a + sqrt b), and the parallel tangent.
    """
    least, most = math.sqrt(max(low(x), 0.0)), math.sqrt(high(x))
    if most <= 0.0:
        return np.zeros_like(x)
    slope = 1.0 / (least + most)
    start = least - slope * least * least
    error = 0.5 * (0.25 / slope - start)
    return linear(x, slope, start + error, error)


@compiled_apart
def reciprocal(x: Floats) -> Floats:
    """``1 / x`` for ``low(x) > 0``: between the chord, of slope -1 / (a b), and the parallel tangent."""
    least, most = low(x), high(x)
    slope = -1.0 / (least * most)
    chord = 1.0 / least + 1.0 / most
    error = 0.5 * (chord - 2.0 / math.sqrt(least * most))
    return linear(x, slope, chord - error, error)


@compiled_apart
def positive_part(x: Floats) -> Floats:
    """``max(x, 0)``: between its chord and the parallel line through 0."""
    least, most = low(x), high(x)
    if least >= 0.0:
        return x.copy()
    if most <= 0.0:
        return np.zeros_like(x)
    slope = most / (most - least)
    error = -0.5 * slope * least
    return linear(x, slope, error, error)


@compiled_apart
def cut(x: Floats, least: float, most: float) -> Floats:
    """A form of the same number, known to lie in an interval: that interval where it says more than the form."""
    inside_low, inside_high = max(low(x), least), min(high(x), most)
    if inside_high - inside_low < radius(x):
        return between(min(inside_low, inside_high), max(inside_low, inside_high), x.shape[0])
    return x
