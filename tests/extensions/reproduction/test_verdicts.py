"""Verdicts: a table by hand for numbers, one for statements, and the one table of sentences."""

import numpy as np
import pytest

from ethbrake_marl.extensions.reproduction import verdicts
from ethbrake_marl.extensions.reproduction.items import markdown
from ethbrake_marl.extensions.reproduction.readings import READINGS
from ethbrake_marl.extensions.reproduction.verdicts import (
    Claim,
    Judged,
    Less,
    Result,
    chance_difference,
    count_sheet,
    judge,
    judge_in_each,
    judge_number,
    judge_sentences,
    judge_share,
    judge_statement,
    same_claim,
    sentences_sheet,
    short_lines,
)
from ethbrake_marl.files.sheet import Estimate


def around(value: float, half: float) -> Estimate:
    return Estimate(value, (value - half, value + half))


@pytest.mark.parametrize(
    ("printed", "ours", "least", "outcome"),
    [
        (10.0, around(10.1, 0.01), None, "agrees"),
        (10.0, around(9.81, 0.01), None, "agrees"),
        (10.0, around(10.25, 0.01), None, "differs"),
        (10.0, around(10.25, 0.2), None, "undecided"),  # chance 0.28
        (10.0, around(11.3, 1.0), None, "undecided"),  # chance 1.41
        (10.0, around(12.0, 0.1), around(11.0, 0.1), "cannot be"),
        (10.0, around(12.0, 0.1), around(10.1, 0.1), "differs"),  # within the chance of the bound
        (10.0, around(12.0, 0.1), around(5.0, 0.1), "differs"),
        (10.0, around(10.15, 0.01), around(10.1, 0.01), "cannot be"),  # although it is within 2 %
    ],
)
def test_number__by_hand(printed: float, ours: Estimate, least: Estimate | None, outcome: str) -> None:
    assert judge_number(printed, ours, least) == outcome


def test_chance__is_root_two_times_half_of_the_interval() -> None:
    assert chance_difference(around(5.0, 1.0)) == pytest.approx(2.0**0.5)
    assert chance_difference(Estimate(5.0, None)) == 0.0


A, D, OPEN, WRONG = (Less(name, around(by, 1.0)) for name, by in (("a", -3.0), ("d", -5.0), ("b", -0.5), ("c", 2.0)))
TIE, ZERO = Less("z", Estimate(0.0, None), both_are_0=True), Less("e", around(0.0, 0.0))


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([A], ("holds", "agrees", "a, -3.00 [-4.00, -2.00]")),
        ([A, D], ("holds in 2 of 2", "agrees", "a, -3.00 [-4.00, -2.00]")),  # the nearest
        ([A, OPEN], ("holds in 1 of 2", "undecided", "b, -0.50 [-1.50, +0.50]")),
        ([A, WRONG], ("holds in 1 of 2", "differs", "c, +2.00 [+1.00, +3.00]")),
        ([OPEN, WRONG], ("holds in 0 of 2", "differs", "b, -0.50 [-1.50, +0.50]; c, +2.00 [+1.00, +3.00]")),
        ([OPEN], ("not shown", "undecided", "b, -0.50 [-1.50, +0.50]")),
        ([Less("f", Estimate(0.5, None))], ("does not hold", "differs", "f, +0.50")),
        ([ZERO], ("does not hold", "differs", "e, +0.00 [+0.00, +0.00]")),
        ([A, TIE], ("holds in 1 of 1, both are 0 in 1 more", "agrees", "a, -3.00 [-4.00, -2.00]")),
        ([TIE, TIE], ("nothing to compare", "undecided", "both are 0 in all worlds")),
        ([], ("nothing to compare", "undecided", "too few worlds")),
    ],
)
def test_statement__by_hand(parts: list[Less], expected: tuple[str, str, str]) -> None:
    assert judge_statement(parts) == expected


