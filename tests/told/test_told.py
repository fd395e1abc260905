"""What calls give, as listed in ``tests/told/*.txt``: each list is one story of doctests, told in an empty folder."""

import doctest
from pathlib import Path

import pytest

LISTS = sorted(Path(__file__).parent.glob("*.txt"))


@pytest.mark.parametrize("story", LISTS, ids=lambda story: story.stem)
def test_calls__give_what_is_listed(story: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = doctest.testfile(str(story), module_relative=False, optionflags=doctest.ELLIPSIS)
    assert found.attempted > 0 and found.failed == 0
