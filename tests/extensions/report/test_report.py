import base64
import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import plain_text
from ethbrake_marl.extensions.report import page as page_module
from ethbrake_marl.extensions.report.page import Part, Section, read_file
from ethbrake_marl.extensions.report.paper_rows import with_paper_rows
from ethbrake_marl.extensions.report.report import Report
from ethbrake_marl.extensions.report.shown_worlds import choose_shown, worst_rows
from ethbrake_marl.extensions.report.style import new_figure
from ethbrake_marl.extensions.search.regret import regrets_of
from ethbrake_marl.files.sheet import Column, Sheet, Shown
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.game.harm import HarmCount
from tests.first_edition.evaluation.test_rollout import left_out_by
from tests.fixtures.page import HOSTILE, UNSEEN, Page


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
    return page_module.Page(text, [Section(text, body), Section(text, [text]), Section(text, [])], lead=text).html


HARMLESS = Page(whole_page("Harmless"))


@pytest.mark.parametrize("text", HOSTILE)
def test_page__no_text_becomes_markup(text: str) -> None:
    html = whole_page(text)
    found = Page(html)
    assert (found.shape, found.open) == (HARMLESS.shape, []) and not set(html) & UNSEEN
    assert " ".join(plain_text(text, keep="\u00a0").split()) in found.text
    for _, attributes in found.tags:
        assert (attributes.get("href") or "#").startswith("#")
        assert not any(name.startswith("on") for name in attributes)
        assert re.fullmatch(r"[a-z0-9-]+", attributes.get("id") or "x")


@pytest.mark.parametrize("text", HOSTILE)
def test_data__stays_data(text: str) -> None:
    html = str(Part.data("x", {text: [text, 1.5, None]}).html)
    inner = html.removeprefix('<script type="application/json" id="x">').removesuffix("</script>\n")
    assert inner.isascii() and not set("<>&") & set(inner)
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


EXTERNAL = re.compile(r"""(https?:)?//|@import|<(link|iframe|object|embed|base)\b""", re.IGNORECASE)


COASTING = {"coast": eb.make_agent("coast")}


@pytest.fixture(scope="module")
def report(evaluation: eb.Evaluation) -> Report:
    agents = {name: eb.make_agent(name) for name in ("full_brake", "constant:4.5")}
    part = replace(evaluation, outcomes={name: evaluation.outcome(name) for name in agents})
    return Report(
        title="PPO on paper-random",
        rows=with_paper_rows(eb.summarise(part)),
        evaluation=part,
        figures=[Part.drawing(new_figure(4.0, 3.0), "Learning curve", "Harm over steps.")],
        tests=[("paper-other", "Another test.", eb.summarise(evaluation))],
        summary="One million steps.",
        settings={"Training seed": 5, "Command": "ethbrake run"},
        versions={"numpy": "2.4.6"},
    ).driven(agents)


@pytest.fixture(scope="module")
def html(report: Report) -> str:
    return report.html


def test_report__loads_nothing_from_anywhere(html: str) -> None:
    own = re.sub(r"(?m)//.*$|<script type=.*</script>", "", html)  # without comments of scripts, numbers of episodes,
    assert EXTERNAL.search(re.sub(r'xmlns(:\w+)?="[^"]*"|"http://www.w3.org/2000/svg"', "", own)) is None  # and names
    for _, attributes in Page(html).tags:
        assert (attributes.get("href") or "#").startswith("#")
        assert attributes.get("src", "data:").startswith("data:")


def test_report__embeds_fifty_worlds_whose_counts_are_the_ledgers(html: str, report: Report) -> None:
    content = episode_data(html)
    numbers = [world["number"] for world in content["worlds"]]
    assert content["agents"] == ["full_brake", "constant:4.5"] and len(numbers) == len(set(numbers)) == 50
    for world in content["worlds"]:
        k = report.evaluation.index.tolist().index(world["number"])
        for agent, episode in zip(content["agents"], world["episodes"], strict=True):
            outcome = report.evaluation.outcome(agent)
            told = episode["impacts"][-1][4:] if episode["impacts"] else [0, 0.0, 0.0]
            assert told == [outcome.impacts[k], outcome.first_impact_harm[k], outcome.total_harm[k]]


