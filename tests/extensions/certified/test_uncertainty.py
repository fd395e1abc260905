"""Intervals, the members that stand for them, and robust mode, whose bound holds in every member."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.certified.options import checked_uncertainty
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields.certify import plan_harm
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.reasons import ShieldReason
from tests.first_edition.physics.random_worlds import Draws
from tests.first_edition.shield.attacks import Hostile, begun, line
from tests.fixtures.lines import line as one_line
from tests.golden.test_golden import decisions_hash

EVERY = {
    3: "braking_capacity_mps2=5%,latency_s.vehicle_2=0.15,gaps_m.pair_1=0.5,mass_t.vehicle_3=20%",
    5: "speeds_mps.vehicle_1=1,latency_s.vehicle_3=0.2,gaps_m.pair_3=1,driving_capacity_mps2.vehicle_3=0.5",
}
WORLD = one_line([10.0, 8.0], [20.0, 18.0, 39.9], [8.0, 6.0, 5.0], [0.0, 0.4, 0.7], driving=2.0, mass=[1.0, 2.0, 4.0])


@pytest.mark.parametrize(
    ("text", "members"),
    [("latency_s=0.1", 1 + 2**3), ("latency_s=0.1,gaps_m=1", 1 + 2**5), ("latency_s=0,gaps_m=0%", 1)],
)
def test_members__of_every_vehicle_where_none_is_named_and_none_of_no_width(text, members):
    assert parse_uncertainty(text).members(WORLD).n == members


def test_draw__is_inside_the_box_or_at_a_corner():
    worlds, uncertainty = WORLD.take(np.zeros(50, np.int64)), parse_uncertainty("gaps_m=0.5,speeds_mps.vehicle_1=2")
    inside, corners = (uncertainty.draw(worlds, np.random.default_rng(0), corners=each) for each in (False, True))
    assert (abs(inside.gaps_m - worlds.gaps_m) < 0.5).all() and len(set(inside.gaps_m[:, 0])) == 50
    assert set(corners.gaps_m[:, 1]) == {7.5, 8.5} and set(corners.speeds_mps[:, 0]) == {18.0, 22.0}
    every, drawn = (
        {tuple(row) for row in np.hstack([some.gaps_m, some.speeds_mps])}
        for some in (uncertainty.members(WORLD), corners)
    )
    assert drawn <= every


@pytest.mark.parametrize("heard_s", [0.0, 0.5])
def test_draw__of_a_latency_is_of_the_own_part_and_the_news_or_over_a_channel_of_the_reaction_alone(heard_s):
    vehicles = replace(WORLD.vehicles, known_from_s=WORLD.vehicles.known_from_s + heard_s)
    told, rng = replace(WORLD, vehicles=vehicles), np.random.default_rng(3)
    drawn = parse_uncertainty("latency_s=0.1").draw(told, rng).vehicles
    if heard_s:
        assert drawn.known_from_s.tolist() == vehicles.known_from_s.tolist()
        assert drawn.own_latency_s.tolist() == vehicles.own_latency_s.tolist()
    else:
        assert (drawn.latency_s != vehicles.latency_s).all() and drawn.is_known_at_once


# Robust mode.


@pytest.mark.parametrize("N", [3, 5])
@pytest.mark.parametrize(("harm_count", "who"), [("first", "chance"), ("total", "drive")])
def test_every_member__realises_at_most_the_bound_to_the_bit(N, harm_count, who):
    scenario, uncertainty, tight = line(N), parse_uncertainty(EVERY[N]), 0
    worlds, vehicle = scenario.sample(3, 21).worlds, scenario.learners[0]
    members = uncertainty.members(worlds)
    M = members.n // worlds.n
    for m in range(0, M, 16 if N == 3 else 8):
        driver = ShieldedDriver(
            Hostile(who, m), scenario, harm_count=harm_count, uncertainty=uncertainty, assumed=worlds,
            later_rollouts=m == 0,
        )  # fmt: skip
        episodes = drive(members.take(np.arange(worlds.n) * M + m), driver, scenario, vehicle)
        harm, shield = episodes.ledger.world_harm(harm_count), episodes.guarded.shield
        assert (harm <= shield.bound).all() and (shield.bound <= shield.predicted_harm).all()
        assert not shield.memory.distrusted.any()
        tight += int((harm > 0.9 * shield.bound).sum())
    assert tight > 0  # the bound is not out of reach


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_no_width__is_step_mode_to_the_bit(harm_count):
    scenario, found = line(3), []
    for settings in ({}, {"uncertainty": "latency_s=0,mass_t=0%"}):
        driver = ShieldedDriver(Hostile("chance"), scenario, harm_count=harm_count, **settings)
        episodes = drive(scenario.sample(12, 3).worlds, driver, scenario, 1)
        found.append((episodes.ledger.world_harm(harm_count).tolist(), episodes.guarded.shield.bound.tolist()))
    assert found[0] == found[1]


# A front vehicle that stands, 15 +- 2 m ahead of one at 14 +- 1 m/s that brakes with at most 5 m/s2.
STANDING = Scenario(
    name="two", vehicles=2, gaps_m=15, speeds_mps=[0, 14], braking_capacity_mps2=5, driving_capacity_mps2=5,
    mass_t=1, latency_s=0, roles={"vehicle_1": "full_brake", "vehicle_2": "learner"},
)  # fmt: skip
OPEN = parse_uncertainty("gaps_m=2,speeds_mps.vehicle_2=1")


@pytest.mark.parametrize(("gap", "surprising"), [(13.2, False), (12.9, True)])
def test_seen__inside_the_range_of_the_members_is_no_surprise_outside_is_one(gap, surprising):
    told, truth = (scenario.sample(1, 0).worlds for scenario in (STANDING, STANDING.replace(gaps_m=gap)))
    driver = ShieldedDriver(make_agent("full_brake"), STANDING, uncertainty=OPEN, assumed=told)
    episodes = drive(truth, driver, STANDING, 1)
    shield = episodes.guarded.shield
    assert shield.memory.distrusted.tolist() == [surprising]
    assert surprising or 0.0 < episodes.ledger.world_harm("first")[0] <= shield.predicted_harm[0]


def test_parse__reads_what_str_writes_whatever_the_blanks() -> None:
    text = "braking_capacity_mps2=5%,latency_s.vehicle_2=0.1,gaps_m.pair_1=0.5"
    found = parse_uncertainty(text.replace("=", " = ").replace(",", " ,"))
    assert [(str(each), each.half_width, each.place) for each in found.intervals] == [
        ("braking_capacity_mps2=5%", 0.05, None),
        ("latency_s.vehicle_2=0.1", 0.1, 1),
        ("gaps_m.pair_1=0.5", 0.5, 0),
    ]
    assert str(found) == text
    assert parse_uncertainty(text) == checked_uncertainty(found) == found


def test_members__are_the_world_itself_and_every_corner() -> None:
    worlds = WORLD.take(np.zeros(2, np.int64))
    members = parse_uncertainty("gaps_m.pair_1=0.5,mass_t.vehicle_3=10%").members(worlds)
    assert members.gaps_m[:, 0].tolist() == [10.0, 9.5, 10.5, 9.5, 10.5, 10.0, 9.5, 10.5, 9.5, 10.5]
    assert members.vehicles.mass_t[:, 2] == pytest.approx(2 * [4.0, 3.6, 3.6, 4.4, 4.4], abs=1e-12)
    assert (members.gaps_m[:, 1] == 8.0).all()
    assert (members.vehicles.latency_s[:, 1] == 0.4).all()
    assert worlds.gaps_m[0, 0] == 10.0


def test_members__stay_within_what_is_possible() -> None:
    members = parse_uncertainty("latency_s.vehicle_1=0.1,speeds_mps.vehicle_3=5").members(WORLD)
    assert members.vehicles.latency_s[:, 0].tolist() == [0.0, 0.0, 0.1, 0.0, 0.1]
    assert members.speeds_mps[:, 2] == pytest.approx([39.9, 34.9, 34.9, 40.0, 40.0])


def test_bound_at_the_alert__is_that_of_the_best_constant_in_the_worst_corner() -> None:
    scenario = Scenario(
        name="between", vehicles=3, gaps_m=[6, 6], speeds_mps=[20, 20, 20], braking_capacity_mps2=[8, 8, 5],
        driving_capacity_mps2=2, mass_t=1, latency_s=[0, 0.5, 0.5],
        roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "full_brake"},
    )  # fmt: skip
    worlds, uncertainty = scenario.sample(1, 0).worlds, parse_uncertainty("gaps_m=3")
    shield = begun(scenario, worlds, RobustShield, uncertainty=uncertainty)
    alone = [begun(scenario, uncertainty.members(worlds).take([m])).memory.first_bound[0] for m in range(5)]
    tried = [plan_harm(shield.memory.running, np.full((1, 81), -a))[0] for a in np.linspace(0.0, 1.0, 41)]
    assert shield.memory.running.members == 5
    assert len(set(alone)) > 2
    # No single deceleration is best in all of them.
    assert max(*alone, alone[0] + 1.0) - 1e-9 <= shield.memory.first_bound[0] <= min(tried)


def test_seen__counts_from_then_on() -> None:
    shield = begun(STANDING, STANDING.sample(1, 0).worlds, RobustShield, uncertainty=OPEN)
    decision = shield.decide(np.zeros(1), seen=np.array([[0.0, 14.0, 5.0, 0.0]]))
    assert (ShieldReason(decision.reason[0]).text, decision.applied[0]) == ("assumption broken", -1.0)
    assert decision.bound[0] == pytest.approx(14.0**2 - 2 * 5 * 5)


PAPER = eb.load_scenario("paper-random")


FIXED = PAPER.replace(gaps_m=40, speeds_mps=20, latency_s=0, early_impacts="keep", horizon_s=30)


def test_uncertainty_of_friction__moves_all_capacities_together() -> None:
    # Its uncertainty moves all capacities together: of 0.6 +- 0.2, shares 0, 1/8, ..., 1 of the way up.
    worlds = FIXED.replace(friction=0.6, braking_capacity_mps2=[4, 7, 9]).sample(1, 7).worlds
    members = parse_uncertainty("friction=0.2,braking_capacity_mps2.vehicle_3=3").members(worlds)
    shares, dry = [0, 0.125, 0.25, 0.375, 0.625, 0.75, 0.875, 1], ([4, 7, 6], [4, 7, 12])
    expected = [[4, 5.886, 5.886]] + [np.minimum(d, 9.81 * (0.4 + 0.4 * share)) for d in dry for share in shares]
    assert members.vehicles.braking_capacity_mps2.shape == (17, 3)
    assert len(expected) == 17
    assert np.abs(members.vehicles.braking_capacity_mps2 - np.array(expected)).max() <= 1e-12


def test_friction__no_truth_of_its_box_is_distrusted_and_no_corner_is_above_the_bound() -> None:
    wet = load_scenario("engineering-wet-road").replace(time_gaps_s={"uniform": [0.2, 0.9]})
    told, rng = wet.sample(60, 7).worlds, np.random.default_rng(0)
    uncertainty = parse_uncertainty("friction=0.1")
    for corners, spec in ((True, "coast"), (True, "full_brake"), (False, "full_brake")):
        shield = ShieldedDriver(make_agent(spec), wet, assumed=told, uncertainty=uncertainty)
        found = drive(uncertainty.draw(told, rng, corners=corners), shield, wet, 1)
        assert not found.guarded.shield.memory.distrusted.any()
        harm = found.ledger.world_harm("first")
        assert not corners or (harm <= found.guarded.shield.predicted_harm + 1e-9).all()


def test_robust_shield__trusts_a_longer_line_inside_its_box() -> None:
    five = load_scenario("cooperation-2-five").replace(brake_rate_mps3=15, release_rate_mps3=25)
    told = five.sample(20, seed=7).worlds
    shift = Draws(2).uniform(-0.4, 0.4, (20, 4)) * [1.0, 0.0, 0.0, 0.0]
    task = Task(five, five.learners, "first")
    uncertain = parse_uncertainty("gaps_m.pair_1=0.5")
    shielded = ShieldedDriver.around(make_agent("full_brake"), task, mode="robust", uncertainty=uncertain, assumed=told)
    driven = drive(replace(told, gaps_m=told.gaps_m + shift), shielded, five)
    assert driven.guarded.shield.memory.distrusted.sum() == 0
    assert driven.ledger.world_harm("first").sum() > 0.0


def test_robust_shield__decisions_have_the_committed_bits() -> None:
    shield = RobustShield(PAPER, 1, uncertainty=parse_uncertainty("gaps_m=0.5"))
    assert decisions_hash(shield, 10) == "8845d4c2238eac5c"
