"""Verdicts follow from the numbers: planted numbers that agree, differ, and cannot agree."""

from __future__ import annotations

import pytest

from ethbrake_marl.evaluation.statistics import rate
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.studies.reproduction import (
    PERCENT,
    Less,
    Verdict,
    compare_number,
    judge_statement,
    summarise_verdicts,
)


def around(value: float, half: float) -> Estimate:
    return Estimate(value, (value - half, value + half))


def test_compare_number__agrees_within_the_chance_of_two_lists() -> None:
    ours = around(10.0, 1.0)  # two lists may be sqrt 2 apart
    assert compare_number("harm", 11.4, ours).outcome == "agrees"
    assert compare_number("harm", 11.5, ours).outcome == "differs"
    assert compare_number("harm", 8.6, ours).outcome == "agrees"


def test_compare_number__wide_chance_shows_nothing() -> None:
    few = around(10.0, 2.0)  # chance 2.8
    verdict = compare_number("harm", 11.4, few)
    assert (verdict.outcome, verdict.because[-24:]) == ("undecided", ": too few worlds to tell")
    assert compare_number("harm", 10.1, few).outcome == "agrees"  # within the tolerance all the same
    assert compare_number("harm", 13.0, few).outcome == "differs"


def test_compare_number__agrees_within_the_tolerance_of_the_printed_number() -> None:
    ours = around(0.945, 0.001)
    assert compare_number("rate", 0.95, ours).outcome == "agrees"
    assert compare_number("rate", 0.97, ours).outcome == "differs"


def test_compare_number__names_the_nearest_other_reading() -> None:
    verdict = compare_number(
        "harm", 33.6, around(24.2, 0.3), others={"at 0.2 s": around(33.4, 0.3), "total": around(25.0, 0.3)}
    )
    assert verdict.outcome == "differs"
    assert "(-28.0 %); nearest: at 0.2 s, 33.40 [33.10, 33.70], which agrees" in verdict.because
    verdict = compare_number("harm", 33.6, around(24.2, 0.3), others={"total": around(20.0, 0.3)})
    assert verdict.because.endswith("no other reading here comes nearer")


def test_compare_number__cannot_agree_below_a_bound() -> None:
    bound = ("worlds in which no command avoids an impact", rate(6_256, 10_000))
    verdict = compare_number("collisions", 0.5974, rate(6_500, 10_000), show=PERCENT, least=bound)
    assert verdict.outcome == "cannot agree"
    assert verdict.because == (
        "worlds in which no command avoids an impact: at least 62.6 % [61.6, 63.5], whoever drives;"
        " ours 65.0 % [64.1, 65.9], printed 59.74 %"
    )


def test_compare_number__a_bound_within_chance_of_the_printed_number_proves_nothing() -> None:
    bound = ("worlds", rate(6_256, 10_000))
    assert compare_number("collisions", 0.617, rate(6_500, 10_000), least=bound).outcome == "differs"
    few = ("worlds", rate(63, 100))
    assert compare_number("collisions", 0.5974, rate(65, 100), least=few).outcome == "undecided"


def test_judge_statement__holds_where_every_interval_is_below_zero() -> None:
    good = [Less("10-12 m", around(-3.0, 1.0)), Less("12-14 m", around(-2.0, 1.5))]
    verdict = judge_statement("lower", good)
    assert verdict.outcome == "agrees"
    assert verdict.because == "holds in 2 of 2; the nearest is 12-14 m, -2.00 [-3.50, -0.50]"
    assert judge_statement("lower", good[:1]).because == "10-12 m, -3.00 [-4.00, -2.00]"


def test_judge_statement__names_where_it_fails() -> None:
    verdict = judge_statement("lower", [Less("a", around(-3.0, 1.0)), Less("b", around(2.0, 1.5))])
    assert verdict.outcome == "differs"
    assert verdict.because == "holds in 1 of 2; not so: b, 2.00 [0.50, 3.50]"
    one_world = judge_statement("lower", [Less("b", Estimate(0.5, None))])
    assert (one_world.outcome, one_world.because) == ("differs", "not so: b, 0.50")


def test_judge_statement__is_undecided_where_the_interval_holds_zero() -> None:
    verdict = judge_statement("lower", [Less("a", around(-3.0, 1.0)), Less("b", around(-1.0, 1.5))])
    assert verdict.outcome == "undecided"
    assert verdict.because == "holds in 1 of 2; not shown: b, -1.00 [-2.50, 0.50]"
    mixed = judge_statement("lower", [Less("a", around(3.0, 1.0)), Less("b", around(-1.0, 1.5))])
    assert mixed.outcome == "differs"


def test_judge_statement__leaves_out_where_nothing_is_left_to_undercut() -> None:
    parts = [Less("a", around(-3.0, 1.0)), Less("b", around(0.0, 0.0), neither=True)]
    verdict = judge_statement("lower", parts)
    assert (verdict.outcome, verdict.because[:32]) == ("agrees", "holds in 1 of 1 (both are 0 in b")
    assert judge_statement("lower", parts[1:]).because == "nothing to undercut: both are 0 in b"


def test_judge_statement__at_most_holds_where_both_are_equal() -> None:
    equal = [Less("a", around(0.0, 0.0))]
    assert judge_statement("no more", equal, or_equal=True).outcome == "agrees"
    assert judge_statement("less", equal).outcome == "differs"
    assert judge_statement("no more", [Less("a", around(0.0, 0.1))], or_equal=True).outcome == "undecided"


def test_judge_statement__cannot_agree_where_the_proven_least_is_above() -> None:
    parts = [Less("a", around(-3.0, 1.0)), Less("b", around(1.0, 0.5), least=around(0.4, 0.1))]
    verdict = judge_statement("lower", parts)
    assert verdict.outcome == "cannot agree"
    assert verdict.because.endswith("the harm proven to be the least is above it in: b by 0.40 [0.30, 0.50]")
    unproven = Less("b", around(1.0, 0.5), least=around(0.1, 0.2))
    assert judge_statement("lower", [unproven]).outcome == "differs"


@pytest.mark.parametrize(
    ("outcomes", "worst"),
    [
        (("agrees", "agrees"), "agrees"),
        (("agrees", "differs"), "differs"),
        (("differs", "cannot agree", "agrees"), "cannot agree"),
        (("agrees", "not run"), "not run"),
        (("not run", "undecided", "agrees"), "undecided"),
        ((), "not run"),
    ],
)
def test_summarise_verdicts__tells_the_worst_and_counts(outcomes, worst) -> None:
    found = summarise_verdicts([Verdict(f"w{k}", outcome, f"b{k}") for k, outcome in enumerate(outcomes)])
    assert found.outcome == worst
    if len(outcomes) > 1:
        first = outcomes.index(worst)
        assert found.because.startswith(f"of {len(outcomes)} comparisons ")
        assert found.because.endswith(f"; w{first}: b{first}")
