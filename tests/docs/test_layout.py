import re

from ethbrake_marl.episode.features import GROUPS, known_names
from tests.docs import card, layout


def test_page_of_the_layout__is_made_of_the_code() -> None:
    assert layout.PAGE.read_text("utf-8") == layout.page()


def test_card_of_the_environment__is_made_of_the_code_and_complete() -> None:
    text = card.PAGE.read_text("utf-8")
    assert text == card.page()
    names = {re.sub(r"^(front|rear)_[0-9]+", "front_1", name) for name in known_names()}
    assert len(names) > 30
    assert [name for name in sorted(names) if f"`{name}" not in text and name.partition(".")[0] not in GROUPS] == []
    assert "|  |" not in text.partition("## Arguments")[2]  # every argument has a meaning
