"""The elementary functions against 40 digits; each bound is the one that its docstring states."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from scipy.special import ndtri

from ethbrake_marl.physics.compiling import (
    exp,
    exp_each,
    log,
    normal_probability,
    normal_quantile,
    normal_quantile_each,
)

mpmath.mp.dps = 40


def worst_ulps(found, wanted, values):
    """The largest error in units of the last place of the true value."""
    errors = []
    for value in values:
        true = wanted(mpmath.mpf(value))
        errors.append(abs(float((mpmath.mpf(found(float(value))) - true) / mpmath.mpf(math.ulp(float(true))))))
    return max(errors)


def true_quantile(p):
    """By Newton's method on the logarithm of the probability, from a quantile of 16 digits."""
    x = mpmath.mpf(float(ndtri(float(p))))
    for _ in range(3):
        below = mpmath.erfc(-x / mpmath.sqrt(2)) / 2
        x -= (mpmath.log(below) - mpmath.log(p)) * below / mpmath.npdf(x)
    return x


def grid(low, high, n=1500):
    return np.random.default_rng(0).uniform(low, high, n)


def test_exp__is_within_its_bound():
    assert worst_ulps(exp, mpmath.exp, [*grid(-20, 20), *grid(-1e-3, 1e-3, 200), *grid(-700, 700, 500)]) < 1.5


def test_log__is_within_its_bound():
    assert worst_ulps(log, mpmath.log, [*grid(0.5, 2.0), *10.0 ** grid(-22, 22), 5e-324, 1.7e308]) < 1.0


@pytest.mark.parametrize(("low", "high"), [(-0.7, -0.01), (-4, -0.7), (-11, -3.5), (-22, -11)])
def test_normal_quantile__is_within_its_bound_on_both_sides(low, high):
    p = 10.0 ** grid(low, high, 200)
    assert worst_ulps(normal_quantile, true_quantile, p) < 1.5
    upper = 1.0 - p[p > 1e-15]
    assert worst_ulps(lambda q: -normal_quantile(q), lambda q: true_quantile(1 - q), upper) < 1.5


def test_normal_quantile__has_no_step_at_its_seams():
    for seam in (0.25, 0.75, math.exp(-8.0), 1.0 - math.exp(-8.0)):
        p = seam + np.arange(-50, 51) * math.ulp(seam)
        assert (np.diff(normal_quantile_each(p)) > -4.0 * np.spacing(1.0)).all()


def test_normal_probability__is_within_its_bound():
    for x in [*grid(-30, 6), 1.0, -1.0, 0.0]:
        true = mpmath.ncdf(mpmath.mpf(float(x)))
        assert abs(normal_probability(float(x)) - true) <= 1e-13 * true


def test_ends__are_what_they_are_in_the_limit():
    assert (exp(0.0), log(1.0), normal_quantile(0.5), normal_probability(0.0)) == (1.0, 0.0, 0.0, 0.5)
    assert (exp(710.0), exp(-746.0)) == (math.inf, 0.0)
    assert math.isnan(exp(math.nan))
    assert normal_quantile(0.0) == normal_quantile(1e-22) == -normal_quantile(1.0)


def test_arrays__have_the_bits_of_single_numbers():
    values = grid(0.0, 1.0)
    assert exp_each(values).tolist() == [exp(float(v)) for v in values]
    assert normal_quantile_each(values).tolist() == [normal_quantile(float(v)) for v in values]
