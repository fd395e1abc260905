"""The report in a real browser: sizes, schemes, print, keys, the player and its ledger."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.record import record_episode
from ethbrake_marl.extensions.report.report import ReportPage
from tests.extensions.report.conftest import AGENTS, compared_by
from tests.extensions.report.test_page import whole_page
from tests.fixtures.browser import wait_until
from tests.fixtures.page import HOSTILE

pytestmark = pytest.mark.slow
Open = Callable[..., Any]
MOST_BYTES = 5 << 20


@pytest.fixture
def report_page(open_page: Open, report_file: Path) -> Any:
    return open_page(report_file.as_uri())


def write_report(path: Path, names: tuple[str, ...]) -> Path:
    found = compared_by("paper-random", {name: f"constant:{k + 1}.5" for k, name in enumerate(names)}, 12)
    ReportPage("t", found, "s", {names[0]: "1", names[1]: "y" * 64}, focus=names[0]).write(path)
    return path


@pytest.fixture(scope="module")
def long_names_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report whose agents are called by the files they come from."""
    names = ("my_agent_file_with_a_long_name_of_a_policy.py:drive+step", "x" * 120)
    return write_report(tmp_path_factory.mktemp("long") / "report.html", names)


@pytest.mark.parametrize("name", ["report_file", "long_names_file"])
def test_page__never_scrolls_sideways_and_is_no_giant(open_page: Open, name: str, request: Any) -> None:
    path = request.getfixturevalue(name)
    page = open_page(path.as_uri())
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    for width in (360, 500, 768, 1440):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") == width
        outside = page.evaluate(
            "[...document.querySelectorAll('body *')].filter((e) => e.getBoundingClientRect().right > innerWidth + 1 &&"
            " !e.closest('.wide, .drawing, svg, .skip')).map((e) => e.outerHTML.slice(0, 80))"
        )
        assert outside == [], width
    assert path.stat().st_size <= MOST_BYTES


CUT = """
[...document.querySelectorAll('.top h1, .lead, .remarks li, .beside .wide, .beside :is(caption, th, td), .box, .pick')]
  .filter((e) => e.scrollWidth > e.clientWidth + 1)
  .map((e) => `${e.tagName} ${e.textContent.slice(0, 40)}`)
"""
WIDEST_WORLD = """(select => {
  const style = getComputedStyle(select), pen = document.createElement('canvas').getContext('2d');
  pen.font = `${style.fontWeight} ${style.fontSize} ${style.fontFamily}`;
  return Math.max(...[...select.options].map((each) => pen.measureText(each.text).width)) +
    parseFloat(style.paddingLeft) + parseFloat(style.paddingRight) + 16 - select.clientWidth;
})(document.querySelector('.pick select'))"""


def test_first_screen__cuts_nothing(open_page: Open, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    agents = "full_brake,e_v2x_bm,e_v2x_bm:pairwise,ppo+step"
    ReportPage("paper-random: four agents", compared_by("paper-random", agents, 60, "honest"), "s", {}).write(path)
    page = open_page(path.as_uri())
    for width in (360, 768, 1_152, 1_440, 2_560):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate(CUT) == [], width
        assert page.evaluate(WIDEST_WORLD) <= 0, width  # an option and the arrow of the list


SMALLEST_PT = 8.0  # of the letters in our figures
NATURAL_PX = "(e => e.getBoundingClientRect().width / e.naturalWidth)(document.querySelectorAll('figure img')[{}])"


def test_figures__follow_the_scheme_and_can_be_read_on_a_telephone(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file.as_uri(), width=360, color_scheme="dark")
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    figures = page.locator("figure img").count()
    assert figures >= 2
    for k in range(figures):
        assert page.evaluate(NATURAL_PX.format(k)) * SMALLEST_PT * 96 / 72 >= 8.99, k
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1_440, "height": 900})
    light = np.asarray(Image.open(io.BytesIO(page.locator("figure img").first.screenshot())).convert("L"))
    page.emulate_media(color_scheme="dark")
    dark = np.asarray(Image.open(io.BytesIO(page.locator("figure img").first.screenshot())).convert("L"))
    assert np.median(light) == 255 and np.median(dark) < 40 and dark.max() > 230  # paper and ink


def test_pages__hostile_texts_run_nothing_and_load_nothing(open_page: Open, tmp_path: Path) -> None:
    path = tmp_path / "hostile.html"
    path.write_text(whole_page("nothing"), "utf-8")
    page = open_page(path.as_uri())
    for text in HOSTILE:
        path.write_text(whole_page(text), "utf-8")
        page.reload()
        assert page.locator("script, iframe, img, form, a[href^=javascript]").count() == 2  # our own script and figure
    page = open_page(write_report(tmp_path / "report.html", HOSTILE[:5]).as_uri())
    for key in "123456789":
        page.locator(".player").press(key)
    assert page.locator(".player img, .player script, .player iframe").count() == 0
    assert page.locator(".head strong").first.inner_text() in HOSTILE


