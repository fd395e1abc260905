"""The explorer in a real browser: sliders, the engine's numbers, a profile drawn, files that read back, keys, sizes."""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.evaluation import Evaluation, evaluate
from ethbrake_marl.evaluation.inputs import make_agents, make_lineup
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario, Task, load_scenario

pytestmark = pytest.mark.slow  # what the server answers is tried without a browser, too

ROOT = Path(__file__).resolve().parents[2]
AGENTS = ("full_brake", "e_v2x_bm", "ppo@shipped", "ppo@shipped+step")
EXPLORER = "document.body.explorer"
REFUSED = "the server responded with a status of 400"  # which some tests ask for
IDLE = f"!!{EXPLORER}.found && !{EXPLORER}.busy && !{EXPLORER}.wanted"


class Served(NamedTuple):
    address: str
    folder: Path


Open = Callable[..., Any]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    pytest.importorskip("uvicorn", reason="no uvicorn: pip install 'ethbrake-marl[explore]'")
    folder = tmp_path_factory.mktemp("explored")
    command = "from ethbrake_marl.cli.app import main; main()"
    options = ["--agents", ",".join(AGENTS), "--world", "1", "--folder", str(folder), "--no-browser"]
    with subprocess.Popen(
        [sys.executable, "-c", command, "watch", "explore", *options],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        yield Served(process.stdout.readline().strip(), folder)
        process.kill()


@pytest.fixture
def open_explorer(browser: Any, served: Served) -> Iterator[Open]:
    """Opens the page and waits for its first answer; nothing is told to the console, and nobody else is asked."""
    told: list[str] = []
    contexts = []

    def open_page(*, width: int = 1280, **settings: Any) -> Any:
        context = browser.new_context(viewport={"width": width, "height": 900}, **settings)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda each: None if REFUSED in each.text else told.append(f"console: {each.text}"))
        page.on("pageerror", lambda error: told.append(f"error: {error}"))
        page.on("request", lambda each: None if each.url.startswith(served.address) else told.append(each.url))
        page.goto(served.address)
        wait_until(page, IDLE)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert told == []


def wait_until(page: Any, condition: str) -> None:
    """Wait up to two minutes: the first answer may have to compile the physics."""
    for _ in range(2_400):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(condition)


def harms(page: Any) -> dict[str, tuple[int, float, float]]:
    """Impacts, first-impact and total harm that stand in the table, by agent."""
    script = (
        "[...document.querySelectorAll('[data-part=harms] tr')].map((row) => [row.dataset.agent,"
        " Number(row.dataset.impacts), Number(row.dataset.first), Number(row.dataset.total)])"
    )
    return {name: (int(impacts), first, total) for name, impacts, first, total in page.evaluate(script)}


def of_evaluation(evaluation: Evaluation) -> dict[str, tuple[int, float, float]]:
    return {
        name: (int(each.impacts[0]), float(each.first_impact_harm[0]), float(each.total_harm[0]))
        for name, each in evaluation.outcomes.items()
    }


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("paper-random")


def evaluated(worlds: Worlds, scenario: Scenario, saved: Scenario | None = None) -> dict[str, tuple[int, float, float]]:
    """What agents of a scenario do in worlds of it, or of one that was saved from it."""
    agents = make_lineup(AGENTS, scenario)
    return of_evaluation(evaluate(worlds, agents, scenario=saved or scenario, aftermath=False))


def test_explorer__begins_with_the_world_of_the_list(open_explorer: Open, scenario: Scenario) -> None:
    page = open_explorer()
    expected = evaluated(scenario.sample(1, DEFAULT.LIST_SEED, first=1).worlds, scenario)
    shown = harms(page)
    assert {name: shown[name] for name in AGENTS} == expected
    text = page.inner_text("[data-part=harms]")
    assert all(f"{first:.2f}" in text and f"{total:.2f}" in text for _, first, total in expected.values())


