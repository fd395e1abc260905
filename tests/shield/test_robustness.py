"""What not knowing costs: the curves, their figure and their table."""

from __future__ import annotations

import pytest

from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.figures import robustness_figure
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.scenario.schema import Task
from ethbrake_marl.shield.evidence import MODES, TRUTHS, robustness
from ethbrake_marl.shield.uncertainty import parse_uncertainty
from tests.failing_worlds import plant, without

SCENARIO = load_scenario("paper-random")
TASK = Task(SCENARIO, (1,))
WORLDS = SCENARIO.sample(25, 3).worlds
INTERVALS = parse_uncertainty("gaps_m=1,mass_t.vehicle_3=20%")


@pytest.fixture(scope="module")
def points():
    return robustness(WORLDS, make_agent("full_brake"), TASK, INTERVALS, widths=(0.0, 1.0))


def of(points, width):
    return {(p.mode, p.truth): p for p in points if p.width == width}


def test_points__are_one_for_each_width_truth_and_shield(points):
    assert [(p.width, p.truth, p.mode) for p in points] == [
        (w, t, m) for w in (0.0, 1.0) for t in TRUTHS for m in MODES
    ]


def test_no_width__nothing_differs_and_nothing_breaks(points):
    first, *rest = of(points, 0.0).values()
    assert first.harm > 5.0 and first.above == first.excess == first.distrusted == 0.0
    assert all(p[3:] == first[3:] for p in rest)


def test_step__breaks_its_bound_where_the_truth_differs_and_robust_pays_for_keeping_it(points):
    found = of(points, 1.0)
    told = found["step", "as told"]
    assert told[3:] == of(points, 0.0)["step", "as told"][3:]
    for truth in ("corner", "inside"):
        assert found["step", truth].above > 0.2 and found["step", truth].excess > 0.2
        assert found["step", truth].bound == told.bound and found["step", truth].distrusted == 1.0
    assert found["robust", "corner"].above == found["robust", "as told"].above == 0.0
    assert found["robust", "corner"].distrusted == found["robust", "inside"].distrusted == 0.0
    assert found["robust", "as told"].bound > told.bound + 1.0
    assert found["robust", "as told"].harm > told.harm


@pytest.mark.slow
def test_interior__keeps_its_bound_inside_and_is_refused_for_what_it_cannot_certify():
    found = of(
        robustness(
            WORLDS.take([3, 4]), make_agent("full_brake"), TASK, parse_uncertainty("gaps_m.pair_1=0.5"), widths=(1.0,),
            robust="interior",
        ),
        1.0,
    )  # fmt: skip
    assert found["robust", "inside"].above == found["robust", "corner"].above == 0.0
    with pytest.raises(UnknownName, match="corners"):
        robustness(WORLDS, make_agent("full_brake"), TASK, INTERVALS, robust="edges")
    with pytest.raises(InvalidInput, match="total harm"):
        robustness(WORLDS, make_agent("full_brake"), Task(SCENARIO, (1,), "total"), INTERVALS, robust="interior")


def test_same_case__is_driven_once(monkeypatch):
    drives = []
    monkeypatch.setattr("ethbrake_marl.shield.evidence.drive", lambda *given: drives.append(given) or drive(*given))
    robustness(WORLDS.take([0]), make_agent("full_brake"), TASK, INTERVALS, widths=(0.0, 1.0))
    assert len(drives) == 1 + 5  # nothing differs at width 0, nor for step mode where the world is as told


def test_refused__an_interval_that_is_possible_only_at_its_own_width():
    with pytest.raises(InvalidInput, match="widths of up to 2 times those given are measured"):
        robustness(WORLDS, make_agent("full_brake"), TASK, parse_uncertainty("mass_t=60%"))


def test_figure__draws_the_points(points):
    figure = robustness_figure(points, caption="x")
    price, above, excess = figure.axes
    lines = {line.get_label(): line.get_ydata().tolist() for line in price.get_lines()}
    told = [p for p in points if p.truth == "as told"]
    assert lines["step: harm"] == [p.harm for p in told if p.mode == "step"]
    assert lines["robust: bound at the alert"] == [p.bound for p in told if p.mode == "robust"]
    drawn = {line.get_label(): line.get_ydata().tolist() for line in above.get_lines()}
    assert drawn["step, a corner"] == [p.above for p in points if (p.mode, p.truth) == ("step", "corner")]
    assert len(excess.get_lines()) == 4


def test_refused__nothing_to_draw_and_widths_that_are_none():
    with pytest.raises(InvalidInput, match="at least one point"):
        robustness_figure([])
    for widths in ((), (-1.0,), (float("nan"),)):
        with pytest.raises(InvalidInput, match="widths"):
            robustness(WORLDS, make_agent("full_brake"), TASK, INTERVALS, widths=widths)


def test_worlds_that_cannot_be_advanced__are_in_no_point_and_named():
    found = robustness(plant(WORLDS, [3]), make_agent("full_brake"), TASK, INTERVALS, widths=(0.0, 1.0))
    assert {point.left_out for point in found} == {((3, found[0].left_out[0][1]),)}
    rest = WORLDS.take(without(25, [3]))
    (expected, *_) = robustness(rest, make_agent("full_brake"), TASK, INTERVALS, widths=(0.0,))
    assert found[0][:-1] == expected[:-1] and expected.left_out == ()
