"""The report in a real browser: sizes, schemes, print, keys, the player and its ledger."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.learned import TRAINED_POLICY
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.extensions.report.report import Report
from ethbrake_marl.extensions.reproduction.folder import Reproduction
from ethbrake_marl.extensions.reproduction.making import choose_items, make_items
from ethbrake_marl.scenario.catalogue import load_scenario
from tests.extensions.report.browser.conftest import AGENTS, PAPER, wait_until
from tests.extensions.report.test_report import whole_page
from tests.fixtures.page import HOSTILE

pytestmark = pytest.mark.slow
Open = Callable[..., Any]
MOST_BYTES = 5 << 20


@pytest.fixture
def report_page(open_page: Open, report_file: Path) -> Any:
    """The report, opened."""
    return open_page(report_file.as_uri())


@pytest.fixture(scope="module")
def reproduction_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of three items of the paper made again in few worlds."""
    settings = Reproduction("quick", tmp_path_factory.mktemp("reproduction") / "out", 10)
    make_items(settings, choose_items(["harm-distance", "accelerations", "gaps"]))
    return settings.folder / "index.html"


def write_report(path: Path, names: tuple[str, ...], **settings: Any) -> Path:
    """A report of agents by these names in few worlds."""
    specs = [f"constant:{k}.5" for k in range(1, len(names) + 1)]
    agents = dict(zip(names, make_lineup(specs, PAPER).values(), strict=True))
    found = eb.evaluate(PAPER.sample(12, 7), agents, scenario=PAPER, seed=7)
    Report("t", eb.summarise(found), found, focus=names[0], **settings).driven(agents).write(path)
    return path


@pytest.fixture(scope="module")
def long_names_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report whose agents are called by the files they come from."""
    names = ("my_agent_file_with_a_long_name_of_a_policy.py:drive+step", "x" * 120)
    versions = {names[0]: "1", names[1]: "y" * 64}
    return write_report(tmp_path_factory.mktemp("long") / "report.html", names, versions=versions)


@pytest.mark.parametrize("name", ["report_file", "reproduction_file", "long_names_file"])
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
    assert name != "reproduction_file" or page.evaluate("document.querySelectorAll('figure img').length") == 3
    assert path.stat().st_size <= MOST_BYTES


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of as many agents, tests and remarks as one of ``ethbrake run``."""
    specs = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "ppo", "ppo+episode")
    names = (*specs[:3], TRAINED_POLICY, "hybrid")
    found = {}
    for name in ("paper-random", "paper-random-obstacle"):
        scenario = load_scenario(name)
        agents = dict(zip(names, make_lineup(specs, scenario).values(), strict=True))
        found[name] = eb.evaluate(scenario.sample(60, 7), agents, scenario=scenario, seed=7)
    main, other = found.values()
    report = Report(
        "ethbrake run: paper-random", eb.summarise(main), main, focus=TRAINED_POLICY,
        tests=[("Brake-only test", "x", eb.summarise(main)), ("Obstacle test", "y", eb.summarise(other))],
        remarks=["The training was interrupted: this is the policy after 100,000 steps."],
    )  # fmt: skip
    path = tmp_path_factory.mktemp("run") / "report.html"
    report.write(path)
    return path


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_report__sentence_figure_and_table_of_four_columns_stand_above_the_fold(
    open_page: Open, run_file: Path, width: int, height: int
) -> None:
    page = open_page(run_file.as_uri(), width=width)
    page.set_viewport_size({"width": width, "height": height})
    bottoms = {
        name: page.evaluate(f"document.querySelector('{name}').getBoundingClientRect().bottom")
        for name in (".lead", ".beside img", ".beside table")
    }
    assert all(0 < bottom <= height for bottom in bottoms.values()), bottoms
    assert page.locator(".beside thead th").count() == 4 and page.locator(".beside tbody tr").count() == 5
    for name in (".beside .wide", ".beside .drawing"):  # nothing is hidden at the side
        assert page.evaluate(f"(e => e.scrollWidth <= e.clientWidth)(document.querySelector('{name}'))")
    assert page.locator(".remarks li").count() == 3
    least_px = page.evaluate("(e => e.clientWidth / e.naturalWidth * 96 / 72)(document.querySelector('.beside img'))")
    assert least_px * 8.0 >= 9.0  # labels are of 8 pt or more