def test_slider__is_answered_by_the_engine(open_explorer: Open, scenario: Scenario) -> None:
    page = open_explorer()
    before = harms(page)
    slider = page.get_by_label("Gap, 1 to 2 in m, slider")
    slider.focus()
    for _ in range(12):
        page.keyboard.press("ArrowRight")
    page.get_by_label("Mass, Vehicle 3 in t", exact=True).evaluate("(e) => e.closest('details').open = true")
    page.get_by_label("Mass, Vehicle 3 in t", exact=True).fill("12.5")
    page.get_by_label("Restitution", exact=True).fill("0.35")
    wait_until(page, IDLE)
    state = page.evaluate(f"{EXPLORER}.state")
    assert (state["mass_t"][2], state["restitution"]) == (12.5, 0.35)
    assert str(round(state["gaps_m"][0], 4)) == page.get_by_label("Gap, 1 to 2 in m", exact=True).input_value()
    shown = harms(page)
    assert {name: shown[name] for name in AGENTS} == evaluated(scenario.worlds_from_state(state), scenario)
    assert shown != before


def test_fast_moves__are_answered_for_the_newest_place(open_explorer: Open, scenario: Scenario) -> None:
    page = open_explorer()
    asked: list[str] = []
    page.on("request", lambda each: asked.append(each.url) if each.url.endswith("/answer") else None)
    page.get_by_label("Gap, 2 to 3 in m, slider").evaluate(
        "(e) => { for (let k = 0; k <= 40; k += 1) { e.value = 5 + k / 10; e.dispatchEvent(new Event('input')); } }"
    )
    wait_until(page, IDLE)
    state = page.evaluate(f"{EXPLORER}.state")
    assert state["gaps_m"][1] == 9.0 and len(asked) == 2
    shown = harms(page)
    assert {name: shown[name] for name in AGENTS} == evaluated(scenario.worlds_from_state(state), scenario)


def test_world_that_cannot_be__is_told_and_left_again(open_explorer: Open) -> None:
    page = open_explorer()
    number = page.get_by_label("Speed, Vehicle 1 in m/s", exact=True)
    number.fill("90")
    wait_until(page, IDLE)
    assert "must not be above speed_limit_mps" in page.inner_text("[data-part=state]")
    assert page.evaluate("getComputedStyle(document.querySelector('.cards')).opacity") == "0.45"
    number.fill("20")
    wait_until(page, IDLE)
    assert "Answered" in page.inner_text("[data-part=state]")


def test_page__says_what_is_wrong_with_an_input_it_cannot_use(open_explorer: Open) -> None:
    page = open_explorer()
    state, number = page.locator("[data-part=state]"), page.locator("[data-part=number]")
    number.fill("-3")
    number.press("Enter")
    assert "from 0 to" in state.inner_text() and page.locator("body.stale").count() == 1
    number.fill("1")
    number.press("Enter")
    wait_until(page, f"{IDLE} && !document.body.classList.contains('stale')")
    assert "from 0 to" not in state.inner_text()
    page.get_by_label("Speed, Vehicle 1 in m/s", exact=True).fill("")
    assert "must be a number" in state.inner_text() and page.locator("body.stale").count() == 1


def test_save__of_a_name_that_cannot_be_says_so(open_explorer: Open) -> None:
    page = open_explorer()
    name, said = page.locator("[data-part=name]"), page.locator("[data-part=saved]")
    name.fill("once")
    name.press("Enter")
    wait_until(page, "document.querySelector('[data-part=saved]').textContent === 'Saved: once.yaml'")
    name.fill("Near Miss!")
    assert said.inner_text() == ""
    name.press("Enter")
    assert "small letters" in said.inner_text() and "wrong" in (said.get_attribute("class") or "")


def test_best_known__is_one_profile_in_card_row_and_road(open_explorer: Open) -> None:
    page = open_explorer()
    wait_until(page, f"!!{EXPLORER}.best")
    for first, total in ((0.1, 0.1), (-0.1, -0.1), (0.0, 0.1), (0.0, -0.1)):  # of the search, beside the best agent
        page.evaluate(
            f"(([first, total]) => {{ const e = {EXPLORER}; clearTimeout(e.settled); e.own ??= e.found.outcomes"
            ".reduce((a, b) => (b.first < a.first || (b.first === a.first && b.total < a.total) ? b : a));"
            " Object.assign(e.best, { first: e.own.first + first, total: e.own.total + total, impacts: 77 }); e.show();"
            f" }})({[first, total]})"
        )
        searched = (first, total) < (0.0, 0.0)
        card = page.locator(".cards").inner_text()
        assert ("a search of" in card) == searched, (first, total)
        row = harms(page)["best known"]
        assert (row[0] == 77) == searched
        own = page.evaluate(f"[{EXPLORER}.own.agent, {EXPLORER}.own.impacts]")
        assert searched or (own[0] in card and row[0] == own[1])


