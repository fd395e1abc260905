"""The evidence on shields: operating curves, the price of not knowing, and what interventions were good for."""

import numpy as np
import pytest

from ethbrake_marl.agents import drive, make_agent
from ethbrake_marl.figures import operating_figure, robustness_figure
from ethbrake_marl.scenario import Task, load_scenario
from ethbrake_marl.shield import ShieldedDriver, operating_curves, parse_uncertainty, review, robustness
from ethbrake_marl.shield.evidence import MODES, TRUTHS
from tests.failing_worlds import plant, without
from tests.shield.test_step_shield import wavering

SCENARIO = load_scenario("paper-random")
TASK = Task(SCENARIO, (1,))
WORLDS = SCENARIO.sample(60, 3).worlds
FEW = WORLDS.take(np.arange(25))
INTERVALS = parse_uncertainty("gaps_m=1,mass_t.vehicle_3=20%")


@pytest.fixture(scope="module")
def points():
    return robustness(FEW, make_agent("full_brake"), TASK, INTERVALS, widths=(0.0, 1.0))


def of(points, width):
    return {(p.mode, p.truth): p for p in points if p.width == width}


def test_no_width__nothing_differs_and_nothing_breaks(points):
    assert [(p.width, p.truth, p.mode) for p in points] == [
        (w, t, m) for w in (0.0, 1.0) for t in TRUTHS for m in MODES
    ]
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
    assert found["robust", "as told"].bound > told.bound + 1.0 and found["robust", "as told"].harm > told.harm


@pytest.mark.slow
def test_interior__keeps_its_bound_inside():
    found = of(
        robustness(
            FEW.take([3, 4]), make_agent("full_brake"), TASK, parse_uncertainty("gaps_m.pair_1=0.5"), widths=(1.0,),
            robust="interior",
        ),
        1.0,
    )  # fmt: skip
    assert found["robust", "inside"].above == found["robust", "corner"].above == 0.0


def test_figure__draws_the_points(points):
    figure = robustness_figure(points, caption="x")
    price, above, excess = (
        {line.get_label(): line.get_ydata().tolist() for line in axes.get_lines()} for axes in figure.axes
    )
    told = [p for p in points if p.truth == "as told"]
    assert price["step: harm"] == [p.harm for p in told if p.mode == "step"]
    assert price["robust: bound at the alert"] == [p.bound for p in told if p.mode == "robust"]
    assert above["step, a corner"] == [p.above for p in points if (p.mode, p.truth) == ("step", "corner")]
    assert len(excess) == 4


def test_worlds_that_cannot_be_advanced__are_in_no_point_and_named():
    found = robustness(plant(FEW, [3]), make_agent("full_brake"), TASK, INTERVALS, widths=(0.0, 1.0))
    assert {point.left_out for point in found} == {((3, found[0].left_out[0][1]),)}
    (expected, *_) = robustness(FEW.take(without(25, [3])), make_agent("full_brake"), TASK, INTERVALS, widths=(0.0,))
    assert found[0][:-1] == expected[:-1] and expected.left_out == ()


def test_operating_curve__fewer_interventions_cost_harm():
    done, coast = [], {"coast": make_agent("coast")}
    points = operating_curves(WORLDS, coast, TASK, [0.0, 20.0, 1e6], on_progress=done.append)["coast"]
    rates, harms = [p.intervention_rate for p in points], [p.harm for p in points]
    assert done == ["coast"] and rates == sorted(rates, reverse=True) and rates[-1] == 0.0
    assert harms == sorted(harms) and harms[0] < harms[-1]
    (drawn,) = operating_figure([("coast", points)]).axes[0].get_lines()
    assert drawn.get_xdata().tolist() == rates


def test_operating_curve__leaves_worlds_out_that_cannot_be_advanced_and_names_them():
    agents = {"coast": make_agent("coast"), "brake": make_agent("full_brake")}
    found = operating_curves(plant(WORLDS.take(np.arange(9)), [2, 6]), agents, TASK, [0.0, 20.0])
    rest = operating_curves(WORLDS.take(without(9, [2, 6])), agents, TASK, [0.0, 20.0])
    for name in agents:
        assert [[world for world, _ in point.left_out] for point in found[name]] == [[2, 6]] * 2
        assert [point[:-1] for point in found[name]] == [point[:-1] for point in rest[name]]
        assert rest[name][0].left_out == ()


def logged(policy, worlds=WORLDS, driver=None, **settings):
    """The episodes of a driver that keeps a log."""
    driver = driver or ShieldedDriver(policy, SCENARIO, logging=True, **settings)
    return drive(worlds, driver, SCENARIO, 1)


def test_log__holds_every_intervention_and_forensics_says_what_it_was_good_for():
    shield = logged(make_agent("coast")).guarded.shield
    log = shield.log
    assert len(log) == shield.interventions.sum() > 0
    assert all(entry.margin < 0.0 and entry.proposed == 0.0 != entry.applied for entry in log)
    found = review(shield, make_agent("coast"), WORLDS)
    shares = [found.share(kind) for kind in ("needed", "harmless", "costly")]
    assert found.without.shape == (len(log),) and shares[0] > 0.8 and sum(shares) == pytest.approx(1.0)
    first = {entry.world: k for k, entry in reversed(list(enumerate(log)))}  # each world's first intervention
    alone = drive(WORLDS, make_agent("coast"), SCENARIO, 1).ledger.world_harm("first")
    assert all(found.without[k] == alone[world] for world, k in first.items())


@pytest.mark.parametrize("mode", ["distrusted", "robust"])
def test_review__tells_the_harm_of_the_engine_also_where_the_bound_is_not_it(mode):
    worlds = WORLDS.take(np.arange(40))
    other = parse_uncertainty("braking_capacity_mps2=20%").draw(worlds, np.random.default_rng(0))
    settings = {"told": other} if mode == "distrusted" else {"uncertainty": "gaps_m=0.5"}
    episodes = logged(wavering, worlds, **settings)
    harm, shield = episodes.ledger.world_harm("first"), episodes.guarded.shield
    assert abs(shield.bound - harm).max() > 1.0
    found = review(shield, wavering, worlds)
    assert found.realised.tolist() == harm[found.world].tolist()
    assert found.trusted.tolist() == (~shield.distrusted[found.world]).tolist()
    assert found.trusted.all() == (mode == "robust")


def test_review__is_of_the_last_batch_and_of_its_worlds_alone():
    smaller, driver = WORLDS.take(np.arange(30, 50)), ShieldedDriver(wavering, SCENARIO, logging=True)
    logged(None, driver=driver)
    again, fresh = logged(None, smaller, driver), logged(wavering, smaller)
    found = [review(episodes.guarded.shield, wavering, smaller) for episodes in (again, fresh)]
    assert all(told.tolist() == expected.tolist() for told, expected in zip(*found, strict=True))