def test_figures__say_that_they_scroll_and_can_be_read(report_page: Any) -> None:
    broad = "document.querySelector('.drawing:has(img.broad)')"
    for width, hint in ((360, "block"), (768, "block"), (1440, "none")):
        report_page.set_viewport_size({"width": width, "height": 900})
        assert report_page.evaluate(f"getComputedStyle({broad}, '::before').display") == hint
        assert report_page.evaluate(f"{broad}.scrollWidth > {broad}.clientWidth") == (hint == "block")
        least_px = report_page.evaluate(
            "Math.min(...[...document.querySelectorAll('.drawing img')]"
            ".map((e) => e.clientWidth / e.naturalWidth * 96 / 72))"
        )
        assert least_px * 8.0 >= 9.0  # labels are of 8 pt or more


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_report__can_be_read_in_light_and_dark_and_prints_light(open_page: Open, report_file: Path, scheme) -> None:
    page = open_page(report_file.as_uri(), color_scheme=scheme)
    script = (
        "(names) => names.map((name) => { const e = document.createElement('i'); e.style.color = `var(--${name})`;"
        " document.body.append(e); return getComputedStyle(e).color.match(/\\d+/g).map(Number); })"
    )
    names = ["paper", "ink", "quiet", "accent", "warn", *(f"series-{k}" for k in range(5))]
    paper, *colours = (np.array(c) for c in page.evaluate(script, names))
    assert (paper.mean() < 128) == (scheme == "dark")
    assert all(contrast(colour, paper) >= least for colour, least in zip(colours, [4.5] * 4 + [2.7] * 5, strict=True))
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.querySelector('section')).backgroundColor") == "rgb(255, 255, 255)"
    assert page.locator(".controls").is_hidden() and page.locator(".lane").first.is_visible()


def contrast(first: np.ndarray, second: np.ndarray) -> float:
    """Ratio of luminances, as WCAG defines it."""
    c = np.stack([first, second]) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    lights = linear @ [0.2126, 0.7152, 0.0722] + 0.05
    return float(lights.max() / lights.min())


def test_report__says_what_is_missing_without_scripts_and_every_control_has_a_name(
    open_page: Open, report_file: Path, report_page: Any
) -> None:
    page = open_page(report_file.as_uri(), java_script_enabled=False)
    assert page.get_by_text("scripts are switched off in this browser").is_visible()
    assert page.get_by_text("Means with 95 % intervals").is_visible() and page.locator(".controls").is_hidden()
    nameless = report_page.evaluate(
        "[...document.querySelectorAll('button, input, select, [role=img], [role=region], [tabindex=\"0\"]')]"
        ".filter((e) => !(e.getAttribute('aria-label') || e.textContent.trim() || e.labels?.length))"
        ".map((e) => e.outerHTML)"
    )
    assert nameless == [] and report_page.locator("h1").count() == 1


def test_pages__hostile_texts_run_nothing_and_load_nothing(open_page: Open, tmp_path: Path) -> None:
    path = tmp_path / "hostile.html"
    path.write_text(whole_page("nothing"), "utf-8")
    page = open_page(path.as_uri())
    for text in HOSTILE:
        path.write_text(whole_page(text), "utf-8")
        page.reload()
        assert page.locator("script, iframe, img, form, a[href^=javascript]").count() == 0
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
    report_page: Any, compared: eb.Evaluation
) -> None:
    row_of = {int(number): row for row, number in enumerate(compared.index)}
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
            outcomes = [compared.outcome(AGENTS[agent]) for agent in shown]
            assert before == [
                (each.impacts[row], each.first_impact_harm[row], each.total_harm[row]) for each in outcomes
            ]


