"""docs/benchmark.md shows the lists of suite v2, and the leaderboard of the entries that stand beside it."""

from __future__ import annotations

import re

import pytest

from ethbrake_marl.studies.benchmark import read_entry
from tests.studies.benchmark.rows import ENTRIES, PAGE, page_tables

TEXT = PAGE.read_text("utf-8")


@pytest.mark.parametrize("marker", ["lists", "rows"])
def test_page__shows_the_table_that_the_entries_make(marker):
    match = re.search(f"<!-- {marker} -->\n(.*?)\n<!-- end -->", TEXT, re.DOTALL)
    assert match is not None
    assert match[1] == page_tables()[marker]


def test_entries_that_are_shown__beat_the_best_known_on_no_list_and_in_few_worlds():
    for path in ENTRIES.glob("*.json"):
        for result in read_entry(path).driven.values():
            assert result.realised_share.value <= 1.0 and result.below_best_known <= 0.1 * result.worlds
