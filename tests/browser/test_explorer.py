"""The explorer in a real browser: sliders, the engine's numbers, a profile drawn, files that read back, keys, sizes."""

import itertools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.evaluation.inputs import make_agents, make_lineup
from ethbrake_marl.pages.explorer import Explored, HandDriven, outcome, read_profile
from ethbrake_marl.scenario import Scenario, Task, load_scenario
from tests.browser.conftest import PAPER, wait_until
from tests.pages.test_explorer import Running, started

pytestmark = pytest.mark.slow  # what the server answers is tried without a browser, too

AGENTS = ("full_brake", "e_v2x_bm", "ppo@shipped", "ppo@shipped+step")
EXPLORER = "document.body.explorer"
IDLE = f"!!{EXPLORER}.found && !{EXPLORER}.busy && !{EXPLORER}.wanted"
Harms = dict[str, tuple[int, float, float]]  # impacts, first-impact and total harm, by agent
WORLD = PAPER.sample(1, DEFAULT.LIST_SEED, first=1).worlds  # with which the page begins


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with started(tmp_path_factory.mktemp("explored"), "--world", "1", agents=",".join(AGENTS)) as server:
        yield server


@pytest.fixture
def page(open_page: Callable[..., Any], served: Running) -> Any:
    """The page with its first answer."""
    opened = open_page(served.address.geturl())
    wait_until(opened, IDLE)
    return opened


def harms(page: Any) -> Harms:
    """What stands in the table."""
    script = (
        "[...document.querySelectorAll('[data-part=harms] tr')].map((row) => [row.dataset.agent,"
        " Number(row.dataset.impacts), Number(row.dataset.first), Number(row.dataset.total)])"
    )
    return {name: (int(impacts), first, total) for name, impacts, first, total in page.evaluate(script)}


def check_harms(page: Any, *evaluated: tuple[eb.Worlds, Scenario]) -> None:
    """What stands in the table is what the agents do in each of these worlds of the scenario, or of a saved one."""
    shown = {name: value for name, value in harms(page).items() if name in AGENTS}
    for worlds, scenario in evaluated:
        found = eb.evaluate(worlds, make_lineup(AGENTS, PAPER), scenario=scenario, aftermath=False).outcomes.items()
        assert shown == {
            name: (int(each.impacts[0]), float(each.first_impact_harm[0]), float(each.total_harm[0]))
            for name, each in found
        }


def test_explorer__begins_with_the_world_of_the_list_and_fetches_others(page: Any) -> None:
    check_harms(page, (WORLD, PAPER))
    text = page.inner_text("[data-part=harms]")
    assert all(f"{first:.2f}" in text and f"{total:.2f}" in text for _, first, total in harms(page).values())
    before = page.evaluate(f"{EXPLORER}.found.world.conditions")
    page.get_by_role("button", name="World after").click()
    wait_until(page, f"{IDLE} && {EXPLORER}.found.world.conditions !== {before!r}")
    assert page.locator("[data-part=number]").input_value() == "2"
    check_harms(page, (PAPER.sample(1, DEFAULT.LIST_SEED, first=2).worlds, PAPER))


def test_slider__is_answered_by_the_engine_for_its_newest_place(page: Any) -> None:
    page.get_by_label("Gap, 1 to 2 in m, slider").focus()
    for _ in range(12):
        page.keyboard.press("ArrowRight")
    page.get_by_label("Mass, Vehicle 3 in t", exact=True).evaluate("(e) => e.closest('details').open = true")
    page.get_by_label("Mass, Vehicle 3 in t", exact=True).fill("12.5")
    page.get_by_label("Restitution", exact=True).fill("0.35")
    wait_until(page, IDLE)
    asked: list[str] = []
    page.on("request", lambda each: asked.append(each.url) if each.url.endswith("/answer") else None)
    page.get_by_label("Gap, 2 to 3 in m, slider").evaluate(
        "(e) => { for (let k = 0; k <= 40; k += 1) { e.value = 5 + k / 10; e.dispatchEvent(new Event('input')); } }"
    )
    wait_until(page, IDLE)
    state = page.evaluate(f"{EXPLORER}.state")
    assert (state["mass_t"][2], state["restitution"], state["gaps_m"][1]) == (12.5, 0.35, 9.0) and len(asked) == 2
    assert str(round(state["gaps_m"][0], 4)) == page.get_by_label("Gap, 1 to 2 in m", exact=True).input_value()
    assert state["gaps_m"][0] != WORLD.gaps_m[0, 0]
    check_harms(page, (PAPER.worlds_from_state(state), PAPER))