# ---------------------------------------------------------------- the player

PLAYER = "document.querySelector('.player').player"


def counts(page: Any) -> list[tuple[int, float, float]]:
    """Impacts and both harms that stand above each road."""
    script = (
        "[...document.querySelectorAll('.player .head')].map((head) => ['impacts', 'first', 'total'].map((name) =>"
        " Number(head.querySelector(`[data-${name}]`).getAttribute(`data-${name}`))))"
    )
    return [(int(impacts), first, total) for impacts, first, total in page.evaluate(script)]


def test_player__ends_with_the_ledger_in_fifty_worlds_and_counts_never_fall(
    report_page: Any, compared: Comparison
) -> None:
    row_of = {int(number): row for row, number in enumerate(compared.result.worlds["world"])}
    for shown in ((0, 1, 2), (1, 2, 3)):
        report_page.evaluate(f"{PLAYER}.shown = {list(shown)}")
        for k in range(50):
            report_page.evaluate(f"{PLAYER}.choose({k})")
            before = counts(report_page)
            assert before == [(0, 0.0, 0.0)] * 3 and report_page.evaluate(f"{PLAYER}.time") == 0
            for time in (0.8, 1.2, 1.6, 1e9):
                report_page.evaluate(f"{PLAYER}.seek({time})")
                now = counts(report_page)
                assert all(a[0] <= b[0] and a[2] <= b[2] for a, b in zip(before, now, strict=True))
                before = now
            row = row_of[report_page.evaluate(f"{PLAYER}.data.worlds[{k}].number")]
            outcomes = [compared.result[AGENTS[agent]] for agent in shown]
            assert before == [
                (each["impacts"][row], each["first_impact_harm"][row], each["total_harm"][row]) for each in outcomes
            ]


def test_player__places_are_those_of_the_recorded_episode(report_page: Any, compared: Comparison) -> None:
    number = report_page.evaluate(f"{PLAYER}.data.worlds[0].number")
    record = record_episode("paper-random", compared.teams["full_brake"], number=number, sample_s=0.005)
    report_page.evaluate(f"{PLAYER}.shown = [0]; {PLAYER}.build()")
    for k in range(0, len(record.time_s), 27):
        state = report_page.evaluate(f"stateAt({PLAYER}.episodes()[0], {float(record.time_s[k])!r})")
        told = [state["front"], *state["gaps"], *state["speeds"]]
        assert told == pytest.approx([record.positions_m[k, 0], *record.gaps_m[k], *record.speeds_mps[k]], abs=1e-5)


def test_player__is_worked_by_keys_alone(report_page: Any) -> None:
    for _ in range(60):
        report_page.keyboard.press("Tab")
        if report_page.evaluate("document.activeElement.classList.contains('player')"):
            break
    assert report_page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    shown = report_page.evaluate(f"{PLAYER}.shown.join()")
    report_page.evaluate(f"{PLAYER}.choose(0)")  # from the alert, and not playing
    for keys, told, expected in (
        (["ArrowRight", "ArrowRight", "."], "time.toFixed(6)", "0.240000"),
        ([",", "ArrowLeft"], "time.toFixed(6)", "0.100000"),
        (["End"], "time", report_page.evaluate(f"{PLAYER}.until")),
        (["Home"], "time", 0),
        (["ArrowDown"], "world", 1),
        (["ArrowUp"], "world", 0),
        (["-"], "speed", 0.5),
    ):
        for key in keys:
            report_page.keyboard.press(key)
        assert report_page.evaluate(f"{PLAYER}.{told}") == expected, keys
    report_page.keyboard.press("Shift+ArrowRight")
    assert sum(impacts for impacts, _, _ in counts(report_page)) >= 1
    for key in ("1", "Home", " "):
        report_page.keyboard.press(key)
    wait_until(report_page, f"{PLAYER}.time > 0.1")
    report_page.keyboard.press(" ")
    assert report_page.evaluate(f"[{PLAYER}.shown.join() === '{shown}', {PLAYER}.playing]") == [False, False]


def test_worst_worlds__are_watched_by_a_click(report_page: Any) -> None:
    button = report_page.get_by_role("button", name="Watch").nth(2)
    button.click()
    number = report_page.evaluate(f"{PLAYER}.data.worlds[{PLAYER}.world].number")
    assert number == int(button.get_attribute("data-watch"))
