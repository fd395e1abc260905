"""One table, in a terminal and as data."""

import sys
from dataclasses import replace

import pytest
from rich.console import Console

from ethbrake_marl.files.sheet import Column, Estimate, Sheet

RATE = Column("Collisions", "rate", digits=1, scale=100.0, unit=" %", short="Hit", interval="below")
CHANGE = Column("Change", sign="+", interval="hidden")
HARM = Estimate(0.25, (0.125, 0.5))
SHEET = Sheet(
    "Two agents",
    ["Agent", RATE, CHANGE],
    [("a|b\nknows", HARM, Estimate(-0.001, None)), "paper, <test>", ("Non-E", None, 2.0), ("last",)],
    note="In m²/s².",
)


def printed(sheet: Sheet, width: int, capsys: pytest.CaptureFixture[str]) -> str:
    Console(file=sys.stdout, width=width).print(sheet)
    return "\n".join(line.rstrip() for line in capsys.readouterr().out.split("\n"))


def test_sheet__in_a_wide_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        printed(SHEET, 120, capsys)
        == """Two agents
Agent                  Hit   Change
───────────────────────────────────
a|b                 25.0 %    -0.00
knows           12.5, 50.0

paper, <test>
Non-E                    –    +2.00
last

In m²/s².
"""
    )


def test_sheet__moves_no_cursor_and_reads_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    marked = Sheet("[b]t[/b]", ["[red]x"], [("\x1b[31m[/]",)])
    assert printed(marked, 80, capsys) == "[b]t[/b]\n[red]x\n───────────\n\\x1b[31m[/]\n"


def test_narrow_terminal__leaves_out_columns_from_the_right_and_folds_long_names(
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = "policy@runs/deep/deep"
    columns = [Column("Agent", text=True), *(Column(f"Column {k}") for k in range(3))]
    sheet = Sheet("", columns, [(f"{name}\nmessages", 1.0, 2.0, 3.0), ("coast", 4.0, 5.0, 6.0)], "Means.", 1, keep=2)
    widths = {40: "Agent Column 0 Column 1", 30: "Agent Column 0", 25: "Agent Column 0"}
    for width, head in widths.items():
        text = printed(sheet, width, capsys)
        cells = [line[: line.find(" ")] if " " in line else line for line in text.split("\n")]
        assert " ".join(text.split("\n")[0].split()) == head and text.endswith("Means.\n")
        assert (name in text) == (width > 25) and name in "".join(cells)
    assert "Column 2" in printed(replace(sheet, keep=None), 40, capsys)


def test_sheet__as_data() -> None:
    assert SHEET.json() == [
        {"Agent": "a|b\nknows", "rate": 0.25, "rate_interval": [0.125, 0.5], "Change": -0.001, "Change_interval": None},
        {"Agent": "Non-E", "rate": None, "Change": 2.0},
        {"Agent": "last"},
    ]
    assert SHEET.csv().split("\n") == [
        "Agent,rate,rate_low,rate_high,Change,Change_low,Change_high",
        '"a|b',
        'knows",0.25,0.125,0.5,-0.001,,',
        "Non-E,,,,2.0,,",
        "last,,,,,,",
        "",
    ]


def test_estimates__in_words_and_as_data() -> None:
    assert Estimate(24.186, (23.85, 24.53)).in_words() == "24.19 [23.85, 24.53]"
    assert Estimate(-0.001, None).in_words() == "0.00"
    assert HARM.in_words(digits=1, scale=100.0, unit=" %") == "25.0 % [12.5, 50.0]"
    assert Estimate(2.0, (1.0, 3.0)).to_json() == {"value": 2.0, "interval": [1.0, 3.0]}
    assert Estimate.side_by_side({"harm": Estimate(2.0, (1.0, 3.0)), "alone": Estimate(4.0, None), "absent": None}) == {
        "harm": 2.0,
        "harm_interval": [1.0, 3.0],
        "alone": 4.0,
        "alone_interval": None,
        "absent": None,
        "absent_interval": None,
    }