def test_page__says_what_is_wrong_with_an_input_and_leaves_it_again(page: Any) -> None:
    state, number = page.locator("[data-part=state]"), page.locator("[data-part=number]")
    speed = page.get_by_label("Speed, Vehicle 1 in m/s", exact=True)
    speed.fill("90")
    wait_until(page, IDLE)
    assert "must not be above speed_limit_mps" in state.inner_text()
    assert page.evaluate("getComputedStyle(document.querySelector('.cards')).opacity") == "0.45"
    speed.fill("20")
    wait_until(page, IDLE)
    assert "Answered" in state.inner_text()
    number.fill("-3")
    number.press("Enter")
    assert "from 0 to" in state.inner_text() and page.locator("body.stale").count() == 1
    number.fill("1")
    number.press("Enter")
    wait_until(page, f"{IDLE} && !document.body.classList.contains('stale')")
    assert "from 0 to" not in state.inner_text()
    speed.fill("")
    assert "must be a number" in state.inner_text() and page.locator("body.stale").count() == 1


def test_best_known__is_one_profile_in_card_row_and_road(page: Any) -> None:
    wait_until(page, f"!!{EXPLORER}.best")
    shown, cards = harms(page), page.inner_text("[data-part=cards]")
    constant = next(value for name, value in shown.items() if name.startswith("H*"))
    assert page.evaluate(f"{EXPLORER}.found.verdict.proven_harm") <= shown["best known"][1] <= constant[1] + 1e-9
    assert "Unavoidable" in cards and f"{constant[1]:.2f} m²/s²" in cards
    for first, total in ((0.1, 0.1), (-0.1, -0.1), (0.0, 0.1), (0.0, -0.1)):  # of the search, beside the best agent
        page.evaluate(
            f"(([first, total]) => {{ const e = {EXPLORER}; clearTimeout(e.settled); e.own ??= e.found.outcomes"
            ".reduce((a, b) => (b.first < a.first || (b.first === a.first && b.total < a.total) ? b : a));"
            " Object.assign(e.best, { first: e.own.first + first, total: e.own.total + total, impacts: 77 }); e.show();"
            f" }})({[first, total]})"
        )
        searched = (first, total) < (0.0, 0.0)
        card, row = page.locator(".cards").inner_text(), harms(page)["best known"]
        assert ("a search of" in card) == (row[0] == 77) == searched, (first, total)
        own = page.evaluate(f"[{EXPLORER}.own.agent, {EXPLORER}.own.impacts]")
        assert searched or (own[0] in card and row[0] == own[1])


def test_profile__is_drawn_by_hand_or_begun_from_an_agent_and_beats_the_policy(page: Any) -> None:
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
    explored = Explored(Task(PAPER, PAPER.learners), make_agents(["full_brake"], PAPER))
    expected = outcome("by hand", explored.follow(WORLD, HandDriven(read_profile(commands), PAPER.time_step_s)))
    assert harms(page)["by hand"] == (expected["impacts"], expected["first"], expected["total"])

    begin, last = page.locator("[data-part=from]"), f"{EXPLORER}.found.outcomes.at(-1).first"
    begin.select_option(label="ppo@shipped")
    wait_until(page, f"{IDLE} && {last} === {EXPLORER}.found.outcomes[2].first")
    assert harms(page)["by hand"] == harms(page)["ppo@shipped"]
    wait_until(page, f"!!{EXPLORER}.best")
    begin.select_option("best")
    wait_until(page, f"{IDLE} && {last} === {EXPLORER}.best.first")
    page.locator("[data-part=rival]").select_option("0")
    assert "You beat full_brake by" in page.inner_text("[data-part=score]")