def test_best_known__comes_when_the_sliders_rest(open_explorer: Open) -> None:
    page = open_explorer()
    wait_until(page, f"!!{EXPLORER}.best")
    shown = harms(page)
    least = page.evaluate(f"{EXPLORER}.found.verdict.proven_harm")
    constant = next(value for name, value in shown.items() if name.startswith("H*"))
    assert least <= shown["best known"][1] <= constant[1] + 1e-9
    cards = page.inner_text("[data-part=cards]")
    assert "Unavoidable" in cards and f"{constant[1]:.2f} m²/s²" in cards


def test_profile__is_drawn_by_hand_and_beats_the_policy(open_explorer: Open, scenario: Scenario) -> None:
    page = open_explorer()
    editor = page.locator("[data-part=editor]")
    editor.scroll_into_view_if_needed()
    box = editor.bounding_box()
    page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 0.8 * box["height"])
    page.mouse.down()
    for share in (0.4, 0.6, 0.8):
        page.mouse.move(box["x"] + share * box["width"], box["y"] + (0.9 - 0.5 * share) * box["height"], steps=3)
    page.mouse.up()
    wait_until(page, IDLE)
    commands = page.evaluate(f"{EXPLORER}.editor.commands")
    assert len(commands) == 75 and len(set(commands[:30])) > 5 and min(commands) >= -7.0
    drawn = harms(page)["by hand"]
    from ethbrake_marl.pages.explorer import Explored, HandDriven, outcome, read_profile

    world = scenario.sample(1, DEFAULT.LIST_SEED, first=1).worlds
    explored = Explored(Task(scenario, scenario.learners), make_agents(["full_brake"], scenario))
    expected = outcome("by hand", explored.follow(world, HandDriven(read_profile(commands), scenario.time_step_s)))
    assert drawn == (expected["impacts"], expected["first"], expected["total"])

    wait_until(page, f"!!{EXPLORER}.best")
    page.locator("[data-part=from]").select_option("best")
    wait_until(page, f"{IDLE} && {EXPLORER}.found.outcomes.at(-1).first === {EXPLORER}.best.first")
    page.locator("[data-part=rival]").select_option("0")
    assert "You beat full_brake by" in page.inner_text("[data-part=score]")


def test_profile__is_changed_by_keys(open_explorer: Open) -> None:
    page = open_explorer()
    page.locator("[data-part=editor]").focus()
    before = harms(page)["by hand"]
    for key in ("ArrowRight", "ArrowUp", "ArrowUp", "Shift+ArrowUp", "Enter"):
        page.keyboard.press(key)
    wait_until(page, IDLE)
    assert page.evaluate(f"{EXPLORER}.editor.commands.slice(0, 3)") == [-7, -5.9, -5.9]
    assert "From 0.60 s: −5.90 m/s²." in page.inner_text("[data-explorer=profile]")
    assert harms(page)["by hand"] != before


def test_begin_from__an_agent_drives_as_the_agent(open_explorer: Open) -> None:
    page = open_explorer()
    page.locator("[data-part=from]").select_option(label="ppo@shipped")
    wait_until(page, f"{IDLE} && {EXPLORER}.found.outcomes.at(-1).first === {EXPLORER}.found.outcomes[2].first")
    shown = harms(page)
    assert shown["by hand"] == shown["ppo@shipped"]


