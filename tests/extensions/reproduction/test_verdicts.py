"""Verdicts: a table by hand for numbers, one for statements, one for summaries."""

import numpy as np
import pytest

from ethbrake_marl.extensions.reproduction.verdicts import (
    PERCENT,
    Less,
    Verdict,
    chance,
    compare_number,
    judge_statement,
    summarise,
)
from ethbrake_marl.files.sheet import Estimate


def around(value: float, half: float) -> Estimate:
    return Estimate(value, (value - half, value + half))


@pytest.mark.parametrize(
    ("printed", "ours", "least", "outcome", "because"),
    [
        (10.0, around(10.1, 0.01), None, "agrees", "ours 10.10 [10.09, 10.11], printed 10.000"),
        (10.0, around(10.25, 0.01), None, "differs", "ours 10.25 [10.24, 10.26], printed 10.000 (+2.5 %)"),
        (10.0, around(10.25, 0.2), None, "agrees", None),  # chance 0.28
        (10.0, around(11.5, 1.3), None, "undecided", "too few worlds to tell"),  # chance 1.84, more than 15 % of 11.5
        (10.0, around(11.3, 1.0), None, "agrees", None),  # chance 1.41, 12.5 % of 11.3
        (10.0, around(12.0, 0.1), ("bound", around(11.0, 0.1)), "cannot agree", "bound: at least 11.00 [10.90, 11.10]"),
        (10.0, around(12.0, 0.1), ("bound", around(10.1, 0.1)), "differs", None),  # within the chance of the bound
    ],
)
def test_number__by_hand(printed, ours, least, outcome, because) -> None:
    verdict = compare_number("n", printed, ours, least=least)
    assert verdict.outcome == outcome and (because or "") in verdict.because


def test_number__that_differs_names_the_nearest_reading() -> None:
    others = {"far": around(20.0, 0.1), "near": around(9.9, 0.1), "nearer": around(9.5, 0.1)}
    assert compare_number("n", 10.0, around(12.0, 0.1), others=others).because.endswith(
        "(+20.0 %); nearest: near, 9.90 [9.80, 10.00], which agrees"
    )
    worse = compare_number("n", 10.0, around(12.0, 0.1), others={"far": around(20.0, 0.1)})
    assert worse.because.endswith("; no other reading here comes nearer")
    rate = compare_number("n", 0.8526, around(0.655, 0.01), show=PERCENT, others={"x": around(0.7, 0.001)})
    assert rate.because.startswith("ours 65.5 % [64.5, 66.5], printed 85.26 % (-23.2 %); nearest: x, 70.0 %")
    assert rate.because.endswith(", -17.9 %")


def test_chance__is_root_two_times_half_of_the_interval() -> None:
    assert chance(around(5.0, 1.0)) == pytest.approx(2.0**0.5)
    assert chance(Estimate(5.0, None)) == 0.0


A, OPEN, WRONG = (Less(name, around(value, 1.0)) for name, value in (("a", -3.0), ("b", -0.5), ("c", 2.0)))
TIE, ZERO = Less("z", Estimate(0.0, None), both_are_0=True), Less("e", around(0.0, 0.0))


@pytest.mark.parametrize(
    ("parts", "or_equal", "outcome", "because"),
    [
        ([A], False, "agrees", "a, -3.00 [-4.00, -2.00]"),
        ([A, Less("d", around(-5.0, 1.0))], False, "agrees", "holds in 2 of 2; the nearest is a, -3.00 [-4.00, -2.00]"),
        ([A, OPEN], False, "undecided", "holds in 1 of 2; not shown: b, -0.50 [-1.50, 0.50]"),
        ([A, WRONG], False, "differs", "holds in 1 of 2; not so: c, 2.00 [1.00, 3.00]"),
        ([OPEN, WRONG], False, "differs", "holds in 0 of 2; not so: b, -0.50 [-1.50, 0.50], c, 2.00 [1.00, 3.00]"),
        ([Less("f", Estimate(0.5, None))], False, "differs", "not so: f, 0.50"),
        ([A, TIE], False, "agrees", "holds in 1 of 1 (both are 0 in z); the nearest is a, -3.00 [-4.00, -2.00]"),
        ([TIE], False, "agrees", "nothing to undercut: both are 0 in z"),
        ([ZERO], True, "agrees", "e, 0.00 [0.00, 0.00]"),
        ([ZERO], False, "differs", "not so: e, 0.00 [0.00, 0.00]"),
    ],
)
def test_statement__by_hand(parts, or_equal, outcome, because) -> None:
    assert judge_statement("s", parts, or_equal=or_equal) == Verdict("s", outcome, because)


def test_less__is_paired_in_the_same_worlds() -> None:
    one, other = np.array([1.0, 2.0, 9.0]), np.array([2.0, 3.0, 10.0])
    assert Less.of_worlds("w", one, other).difference.ends == pytest.approx((-1.0, -1.0))
    low, high = Less.of_lists("w", one, other).difference.ends
    assert low < -1.0 < high and high > 5.0
    assert Less.of_worlds("w", one * 0.0, other * 0.0).both_are_0 and not Less.of_worlds("w", one, one).both_are_0


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        (["agrees"], ("agrees", "w0: b0")),
        (["agrees", "agrees"], ("agrees", "of 2 comparisons 2 agree; w0: b0")),
        (["agrees", "differs", "differs"], ("differs", "of 3 comparisons 2 differ, 1 agrees; w1: b1")),
        (["differs", "cannot agree"], ("cannot agree", "of 2 comparisons 1 cannot agree, 1 differs; w1: b1")),
        (
            ["agrees", "not run", "undecided"],
            ("undecided", "of 3 comparisons 1 undecided, 1 not run, 1 agrees; w2: b2"),
        ),
    ],
)
def test_summary__is_the_worst_and_counts(outcomes, expected) -> None:
    assert summarise([Verdict(f"w{k}", each, f"b{k}") for k, each in enumerate(outcomes)])[1:] == expected
