"""The site that ``make docs`` builds: it loses no text, follows the colour scheme, and its search finds pages."""

import html
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markdown_it import MarkdownIt
from PIL import Image

from tests.docs.printed import PAGES, ROOT
from tests.docs.site import DOCS
from tests.fixtures.browser import browser as browser, wait_until

SITE = DOCS / "_build" / "html"
SHOWN = {page: SITE / page.relative_to(DOCS).with_suffix(".html") for page in PAGES if page.is_relative_to(DOCS)}
SHOWN |= {ROOT / "README.md": SITE / "index.html", ROOT / "CHANGELOG.md": SITE / "decisions" / "README.html"}
del SHOWN[DOCS / "index.md"]  # the site shows README in its place


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_line__is_a_comment_of_the_site(page: Path) -> None:
    assert re.findall(r"(?m)^ *(?:- )?%.*", page.read_text("utf-8")) == []


@pytest.fixture
def site() -> Path:
    """Folder of the site. Skips the test unless the site is newer than its pages."""
    index = SITE / "index.html"
    if not index.exists() or index.stat().st_mtime < max(page.stat().st_mtime for page in SHOWN):
        pytest.skip("no site, or one that is older than its pages: make docs")
    return SITE


def letters(text: str) -> str:
    """The letters and digits alone: the site changes quotes, hyphens and blanks."""
    return re.sub(r"\W+|_", "", html.unescape(text))


def sentences(page: Path) -> list[str]:
    """Text of each paragraph, heading and cell of a page, without code blocks and comments."""
    texts = []
    for token in MarkdownIt("commonmark").enable("table").parse(page.read_text("utf-8")):
        parts = [part for part in token.children or () if token.type == "inline" and part.type != "html_inline"]
        texts.append("".join(part.content for part in parts if part.type != "image"))
    return [text for text in texts if "$" not in text and letters(text)]  # a formula is drawn from its source


@pytest.mark.slow
@pytest.mark.parametrize("page", SHOWN, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_sentence__of_a_page_is_on_the_site(site: Path, page: Path) -> None:
    shown = letters(re.sub(r"<[^>]*>", "", SHOWN[page].read_text("utf-8")))
    assert [text for text in sentences(page) if letters(text) not in shown] == []


QUERIES = {
    "custom reward": "extend",
    "reaction time": "scenarios",
    "behavior cloning": "data",
    "crash": "game",
    "self-play": "train",
    "centralized critic": "train",
    "custom observation": "extend",
    "normalize": "train",
    "multi agent": "train",
    "wet road": "scenarios",
    "packet loss": "cooperation",
    "pretrained model": "reference/policies",
    "install windows": "installing",
    "leaderboard": "results/benchmark",
    "safe rl": "shield",
    "sumo": "simulators",
    "confidence interval": "evaluate",
    "optimal braking": "least-harm",
    "getting started": "first-ten-minutes",
    "reproduce": "paper",
}
FOUND = "document.querySelector('#search-results li a')"


@pytest.mark.slow
def test_search__finds_the_right_page_first(site: Path, browser: Any) -> None:
    page, first = browser.new_page(), {}
    for query in QUERIES:
        page.goto(f"{(site / 'search.html').as_uri()}?q={query.replace(' ', '+')}")
        wait_until(page, f"{FOUND} && document.querySelector('#search-results h2').innerText == 'Search Results'")
        first[query] = page.evaluate(f"{FOUND}.getAttribute('href')").partition(".html")[0]
    page.close()
    assert first == QUERIES


PICTURE = "article img"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["index", "findings", "physics", "cooperation"])
def test_pictures__follow_the_scheme_and_can_be_read_on_a_telephone(site: Path, browser: Any, name: str) -> None:
    page = browser.new_page(viewport={"width": 360, "height": 900}, color_scheme="light")
    page.goto((site / f"{name}.html").as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == 360
    script = "images => images.map((e) => [e.src.slice(-3), e.getBoundingClientRect().width / e.naturalWidth])"
    for kind, scale in page.eval_on_selector_all(PICTURE, script):
        assert kind == "gif" or scale * 7.5 * {"png": 150, "svg": 96}[kind] / 72 >= 8.99  # px of the smallest letters
    page.set_viewport_size({"width": 1_440, "height": 900})
    for scheme, paper in (("light", 255), ("dark", 19)):
        page.emulate_media(color_scheme=scheme)
        picture = Image.open(io.BytesIO(page.locator(PICTURE).first.screenshot(animations="disabled")))
        assert np.median(np.asarray(picture.convert("L"))) == pytest.approx(paper, abs=6), scheme
    page.close()


@pytest.mark.slow
def test_first_page__is_the_readme_and_cuts_nothing(site: Path, browser: Any) -> None:
    page = browser.new_page()
    page.goto((site / "index.html").as_uri())
    for width in (360, 768, 1_152, 1_440, 2_560):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") == width
        box = page.locator(PICTURE).first.bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= width and box["y"] < 900  # the film
        cut = "[...document.querySelectorAll('.table-wrapper')].map((e) => e.scrollWidth - e.clientWidth)"
        assert max(page.evaluate(cut)) <= 0, width
    page.close()
