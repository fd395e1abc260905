"""Pages in a real browser: no sideways scroll, light and dark, print, no script, size and time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.figures import harm_against_total_gap
from ethbrake_marl.pages.page import Part
from ethbrake_marl.pages.report import Report
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.reproduction import Reproduction
from tests.browser.conftest import AGENTS
from tests.pages.hostile import HOSTILE
from tests.pages.test_frame import whole_page

pytestmark = pytest.mark.slow

Open = Callable[..., Any]
MOST_BYTES = 5 << 20
MOST_MS = 2_000


def test_report__never_scrolls_sideways(open_page: Open, report_file: Path) -> None:
    check_widths(open_page(report_file), 360, 500, 768, 1440)


def test_reproduction__never_scrolls_sideways(open_page: Open, reproduction_file: Path) -> None:
    page = open_page(reproduction_file)
    check_widths(page, 360, 1440)
    assert page.evaluate("document.querySelectorAll('svg').length") == 3


@pytest.fixture(scope="module")
def reproduction_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of three items of the paper made again in few worlds."""
    settings = Reproduction("quick", tmp_path_factory.mktemp("reproduction") / "out", 10)
    settings.make(Reproduction.choose(["harm-distance", "accelerations", "gaps"]))
    return settings.folder / "index.html"


def test_figures__say_that_they_scroll_and_can_be_read(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    broad = "document.querySelector('.drawing:has(svg.broad)')"
    for width, hint in ((360, "block"), (768, "block"), (1440, "none")):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate(f"getComputedStyle({broad}, '::before').display") == hint
        assert page.evaluate(f"{broad}.scrollWidth > {broad}.clientWidth") == (hint == "block")
        least_px = page.evaluate(
            "Math.min(...[...document.querySelectorAll('.drawing svg')]"
            ".map((e) => e.clientWidth / e.viewBox.baseVal.width))"
        )
        assert least_px * 8.0 >= 9.0  # labels are of 8 pt or more
        assert page.locator("figure > p").first.evaluate("(e) => parseFloat(getComputedStyle(e).fontSize)") >= 13.0


def check_widths(page: Any, *widths: int) -> None:
    """Nothing stands outside a page whose every part is open."""
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    for width in widths:
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") == width
        outside = page.evaluate(
            "[...document.querySelectorAll('body *')].filter((e) => e.getBoundingClientRect().right > innerWidth + 1 &&"
            " !e.closest('.wide, .drawing, svg, .skip')).map((e) => e.outerHTML.slice(0, 80))"
        )
        assert outside == [], width


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_report__can_be_read_in_light_and_dark(open_page: Open, report_file: Path, scheme: str) -> None:
    page = open_page(report_file, color_scheme=scheme)
    script = (
        "(names) => names.map((name) => { const e = document.createElement('i'); e.style.color = `var(--${name})`;"
        " document.body.append(e); return getComputedStyle(e).color.match(/\\d+/g).map(Number); })"
    )
    paper, *inks = (np.array(c) for c in page.evaluate(script, ["paper", "ink", "quiet", "accent", "warn"]))
    assert (paper.mean() < 128) == (scheme == "dark")
    assert all(contrast(ink, paper) >= 4.5 for ink in inks)
    series = (np.array(c) for c in page.evaluate(script, [f"series-{k}" for k in range(5)]))
    assert all(contrast(colour, paper) >= 2.7 for colour in series)


def contrast(first: np.ndarray, second: np.ndarray) -> float:
    """Ratio of luminances, as WCAG defines it."""
    lights = []
    for colour in (first, second):
        c = colour / 255.0
        linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        lights.append(float(linear @ [0.2126, 0.7152, 0.0722]) + 0.05)
    return max(lights) / min(lights)


def test_report__prints_light_and_without_controls(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file, color_scheme="dark")
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.querySelector('section')).backgroundColor") == "rgb(255, 255, 255)"
    assert page.locator(".controls").is_hidden()
    assert page.locator(".lane").first.is_visible()
    assert page.pdf().startswith(b"%PDF")


