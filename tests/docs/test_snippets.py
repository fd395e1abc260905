"""The Python programs of pages that no other test runs: each page from the top down, in a folder of its own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.docs.site import DOCS

PAGES = ("pettingzoo-listing", "shipped-policies")
PROGRAM = re.compile(r"```python\n(.*?)```(?:\n\n```\n(.*?)```)?", re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_programs__of_a_page_run_and_print_what_stands_below_them(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "my_file"}
    programs = PROGRAM.findall((DOCS / f"{page}.md").read_text("utf-8"))
    assert programs
    for code, printed in programs:
        exec(compile(code, f"{page}.md", "exec"), names)
        told = capsys.readouterr().out
        assert not printed or told == printed
