"""Markdown for pages that are made from the code: tables, wrapped text, first sentences."""

import re
import textwrap
from collections.abc import Iterable, Sequence

WIDTH = 100
RAISED = {"2": "²", "3": "³", "6": "⁶"}
KEPT = re.compile(r"\||#|<|!\[|- |\d+\. |    ")  # tables, headings, HTML, pictures, lists, code


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; units are written for readers outside code."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(prose(str(each), '|') for each in line)} |" for line in lines) + "\n"


def prose(text: str, escaped: str = "") -> str:
    """Text on one line, ``escaped`` escaped, and outside code with options and units as a reader expects them."""
    text = " ".join(text.split())
    parts = re.split(r"(`[^`]*`)", text.replace(escaped, f"\\{escaped}") if escaped else text)
    return "".join(part if part.startswith("`") else _for_readers(part) for part in parts)


def _for_readers(text: str) -> str:
    """Options as code, since the site makes a dash of two hyphens, and units with raised digits."""
    text = re.sub(r"(?<![\w-])(--[a-z][a-z-]*)", r"`\1`", text)
    return re.sub(r"\bm(2?)/s([236])\b", lambda m: f"m{RAISED.get(m[1], '')}/s{RAISED[m[2]]}", text)


def wrap(text: str, later: str = "") -> str:
    """A paragraph on lines of at most 100 characters, none of which begins like a list, a heading or a comment (%)."""
    text = re.sub(r" (?=([-+*#>]|\d+[.)]) |%)", "\x00", prose(text))
    first, rest = (text[:2], text[2:]) if later else ("", text)
    lines = textwrap.wrap(
        rest, WIDTH, initial_indent=first, subsequent_indent=later, break_long_words=False, break_on_hyphens=False
    )
    return "\n".join(lines).replace("\x00", " ")


def wrap_page(text: str) -> str:
    """A page with its paragraphs wrapped; tables, blocks, headings and lists stay."""
    parts = re.split(r"(^```.*?^```$)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if part.startswith("```") else _wrap_paragraphs(part) for part in parts)


def _wrap_paragraphs(text: str) -> str:
    return re.sub(r"(?m)(?:^(?!$).*\n?)+", lambda m: m[0] if KEPT.match(m[0]) else wrap(m[0]) + "\n", text)


def link_pages(text: str, docs: str) -> str:
    """The text with each page that it names (``docs/shield.md``) as a link; ``docs`` leads from the text to docs/."""
    return re.sub(r"`?docs/([\w/-]+)\.md`?", lambda m: f"[{m[1].rpartition('/')[2]}]({docs}{m[1]}.md)", text)


def first_sentence(text: str) -> str:
    """The first sentence of a text."""
    text = " ".join(text.partition("\n\n")[0].split()).replace("``", "`")
    found = re.match(r"(.+?(?<!\.)\.)(?=\s|$)", text)
    return found[1] if found else text