def test_report__without_scripts_says_what_is_missing(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file, java_script_enabled=False)
    assert page.get_by_text("scripts are switched off here").is_visible()
    assert page.get_by_text("Means with 95 % intervals").is_visible()
    assert page.locator(".controls").is_hidden()


def test_report__every_control_has_a_name(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    nameless = page.evaluate(
        "[...document.querySelectorAll('button, input, select, [role=img], [role=region], [tabindex=\"0\"]')]"
        ".filter((e) => !(e.getAttribute('aria-label') || e.textContent.trim() || e.labels?.length))"
        ".map((e) => e.outerHTML)"
    )
    assert nameless == []
    assert page.locator("h1").count() == 1


def test_pages__hostile_texts_run_nothing_and_load_nothing(open_page: Open, tmp_path: Path) -> None:
    path = tmp_path / "hostile.html"
    path.write_text(whole_page("nothing"), "utf-8")
    page = open_page(path)
    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    for text in HOSTILE:
        path.write_text(whole_page(text), "utf-8")
        page.reload()
        assert page.locator("script, iframe, img, form, a[href^=javascript]").count() == 0


def test_report__hostile_agent_is_text_in_the_player(open_page: Open, tmp_path: Path) -> None:
    scenario = load_scenario("paper-random")
    agents = dict(
        zip(HOSTILE[:5], make_lineup([f"constant:{k}.5" for k in range(1, 6)], scenario).values(), strict=True)
    )
    found = evaluate(scenario.sample(12, 7), agents, scenario=scenario, seed=7)
    rows = summarise(found)
    path = tmp_path / "report.html"
    Report("t", rows, found, focus=rows[0].agent).driven(agents).write(path)
    page = open_page(path)
    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    for key in "123456789":
        page.locator(".player").press(key)
    assert page.locator(".player img, .player script, .player iframe").count() == 0
    assert page.locator(".head strong").first.inner_text() in HOSTILE


def test_report__long_names_never_scroll_sideways(open_page: Open, long_names_file: Path) -> None:
    check_widths(open_page(long_names_file), 360, 768)


@pytest.fixture(scope="module")
def long_names_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report whose agents are called by the files they come from."""
    scenario = load_scenario("paper-random")
    names = ("my_agent_file_with_a_long_name_of_a_policy.py:drive+step", "x" * 120)
    agents = dict(zip(names, make_lineup(["constant:2", "constant:3"], scenario).values(), strict=True))
    found = evaluate(scenario.sample(12, 7), agents, scenario=scenario, seed=7)
    rows, focus = summarise(found), names[0]
    path = tmp_path_factory.mktemp("long") / "report.html"
    versions = {names[0]: "1", names[1]: "y" * 64}
    Report("t", rows, found, focus=focus, versions=versions).driven(agents).write(path)
    return path


@pytest.mark.long
def test_report__of_ten_thousand_worlds_is_small_and_soon_ready(open_page: Open, tmp_path: Path) -> None:
    scenario = load_scenario("paper-random")
    names = (*AGENTS[:2], "e_v2x_bm:pairwise", *AGENTS[3:], "best_harm")
    agents = make_lineup(names, scenario)
    found = evaluate(scenario.sample(10_000, 7), agents, scenario=scenario, seed=7)
    rows = summarise(found)
    figure = Part.drawing(harm_against_total_gap(found), "Harm against the gap", "Mean harm by gap.")
    path = tmp_path / "report.html"
    Report("t", rows, found, figures=[figure]).driven(agents).write(path)
    page = open_page(path)
    ready = page.evaluate("performance.now()")
    assert page.evaluate("document.querySelector('.player').classList.contains('ready')")
    print(f"{path.stat().st_size / 1e6:.2f} MB, ready after {ready:.0f} ms")
    assert path.stat().st_size <= MOST_BYTES
    assert ready <= MOST_MS
