"""Pages in a real browser: no sideways scroll, light and dark, print, no script, and a player that shows the ledger."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.evaluation import Evaluation, evaluate, summarise
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.figures import harm_against_total_gap
from ethbrake_marl.pages.page import Part
from ethbrake_marl.pages.report import Report
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.reproduction import Reproduction
from tests.browser.conftest import AGENTS
from tests.pages.hostile import HOSTILE
from tests.pages.test_report import whole_page

pytestmark = pytest.mark.slow


Open = Callable[..., Any]


MOST_BYTES = 5 << 20


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


PLAYER = "document.querySelector('.player').player"


def wait_until(page: Any, condition: str) -> None:
    """Wait up to ten seconds; the page's own policy forbids what Playwright would run there."""
    for _ in range(400):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(25)
    raise AssertionError(condition)


def counts(page: Any) -> list[tuple[int, float, float]]:
    """Impacts and both harms that stand above each road."""
    script = (
        "[...document.querySelectorAll('.player .head')].map((head) => ['impacts', 'first', 'total'].map((name) =>"
        " Number(head.querySelector(`[data-${name}]`).getAttribute(`data-${name}`))))"
    )
    return [(int(impacts), first, total) for impacts, first, total in page.evaluate(script)]


def test_player__ends_with_the_ledger_in_fifty_worlds(open_page: Open, report_file: Path, compared: Evaluation) -> None:
    page = open_page(report_file)
    assert page.locator(".player select").first.locator("option").count() == 50
    row_of = {int(number): row for row, number in enumerate(compared.index)}
    for shown in ((0, 1, 2), (1, 2, 3)):
        page.evaluate(f"{PLAYER}.shown = {list(shown)}")
        for k in range(50):
            page.evaluate(f"{PLAYER}.choose({k})")
            assert counts(page) == [(0, 0.0, 0.0)] * 3 or page.evaluate(f"{PLAYER}.time") == 0
            page.evaluate(f"{PLAYER}.seek(1e9)")
            row = row_of[page.evaluate(f"{PLAYER}.data.worlds[{k}].number")]
            outcomes = [compared.outcome(AGENTS[agent]) for agent in shown]
            assert counts(page) == [
                (int(each.impacts[row]), float(each.first_impact_harm[row]), float(each.total_harm[row]))
                for each in outcomes
            ]


