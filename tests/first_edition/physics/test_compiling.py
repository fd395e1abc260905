"""How kernels are compiled, the elementary functions that they share, and work in parts on threads."""

import math
import threading

import mpmath
import numba
import numpy as np
import pytest
from scipy.special import ndtri

from ethbrake_marl.first_edition.physics.elementary import (
    exp,
    exp_each,
    log,
    normal_probability,
    normal_quantile,
    normal_quantile_each,
)
from ethbrake_marl.first_edition.physics.jit import by_parts, compiled as compile_kernel

# ---------------------------------------------------------------- compilation

needs_compiler = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="compilation is switched off")


@needs_compiler
@pytest.mark.parametrize(
    ("way", "more"),
    [
        ({}, {"forceinline": True}),
        ({"apart": True}, {"forceinline": False}),
        ({"within": True}, {"inline": "always"}),
        ({"bare": True}, {"forceinline": True, "_nrt": False}),
        ({"apart": True, "bare": True}, {"forceinline": False, "_nrt": False}),
    ],
)
def test_compiled__is_strict_releases_the_lock_and_divides_by_zero_as_ieee_does(way, more):
    options = {"nopython": True, "boundscheck": None, "fastmath": False, "nogil": True, "error_model": "numpy", **more}
    kernel = compile_kernel(**way)(lambda x: 1.0 / x)
    assert kernel.targetoptions == options and kernel(0.0) == float("inf")


# ---------------------------------------------------------------- elementary functions, against 40 digits

mpmath.mp.dps = 40


def true_quantile(p):
    """By Newton's method on the logarithm of the probability, from a quantile of 16 digits."""
    x = mpmath.mpf(float(ndtri(float(p))))
    for _ in range(3):
        below = mpmath.erfc(-x / mpmath.sqrt(2)) / 2
        x -= (mpmath.log(below) - mpmath.log(p)) * below / mpmath.npdf(x)
    return x


def grid(low, high, n):
    return np.random.default_rng(0).uniform(low, high, n)


QUANTILES = {f"quantile of 1e{high}": 10.0 ** grid(low, high, 80) for low, high in
             [(-0.7, -0.01), (-4, -0.7), (-11, -3.5), (-22, -11)]}  # fmt: skip


@pytest.mark.parametrize(
    ("found", "wanted", "values", "ulps"),
    [
        (exp, mpmath.exp, [*grid(-20, 20, 1500), *grid(-1e-3, 1e-3, 200), *grid(-700, 700, 500)], 1.5),
        (log, mpmath.log, [*grid(0.5, 2.0, 1500), *10.0 ** grid(-22, 22, 1500), 5e-324, 1.7e308], 1.0),
        *((normal_quantile, true_quantile, values, 1.5) for values in QUANTILES.values()),
        *(
            (lambda q: -normal_quantile(q), lambda q: true_quantile(1 - q), 1.0 - values[values > 1e-15], 1.5)
            for values in QUANTILES.values()
        ),
    ],
    ids=["exp", "log", *QUANTILES, *(f"upper {name}" for name in QUANTILES)],
)
def test_function__is_within_the_bound_of_its_docstring(found, wanted, values, ulps):
    for value in values:
        true = wanted(mpmath.mpf(value))
        error = abs((mpmath.mpf(found(float(value))) - true) / mpmath.mpf(math.ulp(float(true))))
        assert error < ulps, value


def test_normal_quantile__has_no_step_at_its_seams():
    for seam in (0.25, 0.75, math.exp(-8.0), 1.0 - math.exp(-8.0)):
        p = seam + np.arange(-50, 51) * math.ulp(seam)
        assert (np.diff(normal_quantile_each(p)) > -4.0 * np.spacing(1.0)).all()


def test_normal_probability__is_within_its_bound():
    for x in [*grid(-30, 6, 500), 1.0, -1.0, 0.0]:
        true = mpmath.ncdf(mpmath.mpf(float(x)))
        assert abs(normal_probability(float(x)) - true) <= 1e-13 * true


def test_arrays__have_the_bits_of_single_numbers():
    values = grid(0.0, 1.0, 1500)
    assert exp_each(values).tolist() == [exp(float(v)) for v in values]
    assert normal_quantile_each(values).tolist() == [normal_quantile(float(v)) for v in values]


# ---------------------------------------------------------------- threads


def test_by_parts__covers_every_row_once_in_order_on_that_many_threads() -> None:
    meet = threading.Barrier(3, timeout=120.0)  # passed only if three threads run at once

    def work(part: slice) -> tuple[slice, int]:
        meet.wait()
        return part, threading.get_ident()

    parts = by_parts(work, 10, 3)
    assert [row for part, _ in parts for row in range(10)[part]] == list(range(10))
    assert len({ident for _, ident in parts}) == 3 and parts[0][1] == threading.get_ident()
    assert by_parts(lambda part: part, 2, 5) == [slice(0, 1), slice(1, 2)]  # no part is empty


def test_by_parts__raises_the_first_error_after_all_have_ended() -> None:
    ended = []

    def work(part: slice) -> None:
        ended.append(part.start)
        raise ArithmeticError(str(part.start))

    with pytest.raises(ArithmeticError, match=r"^0$"):
        by_parts(work, 4, 4)
    assert sorted(ended) == [0, 1, 2, 3]


def test_elementary_functions__have_their_limits() -> None:
    assert exp(0.0) == 1.0
    assert log(1.0) == 0.0
    assert normal_quantile(0.5) == 0.0
    assert normal_probability(0.0) == 0.5
    assert (exp(710.0), exp(-746.0)) == (math.inf, 0.0)
    assert math.isnan(exp(math.nan))
    assert normal_quantile(0.0) == normal_quantile(1e-22) == -normal_quantile(1.0)
