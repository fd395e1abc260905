"""One table, written in five ways."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text

RATE = Column("Collisions", "rate", digits=1, scale=100.0, unit=" %", short="Hit", interval="below")
CHANGE = Column("Change", sign="+", interval="hidden", wide=True)
HARM = Estimate(0.25, (0.125, 0.5))
SHEET = Sheet(
    "Two agents",
    ["Agent", RATE, CHANGE],
    [("a|b\nknows", HARM, Estimate(-0.001, None)), "paper, <test>", ("Non-E", None, 2.0), ("last",)],
    note="In m²/s².",
)


def drawn(sheet: Sheet, width: int) -> list[str]:
    file = io.StringIO()
    Console(file=file, width=width).print(sheet)
    return [line.rstrip() for line in file.getvalue().splitlines()]


def test_sheet__in_a_terminal() -> None:
    assert drawn(SHEET, 120) == [
        "Two agents", "Agent                  Hit   Change", 35 * "─",
        "a|b                 25.0 %    -0.00", "knows           12.5, 50.0", "",
        "paper, <test>", "Non-E                    –    +2.00", "last", "", "In m²/s².",
    ]  # fmt: skip
    narrow = drawn(SHEET, 60)
    assert narrow[1] == "Agent                  Hit"
    assert not any("2.00" in line for line in narrow)


def test_sheet__moves_no_cursor_and_reads_no_markup() -> None:
    lines = drawn(Sheet("[b]t[/b]", ["[red]x"], [("\x1b[31m[/]",)]), 80)
    assert lines == ["[b]t[/b]", "[red]x", 11 * "─", "\\x1b[31m[/]"]


def test_sheet__in_a_document() -> None:
    assert SHEET.markdown().splitlines() == [
        "| Agent | Collisions | Change |", "| --- | ---: | ---: |",
        "| a\\|b knows | 25.0 % [12.5, 50.0] | -0.00 |", "| paper, <test>: Non-E | – | +2.00 |",
        "| paper, <test>: last |  |  |",
    ]  # fmt: skip


def test_sheet__in_a_notebook() -> None:
    page = SHEET.html()
    assert "<caption>Two agents</caption>" in page
    assert page.endswith("<p>In m²/s².</p>")
    assert '<tr class="block"><th colspan="3" scope="rowgroup">paper, &lt;test&gt;</th></tr>' in page
    assert '<th scope="row">Non-E</th>\n<td>–</td>' in page


def test_sheet__as_data() -> None:
    assert json.loads(json.dumps(SHEET.json()))[0] == {
        "Agent": "a|b\nknows", "rate": 0.25, "rate_interval": [0.125, 0.5], "Change": -0.001, "Change_interval": None
    }  # fmt: skip
    assert SHEET.csv().splitlines() == [
        "Agent,rate,rate_low,rate_high,Change,Change_low,Change_high",
        '"a|b', 'knows",0.25,0.125,0.5,-0.001,,', "Non-E,,,,2.0,,", "last,,,,,,",
    ]  # fmt: skip
    assert csv_text([{"x": 1}], ["x", "y"]) == "x,y\n1,\n"
    with pytest.raises(ValueError, match="z"):
        csv_text([{"z": 1}], ["x"])


def test_sheet__some_columns() -> None:
    some = Sheet("", ["Agent", "Knows", RATE], [("coast", None, 0.5), "section", ("other", None, None)])
    assert some.filled() == [0, 2]
    assert some.only([2, 0]).headings == ["Collisions", "Agent"]
    assert list(some.only([2]).shown()) == [(("50.0 %", ""),), "section", (("–", ""),)]


def test_estimate__in_words() -> None:
    assert Estimate(24.186, (23.85, 24.53)).in_words() == "24.19 [23.85, 24.53]"
    assert Estimate(-0.001, None).in_words() == "0.00"
    assert HARM.in_words(digits=1, scale=100.0, unit=" %") == "25.0 % [12.5, 50.0]"
