"""An old name is refused with the new one, which the changelog shows too."""

import re
from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.renamed import RENAMED
from tests.fixtures.commands import Refuse

CHANGELOG = Path(__file__).parents[1] / "CHANGELOG.md"


def names_in(text: str) -> set[str]:
    return {part for code in re.findall(r"`([^`]+)`", text) for part in re.split(r"[ .]", code)}


@pytest.mark.parametrize("kind", RENAMED)
def test_table__is_that_of_the_changelog(kind: str) -> None:
    table = CHANGELOG.read_text("utf-8").split("### Breaking")[0]
    rows = [line.split("|") for line in table.splitlines() if "|" in line]
    for old, new in RENAMED[kind].items():
        assert any(old in names_in(row[1]) and new in names_in(row[2]) for row in rows[2:]), old


def test_old_names__are_refused_with_the_new_ones(refuse: Refuse) -> None:
    with pytest.raises(AttributeError, match="renamed to play_to_end"):
        _ = eb.drive
    with pytest.raises(UnknownName, match="renamed to level-0-sensors"):
        eb.load_scenario("cooperation-0-sensors")
    with pytest.raises(UnknownName, match="renamed to vine-paper"):
        eb.make_agent("universal-paper", scenario="paper-random")
    with pytest.raises(UnknownName, match="renamed to vine-paper"):
        eb.load_recipe("universal-paper")
    refuse("compare", "renamed to evaluate")
