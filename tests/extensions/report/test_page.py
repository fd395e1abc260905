"""Pages: whatever a text says, it stays text, and a page needs nothing else."""

import base64
import hashlib
import json
import re

import pytest

from ethbrake_marl.errors import plain_text
from ethbrake_marl.extensions.report import page as page_module
from ethbrake_marl.extensions.report.page import Part, Section, read_file
from ethbrake_marl.files.sheet import Column, Sheet, Shown
from tests.fixtures.page import HOSTILE, UNSEEN, Page


def whole_page(text: str) -> str:
    """A page in which the text stands in every place that a text can have."""
    body = [
        text,
        Part.paragraph(text, "note"),
        Part.heading(text),
        Part.table(Sheet(text, [text, text], [[text, Shown(text, text)], text, [text, text]])),
        Part.table(Sheet("", [text, Column(text)], [[text, text]])),
        Part.facts({text: text}),
        Part.remarks([text]),
        Part.box(text, {text: text}),
        Part.opened(text, [Part.paragraph(text)]),
    ]
    return page_module.Page(text, [Section(text, body), Section(text, [text]), Section(text, [])], lead=text).html


HARMLESS = Page(whole_page("Harmless"))


@pytest.mark.parametrize("text", HOSTILE)
def test_page__no_text_becomes_markup(text: str) -> None:
    html = whole_page(text)
    found = Page(html)
    assert (found.shape, found.open) == (HARMLESS.shape, []) and not set(html) & UNSEEN
    assert " ".join(plain_text(text, keep="\u00a0").split()) in found.text
    for _, attributes in found.tags:
        assert (attributes.get("href") or "#").startswith("#")
        assert not any(name.startswith("on") for name in attributes)
        assert re.fullmatch(r"[a-z0-9-]+", attributes.get("id") or "x")


@pytest.mark.parametrize("text", HOSTILE)
def test_data__stays_data(text: str) -> None:
    html = str(Part.data("x", {text: [text, 1.5, None]}).html)
    inner = html.removeprefix('<script type="application/json" id="x">').removesuffix("</script>\n")
    assert inner.isascii() and not set("<>&") & set(inner)
    assert json.loads(inner) == {text: [text, 1.5, None]}


def test_page__names_no_two_sections_alike() -> None:
    ids = [attributes["id"] for tag, attributes in Page(whole_page("Results!")).tags if tag == "section"]
    assert ids == ["results", "results-2", "results-3"]


def test_page__allows_its_own_style_and_script_alone() -> None:
    html = whole_page("x")
    style = re.search(r"<style>(.*?)</style>", html, re.DOTALL)
    assert style is not None and style[1] == read_file("page.css")
    sha = base64.b64encode(hashlib.sha256(style[1].encode()).digest()).decode()
    policy = next(attributes["content"] for _, attributes in Page(html).tags if "http-equiv" in attributes)
    assert f"style-src 'sha256-{sha}'" in policy
    assert "default-src 'none'" in policy and "script-src 'none'" in policy
    assert " style=" not in html and "url(" not in html and "@import" not in html
