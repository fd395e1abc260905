"""What commands print, byte for byte, where all extensions are installed; as tests/cli/test_printed.py."""

from pathlib import Path

import pytest

from tests.cli.test_printed import check_story

STORY = Path(__file__).parent / "printed" / "story.txt"


@pytest.mark.usefixtures("empty_folder")
def test_commands__print_what_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    check_story(STORY, monkeypatch)
