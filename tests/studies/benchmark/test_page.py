"""docs/benchmark.md shows the lists of suite v1, and the leaderboard of the entries that stand beside it."""

from __future__ import annotations

import re

import pytest

from ethbrake_marl.studies.benchmark.entry import read_entry
from tests.studies.benchmark.rows import ENTRIES, PAGE, page_tables

TEXT = PAGE.read_text("utf-8")


@pytest.mark.parametrize("marker", ["lists", "rows"])
def test_page__shows_the_table_that_the_entries_make(marker):
    match = re.search(f"<!-- {marker} -->\n(.*?)\n<!-- end -->", TEXT, re.DOTALL)
    assert match is not None
    assert match[1] == page_tables()[marker]


def test_entries_that_are_shown__never_do_less_harm_than_the_best_known():
    for path in ENTRIES.glob("*.json"):
        entry = read_entry(path)
        assert {name: each.below_best_known for name, each in entry.driven.items() if each.below_best_known} == {}