def summed_up(scenario: eb.Scenario, *specs: str) -> Report:
    """A report of agents in 60 worlds, about the last one."""
    result = eb.evaluate(scenario.sample(60, 7), make_lineup(specs, scenario), scenario=scenario, seed=7)
    return Report("t", eb.summarise(result), result, focus=specs[-1])


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_report__begins_with_what_the_agent_does_against_full_braking_and_where_it_fails(
    paper_random: eb.Scenario, harm_count: HarmCount
) -> None:
    """By the first impacts it is worse in no world, by all of them in some."""
    mine = replace(summed_up(paper_random, "full_brake", "ppo"), harm_count=harm_count)
    after, before = (mine.evaluation.outcome(name).world_harm(harm_count) for name in ("ppo", "full_brake"))
    best, worse = regrets_of(mine.evaluation).best(harm_count).mean(), after > before + 1e-6
    words = "first impacts" if harm_count == "first" else "all impacts"
    more = f"but more in {100 * worse.mean():.1f} % of the worlds, by {(after - before).max():.2f} at most"
    assert worse.any() == (harm_count == "total")
    assert mine.first_sentence == (
        f"ppo does {100 * (1 - after.mean() / before.mean()):.0f} % less harm than full braking ({words}:"
        f" {after.mean():.2f} m²/s² per emergency instead of {before.mean():.2f}; best known {best:.2f}),"
        f" {more if worse.any() else 'and in no world more'}."
    )


def test_report__calls_nothing_best_known_that_no_search_has_found() -> None:
    mine = summed_up(eb.load_scenario("cooperation-4-all"), "full_brake", "e_v2x_bm")
    assert re.search(r"instead of [0-9.]+; best of these agents [0-9.]+\)", mine.first_sentence)


def test_report__flatters_nobody(paper_random: eb.Scenario, pair: eb.Scenario) -> None:
    worse = summed_up(paper_random, "full_brake", "coast").first_sentence
    assert " % more harm than full braking (" in worse and "), and more in " in worse
    unsure = summed_up(paper_random, "full_brake", "constant:6.5").first_sentence  # 19.01 for 20.34
    assert unsure.startswith("constant:6.5 does about as much harm as full braking (first impacts: ")
    alone = summed_up(paper_random, "full_brake").first_sentence
    assert alone.startswith("Full braking does ") and "instead of" not in alone and alone.endswith(").")
    far = pair.replace(gaps_m={"uniform": [60.0, 70.0]})
    harmless = summed_up(far, "full_brake", "constant:5").first_sentence
    assert harmless.startswith("constant:5 does about as much harm as full braking (first impacts: 0.00 ")
    assert harmless.endswith("), and in no world more.")
    harmful = summed_up(far, "full_brake", "coast").first_sentence  # no share of nothing
    assert harmful.startswith("coast does more harm than full braking (first impacts: ")


def episode_data(html: str) -> dict:
    """The numbers that the player shows."""
    (text,) = re.findall(r'<script type="application/json" id="episode_data">(.*?)</script>', html)
    return json.loads(text)


def test_report__says_who_did_not_repeat_itself(pair: eb.Scenario, html: str) -> None:
    class Fickle:
        name, drives = "fickle", iter(range(100))

        def begin(self, alert: eb.Worlds, vehicle: int, scripts: object) -> np.ndarray:
            return np.full(alert.n, -float(next(self.drives)) / 2.0)

        def act(self, worlds: eb.Worlds, memory: np.ndarray, vehicle: int) -> tuple[np.ndarray, np.ndarray]:
            return memory, memory

    result = eb.evaluate(pair.sample(3, 0), {"fickle": Fickle()}, scenario=pair)
    text = Report("t", eb.summarise(result), result).driven({"fickle": Fickle()}).html
    assert "In 3 worlds of these, fickle drove differently" in text and "drove differently" not in html


