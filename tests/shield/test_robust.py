"""Robust mode: the bound holds in every member, by hand and to the bit."""

from __future__ import annotations

import itertools

import gymnasium
import numpy as np
import pytest

from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.envs.interfaces import parallel_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import profile_problem
from ethbrake_marl.shield import HybridShield, ShieldedDriver, ShieldedEnv, StepShield, parse_uncertainty
from ethbrake_marl.shield.step_shield import REASONS, Backup, begin_running, certify, plan_harm
from tests.shield.attacks import line
from tests.shield.test_certify import STEPS, two

ALL = {
    3: "braking_capacity_mps2=5%,latency_s.vehicle_2=0.15,gaps_m.pair_1=0.5,mass_t.vehicle_3=20%",
    5: "speeds_mps.vehicle_1=1,latency_s.vehicle_3=0.2,gaps_m.pair_3=1,driving_capacity_mps2.vehicle_3=0.5",
}


class Adversary:
    """Random commands, or full driving and full braking in turn."""

    def __init__(self, name, seed=0):
        self.name, self._rng = name, np.random.default_rng(seed)

    def act(self, worlds, vehicle):
        v = worlds.vehicles
        share = self._rng.uniform(-1.0, 1.0, worlds.n)
        if self.name == "extremes":
            share = np.sign(np.sin(31.0 * worlds.time_s + worlds.gaps_m[:, 0]))
        return np.where(
            share < 0.0, share * v.braking_capacity_mps2[:, vehicle], share * v.driving_capacity_mps2[:, vehicle]
        )


def started(worlds, vehicle, text, plan):
    uncertainty = parse_uncertainty(text)
    members = uncertainty.members(worlds)
    running = begin_running(profile_problem(members, [vehicle]), members.n // worlds.n)
    return running, Backup(plan, plan_harm(running, plan))


def waits(running, backup):
    """Steps of coasting that are let through, and what was applied until the first one that is not."""
    applied = []
    while True:
        decision = certify(running, np.zeros(1), backup, backup.harm)
        applied.append(decision.applied[0])
        if decision.intervened[0]:
            return len(applied) - 1, applied
        running, backup = decision.after, decision.backup


@pytest.mark.parametrize(
    ("text", "steps"),
    [
        ("gaps_m=0", 5),  # 15 m, 10 m to stop: 5 m at 10 m/s
        ("gaps_m=2", 3),  # 13 m in the worst corner
        ("braking_capacity_mps2.vehicle_2=20%", 2),  # 12.5 m to stop with 4 m/s2: 2.5 m
        ("speeds_mps.vehicle_2=2", 0),  # 12 m/s: 14.4 m to stop; 0.6 m is half a step
        ("mass_t=50%", 5),  # changes nothing before an impact
    ],
)
def test_by_hand__coasting_is_let_through_as_long_as_the_worst_corner_can_still_stop(text, steps):
    _, worlds = two()
    running, backup = started(worlds, 1, text, np.full((1, STEPS), -1.0))
    assert backup.harm.tolist() == [0.0]
    assert waits(running, backup)[0] == steps


def test_by_hand__what_the_nominal_shield_certifies_breaks_its_bound_in_a_corner():
    _, worlds = two()
    plan, corners = np.full((1, STEPS), -1.0), "gaps_m=2"
    realised = {}
    for belief in ("gaps_m=0", corners):
        _, applied = waits(*started(worlds, 1, belief, plan))
        driven = plan.copy()
        driven[0, : len(applied)] = applied
        realised[belief] = plan_harm(started(worlds, 1, corners, plan)[0], driven)[0]
    # 0.5 s of coasting leave 8 of 13 m, 10 are needed: an impact at sqrt(2 * 5 * 2) m/s
    assert realised["gaps_m=0"] == pytest.approx(20.0, abs=1e-9)
    assert realised[corners] == 0.0


def test_bound__at_the_alert_is_that_of_the_best_constant_in_the_worst_corner():
    scenario = Scenario(
        name="between", vehicles=3, gaps_m=[6, 6], speeds_mps=[20, 20, 20], braking_capacity_mps2=[8, 8, 5],
        driving_capacity_mps2=2, mass_t=1, latency_s=[0, 0.5, 0.5],
        roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "full_brake"},
    )  # fmt: skip
    worlds, uncertainty = scenario.sample(1, 0).worlds, parse_uncertainty("gaps_m=3")
    shield = StepShield(scenario, 1, uncertainty=uncertainty)
    shield.begin(worlds, np.arange(1))
    alone = []
    for m in range(5):
        one = StepShield(scenario, 1)
        one.begin(uncertainty.members(worlds).take([m]), np.arange(1))
        alone.append(one.first_bound[0])
    assert shield.running.members == 5 and len(set(alone)) > 2
    assert shield.first_bound[0] >= max(alone) - 1e-9  # no single deceleration is best in all of them
    assert shield.first_bound[0] > alone[0] + 1.0
    tried = [plan_harm(shield.running, np.full((1, STEPS), -a))[0] for a in np.linspace(0.0, 1.0, 41)]
    assert shield.first_bound[0] <= min(tried)


