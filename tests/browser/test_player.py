"""The report in a real browser: it loads nothing, and the player shows what the ledger says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.evaluation import Evaluation
from tests.browser.conftest import AGENTS

pytestmark = pytest.mark.slow

Open = Callable[..., Any]
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

    def time() -> float:
        return round(page.evaluate(f"{PLAYER}.time"), 6)

    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    page.keyboard.press(".")
    assert time() == 0.24
    page.keyboard.press(",")
    page.keyboard.press("ArrowLeft")
    assert time() == 0.1
    page.keyboard.press("Shift+ArrowRight")
    assert sum(impacts for impacts, _, _ in counts(page)) >= 1
    page.keyboard.press("End")
    assert time() == round(page.evaluate(f"{PLAYER}.until"), 6)
    page.keyboard.press("Home")
    assert time() == 0.0
    page.keyboard.press("ArrowDown")
    assert page.evaluate(f"{PLAYER}.world") == 1
    page.keyboard.press("ArrowUp")
    assert page.evaluate(f"{PLAYER}.world") == 0
    before = page.evaluate(f"{PLAYER}.shown.join()")
    page.keyboard.press("1")
    assert page.evaluate(f"{PLAYER}.shown.join()") != before
    page.keyboard.press("-")
    assert page.evaluate(f"{PLAYER}.speed") == 0.5
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
