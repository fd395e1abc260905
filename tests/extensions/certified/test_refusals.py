"""Refusals of what guards against the unknown: uncertainties, settings, scenarios, and use out of order."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents import registry
from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.agents.registry import Entry
from ethbrake_marl.envs.gymnasium import EthBrakeEnv
from ethbrake_marl.envs.pettingzoo import parallel_env
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.extensions.certified.options import checked_uncertainty
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import Interval, Uncertainty, parse_uncertainty
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shields.options import ShieldOptions
from ethbrake_marl.shields.wrappers import HybridShield, ShieldedEnv
from tests.fixtures.commands import Refuse
from tests.fixtures.lines import line as one_line
from tests.refused import refused
from tests.shield.attacks import begun, line

PAPER, PAIR = load_scenario("paper-random"), load_scenario("cooperation-3-pair")
WORLDS = PAPER.sample(5, 3).worlds
BRAKE, COAST = make_agent("full_brake"), make_agent("coast")
PERIODIC = load_scenario("cooperation-2-paper").replace(v2x={"preset": "blocked", "persistence": "periodic"})
WORLD = one_line([10.0, 8.0], [20.0, 18.0, 39.9], [8, 6, 5], [0, 0.4, 0.7], driving=2.0, mass=[1, 2, 4])

UNCERTAINTIES: dict[str, Callable[[], object]] = {
    "uncertainty: '': entry 1 is empty; must be quantity=half-width": lambda: parse_uncertainty(""),
    "uncertainty: 'latency_s': must be quantity=half-width, for instance braking_capacity_mps2=5%": lambda: (
        parse_uncertainty("latency_s")
    ),
    "uncertainty: 'latency_s=-0.1': must be quantity=half-width": lambda: parse_uncertainty("latency_s=-0.1"),
    "uncertainty: 'latency_s=nan': must be quantity=half-width": lambda: parse_uncertainty("latency_s=nan"),
    "uncertainty: half-width of latency_s = inf: the half-width must be a finite number": lambda: parse_uncertainty(
        "latency_s=1e999"
    ),
    "uncertainty: half-width of latency_s = 1.0: the half-width must be a share from 0": lambda: parse_uncertainty(
        "latency_s=100%"
    ),
    "uncertainty: 'latency_s.vehicle_0=0.1': must be quantity=half-width": lambda: parse_uncertainty(
        "latency_s.vehicle_0=0.1"
    ),
    "uncertainty: 'latency_s.pair_1=0.1': only gaps_m may name a pair, as in gaps_m.pair_1": lambda: parse_uncertainty(
        "latency_s.pair_1=0.1"
    ),
    "uncertainty: latency_s=0.1 and latency_s=0.2 are intervals of the same quantity": lambda: parse_uncertainty(
        "latency_s=0.1,latency_s=0.2"
    ),
    "uncertainty: latency_s=0.1 and latency_s.vehicle_2=0.2 are intervals of the same quantity": lambda: (
        parse_uncertainty("latency_s=0.1,latency_s.vehicle_2=0.2")
    ),
    "uncertainty: mass_t.vehicle_4=0.1: there is no such vehicle, because the line has only 3": lambda: (
        parse_uncertainty("mass_t.vehicle_4=0.1").members(WORLD)
    ),
    "uncertainty: mass_t=1: the value 1 of vehicle_1 in world 0 may be as low as 0; must be above 0": lambda: (
        parse_uncertainty("mass_t=1").members(WORLD)
    ),
    "=1e+308: the value 10 of vehicle_1 to vehicle_2 in world 0 may be as high as 1e+308; must be finite": lambda: (
        parse_uncertainty("gaps_m=1e308").members(WORLD)
    ),
    "11 intervals in each world make 2048 combinations of values (corners), but at most 1024 are": lambda: (
        parse_uncertainty("latency_s=0.1,mass_t=0.1,speeds_mps=1,gaps_m=1").members(WORLD)
    ),
    "uncertainty: no interval; must have at least one": lambda: Uncertainty(()),
    "must be a tuple of Interval objects": lambda: Uncertainty("gaps_m=0.5"),
    "uncertainty: half-width of latency_s = -1.0: the half-width must be a finite number": lambda: Interval(
        "latency_s", -1.0
    ),
    "uncertainty: half-width of gaps_m = True: the half-width must be a finite number": lambda: Interval(
        "gaps_m", True
    ),
    "uncertainty: gaps_m: place = 0.5: must be an index of a vehicle or pair": lambda: Interval(
        "gaps_m", 0.5, place=0.5
    ),
    "uncertainty: gaps_m: place = -1: must be an index of a vehicle or pair": lambda: Interval("gaps_m", 0.5, place=-1),
    "uncertainty = 0.1: must be an Uncertainty or a text": lambda: checked_uncertainty(0.1),
}


@pytest.mark.parametrize("message", UNCERTAINTIES)
def test_uncertainty__is_refused(message: str) -> None:
    with refused(message):
        UNCERTAINTIES[message]()


SHIELDS: dict[str, Callable[[], object]] = {
    "mode robust needs a value of uncertainty, for instance braking_capacity_mps2=5%": lambda: make_agent(
        "full_brake+robust", scenario=PAIR
    ),
    "agent 'coast+step:estimated+robust': may have at most one search (+search), then at most one shield": lambda: (
        make_agent("coast+step:estimated+robust", scenario=PERIODIC)
    ),
    "agent 'e_v2x_bm:estimated+episode:estimated': e_v2x_bm:estimated already decides only on received": lambda: (
        make_agent("e_v2x_bm:estimated+episode:estimated", scenario=PERIODIC)
    ),
    "shield: robust='interior': total harm: cannot be certified; use robust='corners'": lambda: make_agent(
        "coast+robust:interior:estimated", scenario=PERIODIC, harm_count="total"
    ),
    "shield: robust='interior': an obstacle ahead: cannot be certified": lambda: make_agent(
        "coast+robust:interior:estimated", scenario=PERIODIC.replace(obstacle_gap_m=60.0)
    ),
    "shield: robust='interior': 5 vehicles: cannot be certified; use robust='corners', or first-impact": lambda: (
        RobustShield(line(5), 2, uncertainty=parse_uncertainty("gaps_m=0.1"), robust="interior")
    ),
    "shield: mode step does not use uncertainty; use mode robust": lambda: ShieldOptions(
        mode="step", uncertainty="gaps_m=1"
    ),
    "shield: robust = 'interior': not a setting of mode step; use mode robust": lambda: ShieldOptions(
        mode="step", robust="interior"
    ),
    "shield: allowance = 5.0: not a setting of mode episode; use mode step or robust": lambda: ShieldOptions(
        mode="episode", allowance=5.0
    ),
    "shield: logging = True: not a setting of mode episode; use mode step or robust": lambda: ShieldOptions(
        mode="episode", logging=True
    ),
    "shield: shares = True: not a setting of mode episode; use mode step or robust": lambda: ShieldOptions(
        mode="episode", shares=True
    ),
    "shield: estimated = True: not a setting of mode episode; use mode step or robust": lambda: ShieldOptions(
        mode="episode", estimated=True
    ),
    "shield: allowance = 1.0: must be 0.0 if estimated = True": lambda: ShieldOptions(estimated=True, allowance=1.0),
    "shield: cap = 'baseline': must be None if estimated = True": lambda: ShieldOptions(estimated=True, cap="baseline"),
    "shield: uncertainty = 'gaps_m=0.5': must be None if estimated = True": lambda: ShieldOptions(
        estimated=True, mode="robust", uncertainty="gaps_m=0.5"
    ),
    "shield: estimated = 'yes': must be True or False": lambda: ShieldOptions(estimated="yes"),
    "ShieldedEnv: mode robust needs a value of uncertainty, for instance braking_capacity_mps2=5%": lambda: ShieldedEnv(
        EthBrakeEnv(), mode="robust"
    ),
    "HybridShield: estimated = True: the shield can control only one learner": lambda: HybridShield(
        parallel_env(PAIR), mode="step", estimated=True
    ),
}


@pytest.mark.parametrize("message", SHIELDS)
def test_shield__is_refused(message: str) -> None:
    with refused(message):
        SHIELDS[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown uncertain quantity 'latencys'; did you mean 'latency_s'?": lambda: parse_uncertainty("latencys=0.1"),
    "unknown shield mode 'robus'; did you mean 'robust'?": lambda: ShieldOptions(mode="robus"),
    "unknown shield: robust 'edges'": lambda: ShieldOptions(uncertainty="gaps_m=1", robust="edges"),
    "unknown shield or search 'step:believed'; it is now called 'step:estimated'": lambda: make_agent(
        "coast+step:believed", scenario=PERIODIC
    ),
    "unknown variant of e_v2x_bm 'believed'; it is now called 'estimated'": lambda: make_agent(
        "e_v2x_bm:pairwise:believed", scenario=PERIODIC
    ),
    "unknown ShieldedEnv option 'believed'; it is now called 'estimated'": lambda: ShieldedEnv(
        EthBrakeEnv(PERIODIC), believed=True
    ),
    "unknown shield or search 'step:pairwise:estimated'; did you mean 'episode:pairwise:estimated'?": lambda: (
        make_agent("coast+step:pairwise:estimated", scenario=PERIODIC)
    ),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


def test_mixture__estimated_agents_need_one_of_its_scenarios() -> None:
    members = [{"scenario": load_scenario(name).declared()} for name in ("paper-random", "paper-random-brake-only")]
    with refused("is a mixture of scenarios, but estimated agents and shields need the ranges of one scenario"):
        ShieldedEnv(EthBrakeEnv(Scenario(name="mixed", mixture=members)), estimated=True)


def test_estimated_worlds__that_leave_too_much_open_are_refused() -> None:
    wide = {"braking_capacity_mps2": {"uniform": [3, 9]}, "mass_t": {"uniform": [2, 9]}, "driving_capacity_mps2": 3.0}
    wide = PAPER.replace(vehicles=4, latency_s=0.1, v2x="nominal", roles={"vehicle_2": "learner"}, **wide)
    with refused("make 16384 combinations (corners), but at most 1024 are allowed"):
        make_agent("coast+robust:estimated", scenario=wide)


def test_uncertain_latency__ends_before_the_horizon() -> None:
    with refused(
        "uncertainty: latency_s=1000: the first decision of vehicle_2 may be as late as 1000.5 s; must be before the"
        " horizon, 8 s"
    ):
        begun(PAPER, WORLDS, RobustShield, uncertainty=parse_uncertainty("latency_s=1000"))


def test_interior__takes_no_brakes_that_began_to_build_up_before() -> None:
    slow = PAPER.replace(brake_rate_mps3=9)
    braking = replace(slow.sample(1, 3).worlds, command_mps2=np.full((1, 3), -1.0))
    shield = RobustShield(slow, 1, uncertainty=parse_uncertainty("gaps_m=0.1"), robust="interior")
    with refused("shield: robust='interior': a vehicle whose brakes began to build up before the alert"):
        shield.begin(braking, np.arange(1))


def test_interior__takes_no_script_that_it_cannot_enclose() -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "e_v2x_bm:pairwise"}
    gentle = PAPER.replace(early_impacts="keep", roles=roles)
    with refused(
        "vehicle_3 follows the script 'e_v2x_bm:pairwise'; the script must be full_brake, coast or constant:A"
    ):
        RobustShield(gentle, 1, uncertainty=parse_uncertainty("gaps_m.pair_1=0.1"), robust="interior")


def test_interior__takes_no_command_beyond_the_least_capacity() -> None:
    weak = line(3).replace(braking_capacity_mps2=[6.0, 6.0, 5.2])  # vehicle_3 holds 5 m/s2, which 4.68 cannot
    shield = RobustShield(weak, 1, uncertainty=parse_uncertainty("braking_capacity_mps2=10%"), robust="interior")
    with refused(
        "uncertainty: braking_capacity_mps2=10%: agent 'constant:5': brakes harder than the braking capacity of 4.68"
    ):
        shield.begin(weak.sample(1, 0).worlds, np.arange(1))


def test_uncertainty__is_for_an_agent_that_certifies_against_it() -> None:
    with refused(
        "uncertainty gaps_m=1: none of the agents uses this setting; agents with +robust use it: ppo@PATH+robust"
    ):
        make_lineup(["coast"], PAPER, uncertainty="gaps_m=1")


SLOW = PAPER.replace(brake_rate_mps3=9)
PIECES = PAPER.replace(roles={"vehicle_1": "profile:0=3,1=5", "vehicle_2": "learner"})
AGENTS: dict[str, Callable[[], object]] = {
    "agent 'ppo+robust': mode robust needs a value of uncertainty": lambda: make_agent("ppo+robust", scenario=PAPER),
    "agent 'e_v2x_bm:estimated': needs a scenario, for instance make_agent('e_v2x_bm:estimated'": lambda: make_agent(
        "e_v2x_bm:estimated"
    ),
    "scenario 'mixture-delays' is a mixture of scenarios": lambda: make_agent(
        "e_v2x_bm:estimated", scenario=eb.load_scenario("mixture-delays")
    ),
    ":estimated: the result would not be exact, because brakes in world 0 build up at a finite rate; leave": lambda: (
        evaluated(make_agent("full_brake+step:estimated", scenario=SLOW), SLOW)
    ),
    ":estimated: a vehicle of world 0 follows a braking profile, for which the result would not be exact;": lambda: (
        evaluated(make_agent("full_brake+step:estimated", scenario=PIECES), PIECES)
    ),
    "shield: robust='interior': vehicle_1 follows the script 'profile:0=3,1=5'; the script must be": lambda: evaluated(
        make_agent("full_brake+robust:interior", scenario=PIECES, uncertainty="latency_s=0.1"), PIECES
    ),
}


def evaluated(agent: Any, scenario: Scenario) -> object:
    return eb.evaluate(scenario.sample(12, 7), {"own": agent}, scenario=scenario)


@pytest.mark.parametrize("message", AGENTS)
def test_agent__is_refused(message: str) -> None:
    with refused(message):
        AGENTS[message]()


def test_team__goes_behind_no_robust_shield(monkeypatch) -> None:
    team = Team.of(make_agent("coast"), [1, 2])
    entry = Entry("team", "team@RUN", "", (), lambda argument, settings: team)
    monkeypatch.setitem(registry.AGENTS.loaded, "team", entry)
    with refused("'team@run+robust': +robust works for one controlled vehicle only, not for a team"):
        make_lineup(["team@run+robust"], PAIR)


def test_evaluation__of_a_robust_shield_needs_an_uncertainty(refuse: Refuse) -> None:
    told = "agent 'ppo+robust': mode robust needs a value of uncertainty"
    refuse("evaluate --agents ppo+robust", told)
