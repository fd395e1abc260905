"""The first sentence of a page: an agent's harm compared with full braking, and the tests in which it fails."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from ethbrake_marl.episode.counts import COLUMN, HARM
from ethbrake_marl.evaluation.compared import Compared
from ethbrake_marl.evaluation.summary import BASELINE
from ethbrake_marl.evaluation.summary_row import SummaryRow
from ethbrake_marl.extensions.report.best_known import BestKnown
from ethbrake_marl.files.sheet import Column

LEARNED = ("trained policy", "trained team")  # names that get an article
WORDS = {  # count -> verb, noun, and what is counted
    "first": ("does", " harm", "first impacts"),
    "total": ("does", " harm", "all impacts"),
    "honest": ("costs", "", "honest cost"),
}


def first_sentence(compared: Compared, focus: str, tests: Mapping[str, Compared]) -> str:
    """Return the page's first sentence: the harm of the agent ``focus`` compared with full braking.

    It names the tests in which the agent does about as much harm as full braking, or more. ``tests``: title -> results
    of the same agents in another test.
    """
    count, harm = compared.harm_count, COLUMN[compared.harm_count]
    rows, known = {row.agent: row for row in compared.table}, BestKnown.of(compared.result)
    row, before = rows[focus], rows.get(BASELINE)
    name = "Full braking" if focus == BASELINE else f"The {focus}" if focus in LEARNED else focus
    best = "" if known is None or count not in known.harm else f"; best known {known.harm[count].mean():.2f}"
    does, of_harm, what = WORDS[count]
    if before is None or row is before:
        total = f"; total harm: {value(row, HARM['total'])}" if count == "honest" else ""
        return (
            f"{name} {does} {value(row, harm)} m²/s²{of_harm and ' of'}{of_harm} per emergency ({what}{total}{best})."
        )
    change, decrease = change_of(row, harm), row[f"harm_decrease_{count}"]
    much = "" if decrease is None else f"{abs(100.0 * decrease.value):.0f} % "  # None: full braking does none
    words = f"about as much{of_harm} as" if change == "as much" else f"{much}{change}{of_harm} than"
    numbers = f"{what}: {value(row, harm)} m²/s² per emergency instead of {value(before, harm)}{best}"
    if count == "honest":
        numbers += f"; total harm: {value(row, HARM['total'])} instead of {value(before, HARM['total'])}"
    fails = []
    for title, other in tests.items():
        there = {each.agent: each for each in other.table}
        if {focus, BASELINE} <= there.keys() and (worse := change_of(there[focus], harm)) != "less":
            instead = f"{value(there[focus], harm)} instead of {value(there[BASELINE], harm)}"
            fails.append(f"{worse} in the {title.lower()} ({instead})")
    joined = ", but " if change == "less" else ", and "
    return f"{name} {does} {words} full braking ({numbers}){joined * bool(fails)}{' and '.join(fails)}."


def change_of(row: SummaryRow, harm: str) -> Literal["less", "more", "as much"]:
    """Return how an agent's harm differs from full braking's: "as much" if the 95 % interval contains 0."""
    difference = row[f"{harm}_difference"]
    if difference is None or (difference.interval is None and row.episodes > 1):
        return "as much"
    low, high = difference.ends
    return "less" if high < 0.0 else "more" if low > 0.0 else "as much"


def value(row: SummaryRow, key: str) -> str:
    return Column("").show(row[key]).value