def test_save__reads_back_to_the_same_harm(open_explorer: Open, served: Served, scenario: Scenario) -> None:
    page = open_explorer()
    page.get_by_label("Speed, Vehicle 3 in m/s", exact=True).fill("24.3")
    wait_until(page, IDLE)
    page.get_by_label("Name", exact=True).fill("near-miss")
    page.get_by_role("button", name="Save as a scenario").click()
    wait_until(page, "document.querySelector('[data-part=saved]').textContent === 'Saved: near-miss.yaml'")
    page.get_by_role("button", name="Save as initial states").click()
    wait_until(page, "document.querySelector('[data-part=saved]').textContent === 'Saved: near-miss.csv'")
    shown = {name: value for name, value in harms(page).items() if name in AGENTS}
    saved = load_scenario(served.folder / "near-miss.yaml")
    assert evaluated(saved.sample(1, 3).worlds, scenario, saved) == shown
    assert evaluated(scenario.read_worlds(served.folder / "near-miss.csv"), scenario) == shown
    page.get_by_role("button", name="Save as a scenario").click()
    wait_until(page, "document.querySelector('[data-part=saved]').textContent.includes('is there already')")


def test_player__shows_every_agent_and_ends_with_the_table(open_explorer: Open) -> None:
    page = open_explorer()
    page.evaluate(f"{EXPLORER}.player.seek(1e9)")
    heads = page.evaluate(
        "[...document.querySelectorAll('.player .head')].map((head) => [head.querySelector('strong').textContent,"
        " ...['impacts', 'first', 'total'].map((n) => Number(head.querySelector(`[data-${n}]`).dataset[n]))])"
    )
    shown = harms(page)
    assert len(heads) >= 5
    assert all(shown[name] == (impacts, first, total) for name, impacts, first, total in heads)
    page.evaluate(f"{EXPLORER}.player.seek(1.2)")
    page.get_by_label("Speed, Vehicle 2 in m/s", exact=True).fill("20.5")
    wait_until(page, IDLE)
    assert page.evaluate(f"{EXPLORER}.player.time") == 1.2


def test_other_world__is_fetched(open_explorer: Open, scenario: Scenario) -> None:
    page = open_explorer()
    page.get_by_role("button", name="World after").click()
    wait_until(page, f"{IDLE} && document.querySelector('[data-part=number]').value === '2'")
    wait_until(page, f"{EXPLORER}.found.world.conditions.includes('d')")
    expected = evaluated(scenario.sample(1, DEFAULT.LIST_SEED, first=2).worlds, scenario)
    wait_until(page, f"{EXPLORER}.found.outcomes[0].total === {expected['full_brake'][2]}")
    assert {name: value for name, value in harms(page).items() if name in AGENTS} == expected


def test_page__has_no_sideways_scroll_and_both_schemes(open_explorer: Open) -> None:
    page = open_explorer()
    wait_until(page, f"!!{EXPLORER}.best")
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    for width, scheme in itertools.product((360, 768, 1440), ("light", "dark")):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        back, ink = page.evaluate(
            "[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]"
        )
        light = [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in (back, ink)]
        assert (light[0] < light[1]) == (scheme == "dark"), (width, scheme)


def test_page__is_worked_by_keys_alone(open_explorer: Open) -> None:
    page = open_explorer()
    reached = set()
    for _ in range(120):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.dataset.part ?? document.activeElement.className"))
        outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert outline != "none" or page.evaluate("document.activeElement === document.body")
    assert {"number", "from", "rival", "editor", "player live ready", "name"} <= reached


def test_other_page__cannot_reach_the_server(browser: Any, served: Served, tmp_path: Path) -> None:
    """A page of somebody else's that even knows the address gets nothing, and changes nothing."""
    page = browser.new_context().new_page()
    other = tmp_path / "other.html"
    other.write_text("<!DOCTYPE html><title>other</title>")
    page.goto(other.as_uri())
    script = (
        "(address) => Promise.all(['no-cors', 'cors'].map((mode) => fetch(address + 'save', {mode, method: 'POST',"
        " body: '{}'}).then((reply) => reply.type === 'opaque' ? 'opaque' : 'read', () => 'refused')))"
    )
    before = sorted(each.name for each in served.folder.iterdir())
    blind, seeing = page.evaluate(script, served.address)
    assert (blind in ("opaque", "refused"), seeing) == (True, "refused")
    assert sorted(each.name for each in served.folder.iterdir()) == before