def test_player__scrubs_and_its_picture_changes(report_page: Any) -> None:
    scrub = report_page.get_by_label("Time", exact=True)
    places = []
    for share in (0.0, 0.3, 0.7):
        scrub.evaluate(
            "(e, share) => { e.value = share * e.max; e.dispatchEvent(new Event('input', { bubbles: true })); }", share
        )
        places.append(report_page.locator(".car").first.get_attribute("transform"))
    assert len(set(places)) == 3 and " seconds" in scrub.get_attribute("aria-valuetext")
    trace = report_page.locator(".trace").first
    trace.click(position={"x": trace.bounding_box()["width"] * 0.5, "y": 60})
    assert report_page.evaluate(f"Math.abs({PLAYER}.time / {PLAYER}.until - 0.5) < 0.1")


def test_player__places_are_those_of_the_recorded_episode(report_page: Any, compared: eb.Evaluation) -> None:
    row = compared.index.tolist().index(report_page.evaluate(f"{PLAYER}.data.worlds[0].number"))
    record = eb.record_episode(compared.worlds.take([row]), eb.make_agent("full_brake"), scenario=PAPER)
    report_page.evaluate(f"{PLAYER}.shown = [0]; {PLAYER}.build()")
    for k in range(0, len(record.time_s), 7):
        state = report_page.evaluate(f"stateAt({PLAYER}.episodes()[0], {float(record.time_s[k])!r})")
        told = [state["front"], *state["gaps"], *state["speeds"]]
        assert told == pytest.approx([record.positions_m[k, 0], *record.gaps_m[k], *record.speeds_mps[k]], abs=1e-9)


def test_player__says_each_gap_also_to_an_obstacle_and_whom_the_horizon_cut_off(report_page: Any) -> None:
    report_page.evaluate(f"{PLAYER}.seek(0.7)")
    gaps = report_page.evaluate(f"stateAt({PLAYER}.episodes()[0], 0.7).gaps")
    first, *others = report_page.locator(".readout").first.locator(".each").all_inner_texts()
    assert "gap" not in first
    assert [text.rsplit(" · ")[1] for text in others] == [f"gap ahead {gap:.2f} m" for gap in gaps]
    report_page.evaluate(
        f"{PLAYER}.episodes().forEach((each, k) => {{ each.rest = k !== 1; each.obstacle = 60; }});"
        f" {PLAYER}.build(); {PLAYER}.seek(0.7)"
    )
    front = report_page.evaluate(f"stateAt({PLAYER}.episodes()[0], 0.7).front")
    assert report_page.locator(".readout .each").first.inner_text().endswith(f"gap ahead {60.0 - front:.2f} m")
    end = report_page.evaluate(f"{PLAYER}.episodes()[1].end")
    told = report_page.locator(".head").all_inner_texts()
    assert [f"a vehicle still moves at the horizon, {end:.2f} s" in text for text in told] == [False, True, False]


def test_player__plays_in_real_time_and_pauses(report_page: Any) -> None:
    report_page.get_by_role("button", name="Play").click()
    wait_until(report_page, f"{PLAYER}.time > 0.3")
    report_page.get_by_role("button", name="Pause").click()
    stopped = report_page.evaluate(f"{PLAYER}.time")
    report_page.wait_for_timeout(150)
    assert report_page.evaluate(f"{PLAYER}.time") == stopped
    report_page.evaluate(f"{PLAYER}.seek({PLAYER}.until - 0.1)")
    report_page.get_by_role("button", name="Play").click()
    wait_until(report_page, f"!{PLAYER}.playing")
    assert report_page.evaluate(f"{PLAYER}.time === {PLAYER}.until")


def test_player__plays_in_few_steps_where_motion_is_not_wanted(open_page: Open, report_file: Path) -> None:
    page = open_page(report_file.as_uri(), reduced_motion="reduce")
    page.evaluate(f"window.seen = new Set(); {PLAYER}.play(true)")
    page.evaluate(
        f"new Promise((done) => {{ const look = () => {{ seen.add({PLAYER}.time); {PLAYER}.time < 1 ?"
        " requestAnimationFrame(look) : done(); }; look(); })"
    )
    assert page.evaluate("seen.size") <= 6


def test_player__is_worked_by_keys_alone(report_page: Any) -> None:
    for _ in range(60):
        report_page.keyboard.press("Tab")
        if report_page.evaluate("document.activeElement.classList.contains('player')"):
            break
    assert report_page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    shown = report_page.evaluate(f"{PLAYER}.shown.join()")
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
