"""How pages are written: short lines, short paragraphs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from tests.docs.site import DOCS

ROOT = DOCS.parent
MOST_CHARACTERS = 100
MOST_LINES = 8  # of a paragraph

PAGES = sorted([ROOT / "README.md", *ROOT.glob(".github/*.md"), *DOCS.glob("*.md"), *DOCS.glob("tutorials/*.md")])

FENCE = re.compile(r"\s*(```+|~~~+|:::+)")
FREE = re.compile(r"\s*(\||#|<|!\[)|\[[\w-]+\]: |\s*([-*] )?\S+$")  # tables, headings, HTML, pictures, one word
BREAK = re.compile(r"\s*(\||#|<|!\[)")
ITEM = re.compile(r"\s*(?:[-*]|\d+\.)\s")


def prose(text: str) -> Iterator[tuple[int, str]]:
    """(number, line) of every line that is neither code nor the head of a notebook."""
    fence = ""
    head = text.startswith("---\n")
    for number, line in enumerate(text.splitlines(), 1):
        if head:
            head = number == 1 or line != "---"
            continue
        found = FENCE.match(line)
        if fence:
            if found and line.strip() == fence:
                fence = ""
        elif found:
            fence = found[1]
        elif not line.startswith("    "):
            yield number, line


def long_lines(text: str) -> list[int]:
    """Numbers of lines that are too long for no good reason."""
    return [number for number, line in prose(text) if len(line) > MOST_CHARACTERS and not FREE.match(line)]


def long_paragraphs(text: str) -> list[int]:
    """Number of the first line of every paragraph or item of a list that is too long."""
    lines = list(prose(text))
    begins = [(0, ""), *lines]
    found, start, length = [], 0, 0
    for (before, _), (number, line) in pairwise(begins):
        if not line.strip() or BREAK.match(line):
            length = 0
            continue
        if length == 0 or ITEM.match(line) or number != before + 1:
            start, length = number, 0
        length += 1
        if length == MOST_LINES + 1:
            found.append(start)
    return found


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_page__has_short_lines_and_short_paragraphs(path: Path) -> None:
    text = path.read_text("utf-8")
    wrong = {"lines": long_lines(text), "paragraphs": long_paragraphs(text)}
    assert not any(wrong.values()), wrong


def test_readme__is_short_and_begins_with_a_moving_picture_of_less_than_300_kb() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 120
    found = re.search(r"!\[[^\]]*\]\(([^)]*\.svg)\)", text)
    assert found is not None and found.start() < text.index("\n## ")
    picture = (ROOT / found[1]).read_bytes()
    assert b"<animate" in picture and len(picture) < 300_000


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_page__has_code_blocks_that_begin_and_end_on_lines_of_their_own(path: Path) -> None:
    lines = path.read_text("utf-8").splitlines()
    assert [line for line in lines if re.search(r"\S.*```|```\S+ .*\S *```", line) and "````" not in line] == []


@pytest.mark.parametrize(
    ("text", "lines", "paragraphs"),
    [
        ("a " * 50, [], []),
        ("a " * 50 + "bc", [1], []),
        ("| " + "a " * 80, [], []),
        ("# " + "a " * 80, [], []),
        ("```\n" + "a " * 80 + "\n```\n" + "a " * 60, [4], []),
        ("````\n```\n" + "a " * 80 + "\n````\n", [], []),
        ("    " + "a " * 80, [], []),
        ("see [this](" + "x" * 100 + ") and [that](y)", [1], []),
        ("- [this](" + "x" * 100 + ")", [], []),
        ("x" * 130, [], []),
        ("a b\n" * 8, [], []),
        ("a b\n" * 9, [], [1]),
        ("a b\n" * 5 + "\n" + "c d\n" * 8, [], []),
        ("- a b\n" * 12, [], []),
        ("- a b\n" + "  c d\n" * 8, [], [1]),
        ("a b\n" * 6 + "```\nx\n```\n" + "a b\n" * 6, [], []),
    ],
)
def test_rules__find_what_breaks_them(text: str, lines: list[int], paragraphs: list[int]) -> None:
    assert long_lines(text) == lines
    assert long_paragraphs(text) == paragraphs