def test_less__is_paired_in_the_same_worlds() -> None:
    one, other = np.array([1.0, 2.0, 9.0]), np.array([2.0, 3.0, 10.0])
    assert Less.of_worlds("w", one, other).difference.ends == pytest.approx((-1.0, -1.0))
    low, high = Less.of_lists("w", one, other).difference.ends
    assert low < -1.0 < high and high > 5.0
    assert Less.of_worlds("w", one * 0.0, other * 0.0).both_are_0 and not Less.of_worlds("w", one, one).both_are_0


def test_result__by_hand() -> None:
    assert judge([A]) == ("holds: a, -3.00 [-4.00, -2.00]", "agrees")
    assert judge([WRONG], numbers="1 to 2") == ("does not hold: 1 to 2", "differs")
    assert judge([TIE]) == ("nothing to compare: both are 0 in all worlds", "undecided")
    claim = judge_in_each("x", {"ours": 2.0, "R1": -2.0}, lambda value: [Less("a", around(value, 1.0))])
    assert [claim.result(reading).verdict for reading in READINGS] == ["differs", "agrees", "differs"]


@pytest.mark.parametrize(
    ("holds", "expected"),
    [
        ([True, True], ("holds in 100.0 % [34.2, 100.0] of 2 worlds", "agrees")),
        ([True, False], ("holds in 50.0 % [9.5, 90.5] of 2 worlds", "differs")),
        ([], ("", "undecided")),
    ],
)
def test_share__agrees_if_it_holds_in_every_world(holds: list[bool], expected: tuple[str, str]) -> None:
    assert judge_share(np.array(holds, np.bool_), "worlds") == expected


SENTENCES = [
    {"where": "Fig. 4", "paper": "a < b", "result": "two/x", "why": {"differs": "no", "agrees": "so it is"}},
    {"where": "Fig. 5", "paper": "b|c" + " and so on" * 9, "result": "one/y", "why": {}},
    {"where": "Fig. 2", "paper": "same", "result": "one/z", "why": {"undecided": "one seed"}},
    {"where": "Fig. 9", "paper": "left out", "result": "three/x", "why": {}},
]


@pytest.fixture
def sentences(monkeypatch: pytest.MonkeyPatch) -> list[Judged]:
    results = {"one/z": {"ours": {"text": "7", "verdict": "undecided"}}}
    monkeypatch.setattr(verdicts, "paper_texts", lambda: {"sentences": SENTENCES})
    monkeypatch.setattr(verdicts, "recorded", lambda: {"results": results})
    both = {"ours": Result("2", "differs"), "R2": Result("3", "agrees")}
    claims = {"one": {"y": Claim("y", both)}, "two": {"x": same_claim("x", "1", "agrees", "0.3 %")}}
    return judge_sentences(claims)


def test_sentences__are_in_the_papers_order_with_a_verdict_in_each_reading(sentences: list[Judged]) -> None:
    assert markdown(sentences_sheet(sentences)).splitlines() == [
        "| Where | The paper | ours | R1 | R2 | Numbers, ours | Numbers, R1 | Numbers, R2 | Why |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        "| Fig. 4 | a < b | agrees (0.3 %) | agrees (0.3 %) | agrees (0.3 %) | 1 |  |  | so it is |",
        f"| Fig. 5 | b\\|c{' and so on' * 9} | differs | differs | agrees | 2 |  | 3 |  |",
        "| Fig. 2 | same | undecided | undecided | undecided | 7 |  |  | one seed |",
    ]


def test_terminal__has_a_line_for_each_sentence_and_the_number_of_each_verdict(sentences: list[Judged]) -> None:
    heading, first, second, _ = short_lines(sentences).splitlines()
    assert heading.split() == ["Where", "The", "paper", "ours", "R1", "R2"]
    assert first == f"Fig. 4         a < b{' ' * 55} agrees    agrees    agrees"
    assert second[15:75] == "b|c and so on and so on and so on and so on and so on and s…" and len(second) < 106
    counts = {row[0]: [*row[1:]] for row in count_sheet(sentences).rows}
    assert counts == {"agrees": [1, 1, 2], "differs": [1, 1, 0], "cannot be": [0, 0, 0], "undecided": [1, 1, 1]}