@pytest.mark.parametrize(
    ("N", "harm_count", "who"),
    [
        (3, "first", "random"),
        (3, "total", "extremes"),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in itertools.product((3, 5), ("first", "total"), ("random", "extremes"))
            if each not in ((3, "first", "random"), (3, "total", "extremes"))
        ),
    ],
)
def test_every_member__realises_at_most_the_bound_to_the_bit(N, harm_count, who):
    scenario = line(N)
    worlds, vehicle = scenario.sample(3, 21).worlds, scenario.learners[0]
    uncertainty = parse_uncertainty(ALL[N])
    members = uncertainty.members(worlds)
    M, tight = members.n // worlds.n, 0
    for m in range(0, M, 10 if N == 3 else 5):
        truth = members.take(np.arange(worlds.n) * M + m)
        shielded = ShieldedDriver(
            Adversary(who, m),
            scenario,
            harm_count=harm_count,
            uncertainty=uncertainty,
            told=worlds,
            later_rollouts=m == 0,
        )
        episodes = drive(truth, shielded, scenario, vehicle)
        harm, shield = episodes.ledger.world_harm(harm_count), episodes.guarded.shield
        assert (harm <= shield.predicted_harm).all()
        assert (harm <= shield.bound).all() and (shield.bound <= shield.predicted_harm).all()
        assert not shield.distrusted.any()
        tight += int((harm > 0.9 * shield.bound).sum())
    assert tight > 0  # the bound is not out of reach


def test_every_member__is_bounded_by_the_same_actions():
    """What is applied in the world as told leaves the harm of each corner below the bound, too."""
    scenario = line(3)
    worlds = scenario.sample(8, 5).worlds
    shield = StepShield(scenario, 1, uncertainty=parse_uncertainty(ALL[3]))
    shield.begin(worlds, np.arange(worlds.n))
    rng, first, start = np.random.default_rng(0), shield.first_bound.copy(), shield.running
    while not shield.running.finished.all():
        shield.decide(rng.uniform(-1.0, 1.0, worlds.n))
    assert plan_harm(start, shield.backup.plan).tolist() == shield.bound.tolist()
    assert (shield.bound <= first).all() and (first > 0.0).any()


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_no_width__is_step_mode_to_the_bit(harm_count):
    scenario = line(3)
    worlds = scenario.sample(12, 3).worlds
    harms, bounds = [], []
    for settings in ({}, {"uncertainty": "latency_s=0,mass_t=0%"}):
        shielded = ShieldedDriver(Adversary("random"), scenario, harm_count=harm_count, **settings)
        episodes = drive(worlds, shielded, scenario, 1)
        harms.append(episodes.ledger.world_harm(harm_count).tolist())
        bounds.append(episodes.guarded.shield.bound.tolist())
    assert harms[0] == harms[1] and bounds[0] == bounds[1]


def test_seen__inside_the_range_of_the_members_is_no_surprise_outside_is_one():
    scenario, worlds = two(speed=14.0)
    uncertainty = parse_uncertainty("gaps_m=2,speeds_mps.vehicle_2=1")
    for gap, surprising in ((13.2, False), (12.9, True)):
        truth = scenario.replace(gaps_m=gap).sample(1, 0).worlds
        shielded = ShieldedDriver(make_agent("full_brake"), scenario, uncertainty=uncertainty, told=worlds)
        episodes = drive(truth, shielded, scenario, 1)
        harm, shield = episodes.ledger.world_harm("first"), episodes.guarded.shield
        assert shield.distrusted.tolist() == [surprising]
        assert surprising or 0.0 < harm[0] <= shield.predicted_harm[0]
    shield = StepShield(scenario, 1, uncertainty=uncertainty)
    shield.begin(worlds, np.arange(1))
    decision = shield.decide(np.zeros(1), seen=np.array([[0.0, 14.0, 5.0, 0.0]]))
    assert REASONS[decision.reason[0]] == "assumption broken"
    # what is seen counts from now on: 5 m left at 14 m/s
    assert decision.applied[0] == -1.0 and decision.bound[0] == pytest.approx(14.0**2 - 2 * 5 * 5)


def test_begin__of_some_rows_leaves_the_members_of_others_alone():
    scenario = line(3)
    worlds = scenario.sample(6, 2).worlds
    shield = StepShield(scenario, 1, uncertainty=parse_uncertainty("gaps_m.pair_1=0.5"))
    shield.begin(worlds.take(np.arange(4)), np.arange(4))
    shield.decide(np.zeros(4))
    before = shield.running.states.copy()
    shield.begin(worlds.take([5]), np.array([2]))
    assert shield.running.steps.tolist() == [1, 1, 0, 1]
    kept = np.array([0, 1, 3])
    rows = shield.running.rows_of(kept)
    assert rows.tolist() == [0, 1, 2, 3, 4, 5, 9, 10, 11]
    assert shield.running.states[rows].tolist() == before[rows].tolist()


def test_interfaces__take_the_mode_and_tell_how_many_members():
    env = HybridShield(parallel_env(), mode="robust", uncertainty="gaps_m=0.5")
    env.reset(seed=3)
    first = env.attached.shield.first_bound[0]
    while env.agents:
        *_, infos = env.step({"vehicle_2": np.array([1.0])})
        told = infos["vehicle_2"]["shield"]
        assert told["mode"] == "robust" and told["members"] == 5 and told["trusted"] and told["bound_harm"] <= first
    assert env.unwrapped.engine.ledger.world_harm("first")[0] <= told["bound_harm"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mode": "robust"}, "mode robust needs an uncertainty"),
        ({"mode": "step", "uncertainty": "gaps_m=1"}, "mode step takes no uncertainty"),
        ({"mode": "robust", "uncertainty": 3.0}, "must be an Uncertainty or text"),
        ({"mode": "robust", "uncertainty": "gap=1"}, "unknown uncertain quantity"),
    ],
)
def test_refused__mode_and_uncertainty_that_do_not_fit(settings, message):
    with pytest.raises(InvalidInput, match=message):
        HybridShield(parallel_env(), **settings)


def test_refused__by_the_gymnasium_interface_too():
    with pytest.raises(InvalidInput, match="must be an Uncertainty or text"):
        ShieldedEnv(gymnasium.make("EthBrake-v0"), uncertainty=1)