def test_player__counts_run_along_and_never_fall(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    before = [(0, 0.0, 0.0)] * 3
    until = page.evaluate(f"{PLAYER}.until")
    for step in range(41):
        page.evaluate(f"{PLAYER}.seek({until * step / 40})")
        now = counts(page)
        assert all(a[0] <= b[0] and a[2] <= b[2] for a, b in zip(before, now, strict=True))
        before = now
    assert any(impacts for impacts, _, _ in before)


def test_player__scrubs_and_its_picture_changes(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    scrub = page.get_by_label("Time", exact=True)
    places = []
    for share in (0.0, 0.3, 0.7):
        scrub.evaluate(
            "(e, share) => { e.value = share * e.max; e.dispatchEvent(new Event('input', { bubbles: true })); }", share
        )
        places.append(page.locator(".car").first.get_attribute("transform"))
    assert len(set(places)) == 3
    assert " seconds" in scrub.get_attribute("aria-valuetext")
    trace = page.locator(".trace").first
    trace.click(position={"x": trace.bounding_box()["width"] * 0.5, "y": 60})
    assert page.evaluate(f"Math.abs({PLAYER}.time / {PLAYER}.until - 0.5) < 0.1")


def test_player__places_are_those_of_the_recorded_episode(
    open_page: Open, report_file: Path, compared: Evaluation
) -> None:
    from ethbrake_marl.agents.registry import make_agent
    from ethbrake_marl.evaluation import record_episode

    page = open_page(report_file)
    number = page.evaluate(f"{PLAYER}.data.worlds[0].number")
    row = compared.index.tolist().index(number)
    record = record_episode(compared.worlds.take([row]), make_agent("full_brake"), scenario=compared.scenario)
    page.evaluate(f"{PLAYER}.shown = [0]; {PLAYER}.build()")
    for k in range(0, len(record.time_s), 7):
        state = page.evaluate(f"stateAt({PLAYER}.episodes()[0], {float(record.time_s[k])!r})")
        assert state["front"] == pytest.approx(record.positions_m[k, 0], abs=1e-9)
        assert state["gaps"] == pytest.approx(record.gaps_m[k].tolist(), abs=1e-9)
        assert state["speeds"] == pytest.approx(record.speeds_mps[k].tolist(), abs=1e-9)


def test_player__gap_stands_at_the_vehicle_behind_it(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    page.evaluate(f"{PLAYER}.seek(0.7)")
    gaps = page.evaluate(f"stateAt({PLAYER}.episodes()[0], 0.7).gaps")
    first, *others = page.locator(".readout").first.locator(".each").all_inner_texts()
    assert "gap" not in first
    assert [text.rsplit(" · ")[1] for text in others] == [f"gap ahead {gap:.2f} m" for gap in gaps]


def test_player__gap_of_the_first_vehicle_is_that_to_an_obstacle(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    page.evaluate(f"{PLAYER}.episodes()[0].obstacle = 60; {PLAYER}.build(); {PLAYER}.seek(0.7)")
    front = page.evaluate(f"stateAt({PLAYER}.episodes()[0], 0.7).front")
    told = page.locator(".readout .each").first.inner_text()
    assert told.endswith(f"gap ahead {60.0 - front:.2f} m")


def test_player__says_which_episode_the_horizon_cut_off(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    page.evaluate(f"{PLAYER}.episodes().forEach((each, k) => {{ each.rest = k !== 1; }}); {PLAYER}.build()")
    end = page.evaluate(f"{PLAYER}.episodes()[1].end")
    told = page.locator(".head").all_inner_texts()
    assert [f"not at rest at the horizon, {end:.2f} s" in text for text in told] == [False, True, False]


def test_player__plays_in_real_time_and_pauses(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    page.get_by_role("button", name="Play").click()
    wait_until(page, f"{PLAYER}.time > 0.3")
    assert page.get_by_role("button", name="Pause").count() == 1
    page.get_by_role("button", name="Pause").click()
    stopped = page.evaluate(f"{PLAYER}.time")
    page.wait_for_timeout(150)
    assert page.evaluate(f"{PLAYER}.time") == stopped
    page.evaluate(f"{PLAYER}.seek({PLAYER}.until - 0.1)")
    page.get_by_role("button", name="Play").click()
    wait_until(page, f"!{PLAYER}.playing")
    assert page.evaluate(f"{PLAYER}.time === {PLAYER}.until")


def test_player__plays_in_few_steps_where_motion_is_not_wanted(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file, reduced_motion="reduce")
    page.evaluate(f"window.seen = new Set(); {PLAYER}.play(true)")
    page.evaluate(
        f"new Promise((done) => {{ const look = () => {{ seen.add({PLAYER}.time); {PLAYER}.time < 1 ?"
        " requestAnimationFrame(look) : done(); }; look(); })"
    )
    assert page.evaluate("seen.size") <= 6


def test_player__is_worked_by_keys_alone(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.classList.contains('player')"):
            break
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    shown = page.evaluate(f"{PLAYER}.shown.join()")
    for keys, told, expected in (
        (["ArrowRight", "ArrowRight", "."], "time.toFixed(6)", "0.240000"),
        ([",", "ArrowLeft"], "time.toFixed(6)", "0.100000"),
        (["End"], "time", page.evaluate(f"{PLAYER}.until")),
        (["Home"], "time", 0),
        (["ArrowDown"], "world", 1),
        (["ArrowUp"], "world", 0),
        (["-"], "speed", 0.5),
    ):
        for key in keys:
            page.keyboard.press(key)
        assert page.evaluate(f"{PLAYER}.{told}") == expected, keys
    page.keyboard.press("Shift+ArrowRight")
    assert sum(impacts for impacts, _, _ in counts(page)) >= 1
    page.keyboard.press("1")
    assert page.evaluate(f"{PLAYER}.shown.join()") != shown
    page.keyboard.press("Home")
    page.keyboard.press(" ")
    wait_until(page, f"{PLAYER}.time > 0.1")
    page.keyboard.press(" ")
    assert not page.evaluate(f"{PLAYER}.playing")


def test_worst_worlds__are_watched_by_a_click(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    button = page.get_by_role("button", name="Watch").nth(2)
    button.click()
    assert page.evaluate(f"{PLAYER}.data.worlds[{PLAYER}.world].number") == int(button.get_attribute("data-watch"))


def test_passport__stands_under_each_episode(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file)
    texts = page.locator(".passport code").all_inner_texts()
    assert len(texts) == 3
    assert all(text.startswith("EB1:paper-random:") and len(text) <= 160 for text in texts)
