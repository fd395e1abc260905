"""Interior mode: the bound holds for every world of the box, by hand and against worlds drawn from it."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import drive, fixed_commands, make_agent, script_agents
from ethbrake_marl.envs.interfaces import parallel_env
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.physics.kernel import Decisions
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.search import profile_problem
from ethbrake_marl.shield import HybridShield, ShieldedDriver, ShieldOptions, StepShield, enclosure, parse_uncertainty
from ethbrake_marl.shield.enclosure import Known, boxes_of, cell_of, wait
from ethbrake_marl.shield.step_shield import begin_running, plan_harm
from tests.shield.attacks import line
from tests.shield.enclosed import outside
from tests.shield.test_certify import STEPS, two

# What bounds a box takes two minutes to compile; the tests in other files that need it are slow, too.
pytestmark = pytest.mark.slow

UNUSUAL = {
    "gaps": ({}, "gaps_m=1"),
    "capacities": ({"restitution": 0.0}, "braking_capacity_mps2=5%"),
    "very unequal masses": ({"mass_t": [0.05, 100, 1], "restitution": 0.3}, "mass_t=20%,gaps_m.pair_2=0.5"),
    "late leader": ({"latency_s": [0.6, 0.2, 0.9]}, "latency_s.vehicle_1=0.15,speeds_mps.vehicle_2=0.5"),
    "own latency": ({}, "latency_s.vehicle_2=0.1,gaps_m.pair_1=0.5"),
    "elastic": ({"restitution": 1.0}, "speeds_mps=0.4"),
    "close": ({"gaps_m": [0.3, 0.2]}, "gaps_m=0.2,latency_s.vehicle_3=0.1"),
    "driving": ({"driving_capacity_mps2": 8, "speed_limit_mps": 22.5}, "driving_capacity_mps2=20%"),
}


def boxed(scenario, worlds, text):
    uncertainty = parse_uncertainty(text)
    possible = uncertainty.members(worlds)
    others = script_agents(scenario, except_for=1)
    command = fixed_commands(others, possible, "test", vehicle=1)
    problem = profile_problem(possible, [1], horizon_s=scenario.horizon_s, others_mps2=command)
    return uncertainty, boxes_of(possible, problem, worlds.n, scenario, others)


def harm_inside(scenario, uncertainty, worlds, plan, draws, rng):
    truth = uncertainty.draw(worlds.take(np.zeros(draws, np.int64)), rng)
    command = fixed_commands(script_agents(scenario, except_for=1), truth, "test", vehicle=1)
    running = begin_running(profile_problem(truth, [1], horizon_s=scenario.horizon_s, others_mps2=command))
    return plan_harm(running, np.repeat(plan[np.newaxis], draws, axis=0))


def width(scenario):
    return int(Decisions(np.zeros(1), scenario.time_step_s).before(scenario.horizon_s)[0]) + 1


OPERATIONS = {
    "product": (lambda x, y: enclosure.product(x, y), lambda a, b: a * b),
    "square": (lambda x, y: enclosure.square(x), lambda a, b: a * a),
    "square_root": (lambda x, y: enclosure.square_root(x), lambda a, b: np.sqrt(a)),
    "reciprocal": (lambda x, y: enclosure.reciprocal(x), lambda a, b: 1.0 / a),
    "positive_part": (lambda x, y: enclosure.positive_part(y), lambda a, b: np.maximum(b, 0.0)),
    "difference": (lambda x, y: enclosure.difference(x, y), lambda a, b: a - b),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_forms__enclose_what_they_stand_for(name):
    enclose, exact = OPERATIONS[name]
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, y = rng.normal(0.0, 0.2, 5), rng.normal(0.0, 0.6, 5)
        x[0], x[-1], y[-1] = 1.5 + rng.random(), abs(x[-1]), abs(y[-1])
        x[1:] *= 1.3 / max(np.abs(x[1:]).sum(), 1.3)
        at = rng.choice([-1.0, 1.0, 0.3], (64, 3))
        a = x[0] + at @ x[1:4] + x[4] * rng.choice([-1.0, 1.0], 64)
        b = y[0] + at @ y[1:4] + y[4] * rng.choice([-1.0, 1.0], 64)
        out = enclose(x, y)
        assert (np.abs(exact(a, b) - out[0] - at @ out[1:4]) <= out[4] + 1e-12).all()


def test_by_hand__two_vehicles_the_bound_is_that_of_the_least_gap():
    scenario, worlds = two(speed=14.0)  # full braking by 5 m/s2 from 15 m: the front stands
    _, boxes = boxed(scenario, worlds, "gaps_m=2")
    plan = np.full((1, STEPS), -1.0)
    # 13 m in the worst world: 14^2 - 2 * 5 * 13
    assert boxes.bound(np.arange(1), plan, np.zeros(1), 1)[0] == pytest.approx(66.0, abs=1e-3)
    _, boxes = boxed(scenario, worlds, "gaps_m=2,speeds_mps.vehicle_2=1")
    found = boxes.bound(np.arange(1), plan, np.zeros(1), 25)[0]
    assert 15.0**2 - 130.0 <= found <= 15.0**2 - 130.0 + 1.0


@pytest.mark.parametrize("name", UNUSUAL)
def test_bound__is_at_least_the_harm_of_every_world_drawn_from_the_box(name):
    changed, text = UNUSUAL[name]
    scenario = load_scenario("paper-random").replace(early_impacts="keep", **changed)
    rng, finite = np.random.default_rng(5), 0
    for k in range(2):
        worlds = scenario.sample(1, 3, first=k).worlds
        uncertainty, boxes = boxed(scenario, worlds, text)
        for plan in (np.full(width(scenario), -0.9), np.repeat(rng.uniform(-1.0, 0.6, 30), 4)[: width(scenario)]):
            bound = boxes.bound(np.arange(1), plan[np.newaxis], np.zeros(1), 5)[0]
            finite += bool(np.isfinite(bound))
            assert harm_inside(scenario, uncertainty, worlds, plan, 25, rng).max() <= bound
    assert finite == 4


# an impact, and then: bounces while they brake to a stop; a pair pressed together, a push beyond a speed limit, a drive
# that begins at an uncertain time and ends at a limit; a light one between two heavy ones
STATES = {
    "bounces": (
        {"gaps_m": [1, 12], "speeds_mps": [10, 12, 10], "restitution": 0.4, "braking_capacity_mps2": [8, 5, 6]},
        "gaps_m.pair_1=0.05,speeds_mps.vehicle_2=0.2",
    ),
    "pressed": (
        {"gaps_m": [2, 9], "speeds_mps": [12, 20, 15], "restitution": 0.2, "braking_capacity_mps2": [8, 5, 6]},
        "speeds_mps.vehicle_1=0.2,mass_t.vehicle_2=5%,latency_s.vehicle_1=0.05",
    ),
    "limits": (
        {
            "gaps_m": [2, 3],
            "speeds_mps": [18, 19, 21],
            "speed_limit_mps": 21.2,
            "driving_capacity_mps2": 5,
            "roles": {"vehicle_1": "constant:-4", "vehicle_2": "learner", "vehicle_3": "coast"},
        },
        "latency_s.vehicle_1=0.1,driving_capacity_mps2.vehicle_2=10%,speeds_mps.vehicle_1=0.2",
    ),
    "light": (
        {"gaps_m": [1, 8], "speeds_mps": [9, 15, 12], "mass_t": [5, 0.3, 4], "restitution": 0.05},
        "gaps_m=0.1,braking_capacity_mps2.vehicle_2=3%",
    ),
}


@pytest.mark.parametrize("name", STATES)
def test_states__of_every_world_are_those_of_some_path(name):
    changed, text = STATES[name]
    scenario = load_scenario("paper-random").replace(early_impacts="keep", **changed)
    worlds, rng = scenario.sample(1, 3).worlds, np.random.default_rng(2)
    uncertainty, boxes = boxed(scenario, worlds, text)
    for plan in (np.full(width(scenario), -1.0), np.repeat(rng.uniform(-1.0, 0.6, 30), 4)[: width(scenario)]):
        found = outside(scenario, uncertainty, boxes, worlds, 1, plan, 12, rng)
        assert found.outside[:3] == []
        assert found.touching > 0 and found.states > found.touching


def test_by_hand__an_impact_before_the_first_decision_is_not_waited_for():
    # 9.5 m/s faster, 1 m apart: they meet 0.1 s after the alert; decisions begin between 0.05 and 0.55 s
    scenario = load_scenario("paper-random").replace(
        early_impacts="keep", gaps_m=[1, 30], speeds_mps=[10, 19.5, 10], latency_s=[0.9, 0.3, 0.9]
    )
    worlds = scenario.sample(1, 3).worlds
    _, boxes = boxed(scenario, worlds, "latency_s.vehicle_2=0.25")
    known = Known(1, boxes.constant[0], boxes.limit[0], 0.1, 0.0, boxes.time_step_s, boxes.horizon_s)
    free = np.flatnonzero(boxes.high[0] > boxes.low[0])
    for low, met in ((0.05, True), (0.5, False)):
        box = boxes.low[0].copy()
        box[free] = low
        assert wait(*cell_of(box, boxes.high[0], free, known, np.full(width(scenario), -1.0))) != met


def test_bound__is_never_above_what_speeds_allow():
    # a light one, thrown back by a heavy one: no path is followed, and the bound is still a number
    changed, text = UNUSUAL["very unequal masses"]
    scenario = load_scenario("paper-random").replace(early_impacts="keep", **changed)
    worlds = scenario.sample(1, 3).worlds
    uncertainty, boxes = boxed(scenario, worlds, text)
    plan = np.full(width(scenario), -0.9)
    bound = boxes.bound(np.arange(1), plan[np.newaxis], np.zeros(1), 1)[0]
    fastest, e = worlds.speeds_mps.max(), 0.3
    assert harm_inside(scenario, uncertainty, worlds, plan, 50, np.random.default_rng(1)).max() <= bound
    assert bound <= fastest**2 * (1.0 + (1.0 + e) ** 2) + 1e-9


def test_engine__with_an_uncertain_own_latency_no_world_of_the_box_is_distrusted_or_above_the_bound():
    # vehicle_3 is faster at the alert and brakes through the speed of vehicle_2 then: gap 2 has its extreme in between
    changed = {"gaps_m": [60, 25], "speeds_mps": [20, 20, 21], "latency_s": [0, 0.3, 0.8]}
    scenario = load_scenario("paper-random").replace(**changed)
    told = scenario.sample(1, 3).worlds.take(np.zeros(4, np.int64))
    uncertainty = parse_uncertainty("latency_s.vehicle_2=0.15")
    truth = uncertainty.draw(told, np.random.default_rng(1))
    driver = ShieldedDriver(make_agent("constant:3"), scenario, uncertainty=uncertainty, robust="interior", told=told)
    episodes = drive(truth, driver, scenario, 1)
    harm, shield = episodes.ledger.world_harm("first"), episodes.guarded.shield
    assert not shield.distrusted.any()
    assert (harm <= shield.predicted_harm + 1e-9).all()


def test_bound__more_parts_never_make_it_worse():
    scenario = load_scenario("paper-random")
    worlds = scenario.sample(1, 7, first=11).worlds
    _, boxes = boxed(scenario, worlds, "gaps_m=0.5")
    plan = np.full((1, width(scenario)), -0.9)
    found = [boxes.bound(np.arange(1), plan, np.zeros(1), cells)[0] for cells in (1, 5, 21)]
    assert found[0] >= found[1] >= found[2] > 0.0


def test_shield__coasting_stays_within_the_bound_in_every_world_of_the_box():
    scenario = load_scenario("paper-random")
    worlds = scenario.sample(2, 7, first=11).worlds
    uncertainty = parse_uncertainty("gaps_m=0.5")
    shield = StepShield(scenario, 1, uncertainty=uncertainty, robust="interior")
    shield.begin(worlds, np.arange(2))
    told = [shield.bound.copy()]
    while not shield.running.finished.all():
        shield.decide(np.zeros(2))
        told.append(shield.bound.copy())
    assert (np.diff(told, axis=0) <= 0.0).all() and (shield.interventions > 0).all()
    assert (shield.interventions < shield.running.steps).any()  # and some of it was let through
    rng = np.random.default_rng(1)
    for k in range(2):
        harm = harm_inside(scenario, uncertainty, worlds.take([k]), shield.backup.plan[k], 300, rng)
        assert harm.max() <= shield.bound[k] <= shield.first_bound[k]
    assert (shield.bound < 200.0).all()


def test_shield__the_bound_falls_only_with_another_plan():
    scenario = load_scenario("paper-random")
    shield = StepShield(scenario, 1, uncertainty=parse_uncertainty("gaps_m=0.5"), robust="interior")
    shield.begin(scenario.sample(6, 3).worlds, np.arange(6))
    rng, same = np.random.default_rng(0), 0
    while not shield.running.finished.all():
        held, going = shield.backup, ~shield.running.finished
        shield.decide(rng.uniform(-1.0, 1.0, 6))
        kept = going & (shield.backup.plan == held.plan).all(axis=1)
        assert (shield.backup.harm[kept] == held.harm[kept]).all()  # not the lower harm of its corners
        same += kept.sum()
    assert same > 10


def test_no_width__is_step_mode_to_the_bit():
    scenario = line(3)
    worlds, bounds = scenario.sample(5, 3).worlds, []
    for settings in ({}, {"uncertainty": parse_uncertainty("mass_t=0%"), "robust": "interior"}):
        shield = StepShield(scenario, 1, **settings)
        shield.begin(worlds, np.arange(5))
        for _ in range(5):
            shield.decide(np.zeros(5))
        bounds.append(shield.bound.tolist())
    assert bounds[0] == bounds[1]


def test_agents__are_written_with_the_interior():
    scenario = load_scenario("paper-random")
    agent = make_agent("full_brake+robust:interior", scenario=scenario, uncertainty="gaps_m=0.5")
    assert agent.name == "full_brake+robust:interior"


@pytest.mark.parametrize(
    ("scenario", "count", "message"),
    [
        (line(5), "first", "5 vehicles"),
        (load_scenario("paper-random-obstacle"), "first", "an obstacle ahead"),
        (load_scenario("paper-random"), "total", "total harm"),
        (
            load_scenario("paper-random").replace(
                early_impacts="keep",
                roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "gentlest_front"},
            ),
            "first",
            "gentlest_front",
        ),
    ],
)
def test_refused__what_it_cannot_certify_when_it_is_made(scenario, count, message):
    vehicle, text = scenario.learners[0], "gaps_m.pair_1=0.1"
    with pytest.raises(InvalidInput, match=f"robust interior: .*{message}"):
        StepShield(scenario, vehicle, harm_count=count, uncertainty=parse_uncertainty(text), robust="interior")
    with pytest.raises(InvalidInput, match=f"robust interior: .*{message}"):
        make_agent("full_brake+robust:interior", scenario=scenario, uncertainty=text, harm_count=count)
    with pytest.raises(InvalidInput, match=f"robust interior: .*{message}"):
        HybridShield(parallel_env(scenario), mode="robust", uncertainty=text, robust="interior", harm_count=count)
    StepShield(scenario, vehicle, harm_count=count, uncertainty=parse_uncertainty(text))  # corners take it


def test_refused__what_only_the_worlds_tell_when_they_begin():
    scenario = line(3).replace(braking_capacity_mps2=[6.0, 6.0, 5.2])  # vehicle_3 holds 5 m/s2, which 4.68 cannot
    shield = StepShield(scenario, 1, uncertainty=parse_uncertainty("braking_capacity_mps2=10%"), robust="interior")
    with pytest.raises(InvalidInput, match=r"constant:5.*(capacity|another one in each world)"):
        shield.begin(scenario.sample(1, 0).worlds, np.arange(1))


def test_refused__an_unknown_certainty_and_one_without_uncertainty():
    with pytest.raises(UnknownName, match="corners"):
        ShieldOptions(uncertainty="gaps_m=1", robust="edges")
    with pytest.raises(InvalidInput, match="robust"):
        ShieldOptions(mode="step", robust="interior")
