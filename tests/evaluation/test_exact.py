"""Exact sums: no order and no division into parts changes a bit, and what is told is rounded once."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import PRODUCT_BITS, VALUE_BITS, Moments, exact_sum, root

FINITE = st.floats(allow_nan=False, allow_infinity=False)
TABLES = st.lists(st.tuples(FINITE, FINITE), max_size=30)
EXTREMES = [0.0, -0.0, 5e-324, -5e-324, 2.2250738585072014e-308, 1.7976931348623157e308, -1.7976931348623157e308, 1.0]


def fractions_of(values) -> list[Fraction]:
    return [Fraction(float(value)) for value in values]


@given(TABLES)
def test_sums__are_those_of_fractions(rows) -> None:
    x, y = (np.array(column, np.float64) for column in (zip(*rows, strict=True) if rows else ([], [])))
    assert Fraction(exact_sum(x), 1 << VALUE_BITS) == sum(fractions_of(x))
    products = sum((a * b for a, b in zip(fractions_of(x), fractions_of(y), strict=True)), Fraction(0))
    assert Fraction(exact_sum(x, y), 1 << PRODUCT_BITS) == products


def test_sums__of_the_largest_and_the_smallest_numbers() -> None:
    x = np.array([a for a in EXTREMES for _ in EXTREMES])
    y = np.array([b for _ in EXTREMES for b in EXTREMES])
    expected = sum(Fraction(a) * Fraction(b) for a in EXTREMES for b in EXTREMES)
    assert Fraction(exact_sum(x, y), 1 << PRODUCT_BITS) == expected
    many = np.full(100_000, -1.7976931348623157e308)
    assert exact_sum(many) == 100_000 * exact_sum(many[:1])
    assert exact_sum(many, many) == 100_000 * exact_sum(many[:1], many[:1])


def test_moments__of_parts_in_any_order_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(3)
    values = rng.exponential(20.0, 10_000) * (rng.random(10_000) < 0.6)
    whole = Moments.of(values)
    for parts in (1, 2, 7, 100):
        pieces = [Moments.of(part) for part in np.array_split(rng.permutation(values), parts)]
        assert sum(pieces, Moments()) == whole
    assert whole.mean == float(sum(fractions_of(values)) / 10_000)
    assert whole.standard_error == pytest.approx(values.std(ddof=1) / 100.0, rel=1e-12)


def test_difference_and_ratio__are_those_of_the_pairs() -> None:
    rng = np.random.default_rng(4)
    x, y = rng.integers(0, 50, (2, 500)).astype(float) / 8.0  # of whose differences none is rounded
    both = exact_sum(x, y)
    assert Moments.of(x).minus(Moments.of(y), both) == Moments.of(x - y)
    residual = x - x.mean() / y.mean() * y
    expected = residual.std(ddof=1) / math.sqrt(500) / y.mean()
    assert Moments.of(x).ratio_error(Moments.of(y), both) == pytest.approx(expected, rel=1e-10)


def test_equal_values__have_no_error() -> None:
    assert Moments.of(np.full(7, 0.1)).standard_error == 0.0
    assert Moments.of(np.full(7, 0.1)).mean == 0.1


def test_root__of_what_no_float_holds() -> None:
    assert root(10**800, 10**200) == pytest.approx(1e300)
    assert root(0, 3) == 0.0


@pytest.mark.parametrize("bad", [[math.nan], [math.inf], [[1.0]]])
def test_what_is_no_finite_number__is_refused(bad) -> None:
    with pytest.raises(InvalidInput, match="exact sum"):
        exact_sum(np.array(bad))
