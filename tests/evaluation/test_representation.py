"""What an evaluation and its parts look like in an interpreter and in a notebook."""

from __future__ import annotations

import numpy as np
import pytest

import ethbrake_marl as eb

MOST_CHARACTERS = 400
SCENARIO = eb.load_scenario("paper-random")


@pytest.fixture(scope="module")
def evaluation() -> eb.Evaluation:
    agents = {"full_brake": eb.make_agent("full_brake"), "<script>alert(1)</script>": eb.make_agent("coast")}
    return eb.evaluate(SCENARIO.sample(50, seed=7), agents, scenario=SCENARIO, seed=7)


def test_repr__is_short_whatever_it_holds(evaluation: eb.Evaluation) -> None:
    sample = SCENARIO.sample(5000, seed=7)
    record = eb.record_episode(sample.worlds.take([0]), eb.make_agent("full_brake"), scenario=SCENARIO)
    outcome = evaluation.outcome("full_brake")
    many = eb.evaluate(
        sample.worlds.take([0]),
        {f"{k}{200 * 'x'}": eb.make_agent("coast") for k in range(30)},
        scenario=SCENARIO,
        aftermath=False,
    )
    for value in (evaluation, many, sample, sample.worlds, sample.worlds.vehicles, record, outcome, outcome.ledger):
        assert len(repr(value)) <= MOST_CHARACTERS, type(value)
    assert len(repr(eb.load_shipped("ppo"))) <= MOST_CHARACTERS


def test_repr__says_what_it_is(evaluation: eb.Evaluation) -> None:
    assert repr(evaluation).startswith(
        "Evaluation('paper-random', 50 worlds of seed 7, vehicle_2 driven by 'full_brake'"
    )
    assert repr(SCENARIO.sample(3, seed=7)).startswith("Sample(Worlds(3 worlds of 3 vehicles: gaps ")
    assert repr(evaluation.worlds.take(np.zeros(0, int))).startswith("Worlds(0 worlds of 3 vehicles: gaps none m")
    assert repr(eb.load_shipped("ppo")).startswith("Policy('ppo', 27 observations, ")
    harm = evaluation.outcome("full_brake").total_harm.mean()
    assert f"{harm:.2f} total" in repr(evaluation.outcome("full_brake"))


def test_repr__a_name_cannot_turn_the_line_around(evaluation: eb.Evaluation) -> None:
    hostile = eb.Evaluation(
        evaluation.scenario,
        (1,),
        evaluation.worlds,
        evaluation.index,
        7,
        {"a\u202eb\x1b[2J": evaluation.outcome("full_brake")},
    )
    assert repr(hostile).isprintable()


def test_html__escapes_hostile_names(evaluation: eb.Evaluation) -> None:
    hostile = SCENARIO.replace(title="<img src=x onerror=alert(1)>", description="a & b \u202e")
    for value in (evaluation, eb.summarise(evaluation), hostile):
        html = value._repr_html_()
        assert "<script" not in html and "<img" not in html and "\u202e" not in html and "<table>" in html
    assert "&lt;script&gt;" in evaluation._repr_html_() and "&lt;script&gt;" in eb.summarise(evaluation)._repr_html_()
    assert "&lt;img src=x" in hostile._repr_html_() and "a &amp; b \\u202e" in hostile._repr_html_()


def test_html__shows_every_agent_with_its_figures(evaluation: eb.Evaluation) -> None:
    harm = eb.summarise(evaluation)[0].total_harm
    for html in (evaluation._repr_html_(), eb.summarise(evaluation)._repr_html_()):
        interval = f'<span class="interval">[{harm.interval[0]:.2f}, {harm.interval[1]:.2f}]</span>'
        assert f"<td>{harm.value:.2f} {interval}</td>" in html
        assert html.count("<tr>") == 3
