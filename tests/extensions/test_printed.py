"""What commands print, byte for byte, where all extensions are installed; as tests/cli/test_printed.py."""

from pathlib import Path

import pytest

from tests.cli.test_printed import check_story

STORIES = sorted((Path(__file__).parent / "printed").glob("*.txt"))


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("story", STORIES, ids=lambda story: story.stem)
def test_commands__print_what_is_listed(story: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_story(story, monkeypatch)
