"""Pages: whatever a text says, it stays text, and a page needs nothing else."""

import base64
import hashlib
import json
import re

import pytest

from ethbrake_marl.errors import plain_text
from ethbrake_marl.extensions.report.figures import SLIM_IN
from ethbrake_marl.extensions.report.page import Section, data, drawing, page_part, table, whole_page as page_of
from ethbrake_marl.extensions.report.style import finish, new_figure
from ethbrake_marl.files.sheet import CellText, Column, Estimate, Sheet
from tests.fixtures.page import HOSTILE, UNSEEN, Page


def whole_page(text: str) -> str:
    """A page in which the text stands in every place that a text can have."""
    body = [
        text,
        page_part("paragraph", text, "note"),
        table(Sheet(text, [text, text], [[text, CellText(text, text)], text, [text, text]])),
        table(Sheet("", [text, Column(text)], [[text, text]])),
        page_part("facts", {text: text}),
        page_part("remarks", [text]),
        page_part("box", text, {text: text}),
        page_part("folded", text, [page_part("paragraph", text)]),
        page_part("drawing", text, text, "slim", "", text),
    ]
    return page_of(text, text, [page_part("beside", page_part("watch", text), "")], [Section("Worst ten worlds", body)])


HARMLESS = Page(whole_page("Harmless"))


@pytest.mark.parametrize("text", HOSTILE)
def test_page__no_text_becomes_markup(text: str) -> None:
    html = whole_page(text)
    found = Page(html)
    assert (found.shape, found.open) == (HARMLESS.shape, []) and not set(html) & UNSEEN
    assert " ".join(plain_text(text, keep="\u00a0").split()) in found.text
    assert not any(name.startswith("on") for _, attributes in found.tags for name in attributes)


@pytest.mark.parametrize("text", HOSTILE[:3])
def test_data__stays_data(text: str) -> None:
    html = str(data("x", {text: [text, 1.5, None]}))
    inner = html.removeprefix('<script type="application/json" id="x">').removesuffix("</script>\n")
    assert inner.isascii() and not set("<>&") & set(inner)
    assert json.loads(inner) == {text: [text, 1.5, None]}


def test_page__allows_its_own_style_and_script_alone() -> None:
    html = whole_page("x")
    policy = next(attributes["content"] for _, attributes in HARMLESS.tags if "http-equiv" in attributes)
    for kind in ("style", "script"):
        (text,) = re.findall(f"<{kind}>(.*?)</{kind}>", html, re.DOTALL)
        sha = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{sha}';" in policy and len(text) > 1000
    assert "default-src 'none'" in policy
    assert " style=" not in html and "url(" not in html and "@import" not in html
    ids = [attributes["id"] for tag, attributes in HARMLESS.tags if tag == "section"]
    assert ids == ["worst-ten-worlds"] and 'href="#worst-ten-worlds"' in html


@pytest.mark.parametrize(("width_in", "kind"), [(SLIM_IN, "slim"), (5.0, ""), (10.0, "broad")])
def test_drawing__is_as_wide_as_a_phone_shows_it_and_its_caption_is_text(width_in: float, kind: str) -> None:
    figure = finish(new_figure(width_in, 1.0), "A long caption, " * 9)
    html = str(drawing(figure, "Title", "words"))
    (picture,) = (attributes for tag, attributes in Page(html).tags if tag == "img")
    assert picture["class"] == kind and picture["alt"] == "Title. words"
    assert "A long caption, A long caption" in Page(html).text and figure.get_supxlabel() == ""
    assert base64.b64decode(picture["src"].removeprefix("data:image/svg+xml;base64,")).startswith(b"<?xml")


def test_table__by_hand() -> None:
    rate = Column("Collisions", digits=1, scale=100.0, unit=" %")
    rows = [("a|b\nknows", Estimate(0.25, (0.125, 0.5)), -0.001), "paper, <test>", ("x:y", None, 2.0), ("last",)]
    sheet = Sheet("Two agents", ["Agent", rate, Column("Change", sign="+")], rows, note="In m²/s².")
    assert str(table(sheet)).strip().split("\n") == [
        '<div class="wide" tabindex="0" role="region" aria-label="Two agents"><table>',
        "<caption>Two agents</caption>",
        "<thead><tr>",
        '<th scope="col">Agent</th>',
        '<th scope="col">Collisions</th>',
        '<th scope="col">Change</th>',
        "</tr></thead>",
        "<tbody>",
        '<tr><th scope="row">a|b\\nknows</th>',
        '<td>25.0 % <span class="interval">[12.5, 50.0]</span></td>',
        "<td>-0.00</td>",
        "</tr>",
        '<tr class="block"><th colspan="3" scope="rowgroup">paper, &lt;test&gt;</th></tr>',
        '<tr><th scope="row">x:<wbr>y</th>',
        "<td>–</td>",
        "<td>+2.00</td>",
        "</tr>",
        '<tr><th scope="row">last</th>',
        "<td></td>",
        "<td></td>",
        "</tr>",
        "</tbody>",
        "</table></div>",
        "<p>In m²/s².</p>",
    ]
