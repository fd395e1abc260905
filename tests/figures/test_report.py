from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import Evaluation, evaluate, record_episode, summarise
from ethbrake_marl.figures import (
    harm_against_total_gap,
    harm_by_agent,
    harm_in_parts,
    label_text,
    learning_curve,
    new_figure,
    picture_bytes,
    regret_distribution,
    trajectories,
)
from ethbrake_marl.scenario import Scenario

UNIT = re.compile(r"\((m|s|m/s|m/s²|m²/s²|ms|µs|ns)\)|steps|Worlds|Decisions")


@pytest.fixture(scope="module")
def figures(evaluation: Evaluation) -> dict[str, Figure]:
    rows = summarise(evaluation)
    record = record_episode(evaluation.worlds.take([0]), make_agent("full_brake"), scenario=evaluation.scenario)
    points = [{"steps": 1.0, "first_impact_harm": 3.0, "total_harm": 4.0, "collision_rate": 0.5}]
    return {
        "harm": harm_by_agent(rows),
        "regret": regret_distribution(evaluation),
        "parts": harm_in_parts(evaluation),
        "gap": harm_against_total_gap(evaluation),
        "learning": learning_curve(points, references=rows),
        "episode": trajectories({"a": record}),
    }


@pytest.mark.parametrize("name", ["harm", "regret", "parts", "gap", "learning", "episode"])
def test_figure__every_axis_says_what_it_is_and_its_unit(figures: dict[str, Figure], name: str) -> None:
    for axes in figures[name].axes:
        below = [other for other in axes.get_shared_x_axes().get_siblings(axes) if other.get_xlabel()]
        assert UNIT.search(axes.get_xlabel() or below[0].get_xlabel())
        siblings = axes.get_shared_y_axes().get_siblings(axes)
        names = [label.get_text() for other in siblings for label in other.get_yticklabels()]
        agents = any(re.search("[a-z]", each) for each in names)
        beside = [other.get_ylabel() for other in siblings]
        assert agents or any(UNIT.search(each.replace("\n", " ")) for each in (*beside, axes.get_title(loc="left")))


@pytest.mark.parametrize("name", ["harm", "learning"])
def test_figure__travels_with_its_fonts(figures: dict[str, Figure], name: str) -> None:
    svg = picture_bytes(figures[name], "a.svg")
    assert b"<text" not in svg and b"font-family" not in svg
    pdf = picture_bytes(figures[name], "a.pdf")
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf


def test_harm_in_parts__add_up_to_the_means(evaluation: Evaluation, figures: dict[str, Figure]) -> None:
    left, right = figures["parts"].axes
    for axes, field in ((left, "first_impact_harm"), (right, "total_harm")):
        for k, outcome in enumerate(evaluation.outcomes.values()):
            bars = [bar for bar in axes.patches if round(bar.get_y() + bar.get_height() / 2) == k]
            assert sum(bar.get_width() for bar in bars) == pytest.approx(getattr(outcome, field).mean())


def test_regret_distribution__shares_are_those_of_the_worlds(
    evaluation: Evaluation, figures: dict[str, Figure]
) -> None:
    regrets = evaluation.regrets
    assert regrets is not None
    line = figures["regret"].axes[0].lines[0]
    values = regrets.regret(evaluation.outcome("full_brake"), "first")
    for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True):
        assert y == pytest.approx(np.mean(values > x))


def test_figures__without_limits_or_rows(pair: Scenario) -> None:
    result = evaluate(pair.sample(3, 0), {"coast": make_agent("coast")}, scenario=pair)
    assert regret_distribution(result).axes
    with pytest.raises(InvalidInput):
        harm_by_agent([])


@pytest.mark.parametrize("text", ["$x^2$", "a_b$", "\u202eabc", "测试🚗", "x" * 500, "</text><script>"])
def test_label__of_anybody_can_be_drawn(text: str) -> None:
    figure = new_figure(3.0, 2.0)
    figure.subplots().set_xlabel(label_text(text))
    svg = picture_bytes(figure, "a.svg")
    assert b"<script" not in svg and len(svg) < 200_000