def test_chosen__begin_with_those_of_the_largest_regret_and_say_whose_harm_it_is(
    report: Report, pair: eb.Scenario
) -> None:
    chosen = choose_shown(report.evaluation, "constant:4.5")
    assert list(chosen)[:10] == worst_rows(report.evaluation, "constant:4.5").tolist()
    assert chosen == choose_shown(report.evaluation, "constant:4.5") and report.focus == "constant:4.5"
    assert len({each.kind for each in chosen.values()}) >= 4
    assert [one.number for one in report.played] == [one.number for one in chosen.values()]
    outcome = report.evaluation.outcome("constant:4.5")
    for row, each in chosen.items():
        first, total = outcome.first_impact_harm[row], outcome.total_harm[row]
        assert each.why == f"constant:4.5: harm {first:.2f} first-impact, {total:.2f} total"
    result = eb.evaluate(pair.replace(gaps_m={"uniform": [0.5, 9.0]}).sample(40, 0), COASTING, scenario=pair)
    harm = result.outcome("coast").total_harm
    assert harm[worst_rows(result, "coast")].tolist() == sorted(harm, reverse=True)[:10]


def test_report__hostile_names_are_text_everywhere(pair: eb.Scenario) -> None:
    names = [text[:200] for text in HOSTILE]
    agents = {name: eb.make_agent("constant:4") for name in names}
    result = eb.evaluate(pair.sample(3, 0), agents, scenario=pair)
    words, told = " ".join(names), {name: name for name in names}
    given = Report(words, eb.summarise(result), result, focus=names[0], summary=words, settings=told, versions=told)
    html = given.driven(agents).html
    found = Page(html)
    assert found.open == [] and not set(html) & UNSEEN and html.count("<script") == 2
    assert {tag for tag, _ in found.tags} <= ALLOWED
    assert not any(key.startswith("on") for _, attributes in found.tags for key in attributes)
    assert [len(world["episodes"]) for world in episode_data(html)["worlds"]] == [len(names)] * 3


ALLOWED = {
    *("html", "head", "meta", "title", "style", "body", "a", "header", "h1", "h2", "h3", "p", "nav", "main", "section"),
    *("figure", "figcaption", "strong", "span", "div", "table", "caption", "thead", "tbody", "tr", "th", "td", "dl"),
    *("dt", "dd", "details", "summary", "code", "footer", "script", "noscript", "svg", "path", "img", "select"),
    *("option", "optgroup", "label", "input", "button", "fieldset", "legend", "output", "ul", "li", "aside"),
}


def test_report__counts_a_cascade_whole_but_draws_its_last_impact(pair: eb.Scenario) -> None:
    bouncy = pair.replace(restitution=0.8)
    result = eb.evaluate(bouncy.sample(1, 0), COASTING, scenario=bouncy)
    (episode,) = episode_data(Report("t", eb.summarise(result), result).driven(COASTING).html)["worlds"][0]["episodes"]
    assert episode["impacts"][-1][4] == result.outcome("coast").impacts[0] > len(episode["impacts"]) - 1
    assert np.diff([impact[4] for impact in episode["impacts"]]).min() > 0
    _, _, closing_mps, _, number, first, total = episode["impacts"][0]
    assert number == 1 and first == total == closing_mps**2


@pytest.mark.usefixtures("undrawn")
def test_report__says_how_many_worlds_were_left_out_and_which() -> None:
    found = left_out_by("coast")
    text = Report("title", eb.summarise(found), found).html
    assert "LEFT OUT for every agent: 3 of 12 worlds" in text and "world 10 of seed 7 (failing: planted)" in text