def test_profile__is_changed_by_keys(page: Any) -> None:
    page.locator("[data-part=editor]").focus()
    before = harms(page)["by hand"]
    for key in ("ArrowRight", "ArrowUp", "ArrowUp", "Shift+ArrowUp", "Enter"):
        page.keyboard.press(key)
    wait_until(page, IDLE)
    assert page.evaluate(f"{EXPLORER}.editor.commands.slice(0, 3)") == [-7, -5.9, -5.9]
    assert "From 0.60 s: −5.90 m/s²." in page.inner_text("[data-explorer=profile]")
    assert harms(page)["by hand"] != before


def test_save__reads_back_to_the_same_harm_and_says_what_cannot_be(page: Any, served: Running) -> None:
    page.get_by_label("Speed, Vehicle 3 in m/s", exact=True).fill("24.3")
    wait_until(page, IDLE)
    name, said = page.get_by_label("Name", exact=True), "document.querySelector('[data-part=saved]').textContent"
    name.fill("near-miss")
    for button, file in (("a scenario", "near-miss.yaml"), ("initial states", "near-miss.csv")):
        page.get_by_role("button", name=f"Save as {button}").click()
        wait_until(page, f"{said} === 'Saved: {file}'")
    saved = load_scenario(served.folder / "near-miss.yaml")
    check_harms(page, (saved.sample(1, 3).worlds, saved), (PAPER.read_worlds(served.folder / "near-miss.csv"), PAPER))
    page.get_by_role("button", name="Save as a scenario").click()
    wait_until(page, f"{said}.includes('is there already')")
    name.fill("Near Miss!")
    assert page.evaluate(said) == ""
    name.press("Enter")
    assert "small letters" in page.evaluate(said) and page.locator("[data-part=saved].wrong").count() == 1


def test_player__shows_every_agent_and_ends_with_the_table(page: Any) -> None:
    page.evaluate(f"{EXPLORER}.player.seek(1e9)")
    heads = page.evaluate(
        "[...document.querySelectorAll('.player .head')].map((head) => [head.querySelector('strong').textContent,"
        " ...['impacts', 'first', 'total'].map((n) => Number(head.querySelector(`[data-${n}]`).dataset[n]))])"
    )
    shown = harms(page)
    assert len(heads) >= 5 and all(shown[name] == (impacts, first, total) for name, impacts, first, total in heads)
    page.evaluate(f"{EXPLORER}.player.seek(1.2)")
    page.get_by_label("Speed, Vehicle 2 in m/s", exact=True).fill("20.5")
    wait_until(page, IDLE)
    assert page.evaluate(f"{EXPLORER}.player.time") == 1.2


def test_page__has_no_sideways_scroll_and_both_schemes(page: Any) -> None:
    wait_until(page, f"!!{EXPLORER}.best")
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    for width, scheme in itertools.product((360, 768, 1440), ("light", "dark")):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        style = "getComputedStyle(document.body)"
        colours = page.evaluate(f"[{style}.backgroundColor, {style}.color]")
        back, ink = (sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in colours)
        assert (back < ink) == (scheme == "dark"), (width, scheme)


def test_page__is_worked_by_keys_alone(page: Any) -> None:
    reached = set()
    for _ in range(120):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.dataset.part ?? document.activeElement.className"))
        outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert outline != "none" or page.evaluate("document.activeElement === document.body")
    assert {"number", "from", "rival", "editor", "player live ready", "name"} <= reached


def test_other_page__cannot_reach_the_server(browser: Any, served: Running, tmp_path: Path) -> None:
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
    blind, seeing = page.evaluate(script, served.address.geturl())
    assert (blind in ("opaque", "refused"), seeing) == (True, "refused")
    assert sorted(each.name for each in served.folder.iterdir()) == before
