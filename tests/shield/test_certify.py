"""The pure decision of the step shield: by hand, and against the engine. Small enough to run uncompiled."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import make_worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import profile_problem
from ethbrake_marl.shield.step_shield import CONSTANTS, REASONS, Backup, begin_running, certify, plan_harm
from tests.shield.attacks import line

STEPS = 81


def two(speed=10.0, latency=0.0):
    """Vehicle 1 stands 15 m ahead of Vehicle 2, which brakes with at most 5 m/s2: it stops after 10 m."""
    scenario = Scenario(
        name="two", vehicles=2, gaps_m=15, speeds_mps=[0, speed], braking_capacity_mps2=5, driving_capacity_mps2=5,
        mass_t=1, latency_s=[0, latency], roles={"vehicle_1": "full_brake", "vehicle_2": "learner"},
    )  # fmt: skip
    return scenario, scenario.sample(1, 0).worlds


def start(worlds, vehicle, plan, **settings):
    running = begin_running(profile_problem(worlds, [vehicle], **settings))
    return running, Backup(plan, plan_harm(running, plan))


def reason(decision):
    return REASONS[decision.reason[0]]


def test_by_hand__braking_may_wait_as_long_as_it_still_avoids():
    _, worlds = two()
    running, backup = start(worlds, 1, np.full((1, STEPS), -1.0))
    assert backup.harm.tolist() == [0.0]
    waited = 0
    while True:
        decision = certify(running, np.zeros(1), backup, backup.harm)
        if decision.intervened[0]:
            break
        running, backup, waited = decision.after, decision.backup, waited + 1
    # 10 m/s, 15 m: 10 m to stop leave 5 m, which is 0.5 s. (To touch at rest is no impact.)
    assert waited == 5
    assert reason(decision) == "no certificate" and decision.applied[0] == -1.0
    # one step more: 1 m too far, so an impact at sqrt(2 * 5 * 1) m/s
    assert decision.margin[0] == pytest.approx(-10.0, abs=1e-9)


def test_by_hand__latency_counts():
    _, worlds = two(latency=0.5)
    running, backup = start(worlds, 1, np.full((1, STEPS), -1.0))
    decision = certify(running, np.zeros(1), backup, backup.harm)
    assert decision.intervened[0]  # the 5 m to spare went by before the first decision
    assert backup.harm[0] == pytest.approx(0.0, abs=1e-9)


def test_by_hand__a_pair_counts_once_for_the_first_impact_and_each_time_for_the_total():
    worlds = make_worlds(
        [[1.0]], [[0.0, 10.0]], braking_capacity_mps2=[[8.0, 1.0]], driving_capacity_mps2=0.0, latency_s=0.0,
        mass_t=1.0, restitution=0.5,
    )  # fmt: skip
    plan = np.zeros((1, STEPS))
    plan[0, :5] = -1.0
    harm = {}
    for count in ("first", "total"):
        running, backup = start(worlds, 1, plan, harm_count=count, others_mps2=np.array([[-8.0, 0.0]]))
        harm[count] = backup.harm[0]
        for _ in range(3):
            decision = certify(running, plan[:, int(running.steps[0])], backup, backup.harm)
            running, backup = decision.after, decision.backup
        assert backup.harm[0] == harm[count]
    assert harm["first"] == pytest.approx(98.0, abs=1e-9)  # 10^2 - 2 * 1 * 1
    assert harm["total"] > harm["first"] + 0.5


def test_plan__a_proposal_equal_to_it_costs_nothing_and_changes_nothing():
    _, worlds = two(15.0)
    running, backup = start(worlds, 1, np.full((1, STEPS), -0.7))
    decision = certify(running, np.array([-0.7]), backup, backup.harm)
    assert reason(decision) == "same as plan" and not decision.intervened[0]
    assert decision.bound.tolist() == backup.harm.tolist() and decision.margin.tolist() == [0.0]


def test_constant__gives_a_certificate_where_the_plan_gives_none():
    _, worlds = two(12.0)  # 14.4 m to stop
    plan = np.full((1, STEPS), -0.96 - 1e-9)  # 15 m to stop: nothing to spare
    running, backup = start(worlds, 1, plan)
    assert backup.harm[0] == 0.0
    decision = certify(running, np.array([-0.9]), backup, backup.harm)
    assert reason(decision) == "constant" and decision.backup.plan[0, 1:].tolist() == [-1.0] * (STEPS - 1)
    without = certify(running, np.array([-0.9]), backup._replace(constants=np.zeros(0)), backup.harm)
    assert without.intervened[0] and without.applied[0] == plan[0, 0]


def test_budget__above_the_plan_lets_more_through_but_never_more_than_that():
    _, worlds = two(15.0)
    plan = np.full((1, STEPS), -1.0)
    running, backup = start(worlds, 1, plan)
    assert backup.harm[0] == pytest.approx(225.0 - 150.0)
    budget = backup.harm + 20.0
    while not running.ended[0]:
        decision = certify(running, np.ones(1), backup, budget)
        running, backup = decision.after, decision.backup
        assert backup.harm[0] <= budget[0]
    assert plan_harm_of_state(running) == backup.harm[0] > budget[0] - 20.0


def plan_harm_of_state(running):
    return float(running.states[0, 4])  # two vehicles: speeds 2, gap, hit, first-impact harm


@pytest.mark.parametrize("value", [np.nan])
def test_proposal__that_is_no_number_is_replaced(value):
    _, worlds = two()
    running, backup = start(worlds, 1, np.full((1, STEPS), -1.0))
    decision = certify(running, np.array([value]), backup, backup.harm)
    assert decision.intervened[0] and reason(decision) == "not a number" and decision.applied[0] == -1.0


@pytest.mark.parametrize(("value", "applied"), [(-7.0, -1.0), (-np.inf, -1.0)])
def test_proposal__beyond_the_range_is_clipped_before_it_is_certified(value, applied):
    _, worlds = two(15.0)
    running, backup = start(worlds, 1, np.full((1, STEPS), -0.8))
    decision = certify(running, np.array([value]), backup, backup.harm)
    same = certify(running, np.array([applied]), backup, backup.harm)
    assert decision.applied.tolist() == [applied] and decision.bound.tolist() == same.bound.tolist()
    assert decision.after.states.tolist() == same.after.states.tolist()


def test_certify__changes_nothing_it_is_given():
    _, worlds = two(15.0)
    running, backup = start(worlds, 1, np.full((1, STEPS), -0.8))
    before = running.states.copy(), backup.plan.copy(), backup.harm.copy()
    certify(running, np.array([0.3]), backup, backup.harm)
    assert [a.tolist() for a in before] == [running.states.tolist(), backup.plan.tolist(), backup.harm.tolist()]


def test_bad_input__is_refused():
    _, worlds = two()
    running, backup = start(worlds, 1, np.full((1, STEPS), -1.0))
    with pytest.raises(InvalidInput, match=r"proposed \(2,\)"):
        certify(running, np.zeros(2), backup, backup.harm)
    with pytest.raises(InvalidInput, match="below the backup's harm"):
        certify(running, np.zeros(1), backup, backup.harm - 1.0)
    with pytest.raises(InvalidInput, match=r"plan \(1, 3\)"):
        plan_harm(running, np.zeros((1, 3)))


@pytest.mark.parametrize(("N", "harm_count"), [(3, "first"), (3, "total"), (5, "total")])
def test_engine__realises_the_certified_harm_to_the_bit_whatever_is_proposed(N, harm_count):
    scenario = line(N)
    worlds, learner = scenario.sample(5, N).worlds, scenario.learners[0]
    scripts = {i: make_agent(spec) for i, spec in scenario.scripts.items()}
    engine = Engine(scenario, worlds.n, learners=(learner,), scripts=scripts, worlds=worlds)
    others = engine.wanted_mps2.copy()
    plan = np.full((worlds.n, STEPS), -0.6)
    running, backup = start(worlds, learner, plan, others_mps2=others, harm_count=harm_count)
    backup = backup._replace(constants=np.array(CONSTANTS[::5]))
    first, rng = backup.harm, np.random.default_rng(N)
    bounds = [first]
    while not engine.ended.all():
        decision = certify(running, rng.uniform(-1.2, 1.2, worlds.n), backup, backup.harm)
        engine.step(decision.applied[:, np.newaxis])
        running, backup = decision.after, decision.backup
        bounds.append(decision.bound)
        assert running.states[:, :N].tolist() == engine.worlds.speeds_mps.tolist()
        assert running.ended.tolist() == engine.ended.tolist()
    assert (np.diff(bounds, axis=0) <= 0.0).all()
    assert engine.ledger.world_harm(harm_count).tolist() == backup.harm.tolist()
    assert (backup.harm <= first).all() and (first > 0.0).any()
