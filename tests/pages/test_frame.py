from __future__ import annotations

import base64
import hashlib
import json
import re

import pytest
from matplotlib.figure import Figure

from ethbrake_marl.errors import plain_text
from ethbrake_marl.figures import COLOURS, add_caption, inline_svg, new_figure
from ethbrake_marl.files.sheet import Column, Sheet, Shown
from ethbrake_marl.pages import page as pages
from ethbrake_marl.pages.page import Part, Section, read_file
from tests.pages.hostile import HOSTILE, UNSEEN, Page


def whole_page(text: str) -> str:
    """A page in which the text stands in every place that a text can have."""
    body = [
        text,
        Part.paragraph(text, "note"),
        Part.heading(text),
        Part.table(Sheet(text, [text, text], [[text, Shown(text, text)], text, [text, text]])),
        Part.table(Sheet("", [text, Column(text)], [[text, text]])),
        Part.facts({text: text}),
        Part.opened(text, [Part.paragraph(text)]),
    ]
    return pages.Page(text, [Section(text, body), Section(text, [text]), Section(text, [])], lead=text).html


HARMLESS = Page(whole_page("Harmless"))


@pytest.mark.parametrize("text", HOSTILE)
def test_page__no_text_becomes_markup(text: str) -> None:
    html = whole_page(text)
    found = Page(html)
    assert found.shape == HARMLESS.shape
    assert found.open == []
    assert not set(html) & UNSEEN
    assert " ".join(plain_text(text, keep="\u00a0").split()) in found.text
    for _, attributes in found.tags:
        assert (attributes.get("href") or "#").startswith("#")
        assert not any(name.startswith("on") for name in attributes)
        assert re.fullmatch(r"[a-z0-9-]+", attributes.get("id") or "x")


@pytest.mark.parametrize("text", HOSTILE)
def test_data__stays_data(text: str) -> None:
    html = str(Part.data("x", {text: [text, 1.5, None]}).html)
    inner = html.removeprefix('<script type="application/json" id="x">').removesuffix("</script>\n")
    assert not set("<>&") & set(inner)
    assert inner.isascii()
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


def a_figure() -> Figure:
    figure = new_figure(4.0, 3.0)
    axes = figure.subplots()
    for colour in COLOURS:
        axes.plot([0, 1], [0, 1], color=colour, marker="o")
    axes.set_xlabel("Time (s)")
    return figure


def test_drawing__names_of_two_figures_do_not_collide() -> None:
    html = pages.Page("t", [Section("s", [Part.drawing(a_figure(), name, "d") for name in ("One", "Two")])]).html
    found = Page(html)
    ids = [attributes["id"] for _, attributes in found.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    targets = re.findall(r'(?:url\(|href=")#([^)"]+)', html)
    assert len(targets) > 10
    assert set(targets) <= set(ids)


def test_drawing__has_text_as_outlines_and_the_colours_of_the_page() -> None:
    html = Part.drawing(a_figure(), "One", "What it shows.").html
    assert "<text" not in html and "font-family" not in html
    assert " style=" not in html and "<style" not in html
    assert all(f"var(--series-{k})" in html for k in range(len(COLOURS)))
    assert 'aria-label="One. What it shows."' in html
    assert "var(" not in Part.drawing(a_figure(), "One", "d", alone=True).html


@pytest.mark.parametrize("text", HOSTILE[:24])
def test_drawing__label_is_text(text: str) -> None:
    tags = [tag for tag, _ in Page(str(inline_svg(b'<svg xmlns="http://www.w3.org/2000/svg"/>', text)[0])).tags]
    assert tags == ["svg"]


def test_page__has_the_palette_of_the_figures() -> None:
    css = read_file("page.css")
    assert [re.search(rf"--series-{k}: (#\w+)", css)[1].lower() for k in range(7)] == [c.lower() for c in COLOURS]  # type: ignore[index]


def test_drawing__the_caption_is_text_of_the_page() -> None:
    figure = new_figure(6.0, 3.0)
    figure.subplots().plot([0.0, 1.0])
    text = (
        "One hundred worlds of the list of seed 7; gaps from 5 to 10 m, each drawn alone, and the first-impact harm "
        * 2
    )
    add_caption(figure, f"{text.strip()} Known.")
    html = Part.drawing(figure, "Title", "Words.", known="Known.").html
    shown = Page(str(html)).text.replace("\n", " ")
    assert shown.endswith(text.strip()) and "<!--" not in html
    taken = re.search(r'viewBox="0 0 432 ([0-9.]+)"', html)
    assert taken is not None and float(taken[1]) < 216.0
    names = set(re.findall(r' id="([^"]+)"', html))
    assert set(re.findall(r'href="#([^"]+)"', html)) <= names
    assert figure.get_supxlabel().startswith("One hundred worlds")
