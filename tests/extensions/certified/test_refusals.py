"""Refusals of what guards against the unknown: uncertainties, settings, scenarios, and use out of order."""

from collections.abc import Callable
from typing import Any

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.extensions.certified.options import checked_uncertainty
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import Interval, Uncertainty, parse_uncertainty
from ethbrake_marl.first_edition.agents import registry
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.agents.registry import Entry
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.shields.options import ShieldOptions
from ethbrake_marl.first_edition.shields.wrappers import HybridShield, ShieldedEnv
from tests.first_edition.shield.attacks import begun
from tests.fixtures.commands import Refuse
from tests.fixtures.lines import line as one_line
from tests.refused import refused

PAPER, PAIR = load_scenario("paper-random"), load_scenario("cooperation-3-pair")
PERIODIC = load_scenario("cooperation-2-paper").replace(v2x={"preset": "blocked", "persistence": "periodic"})
WORLD = one_line([10.0, 8.0], [20.0, 18.0, 39.9], [8, 6, 5], [0, 0.4, 0.7], driving=2.0, mass=[1, 2, 4])

TEXTS = {  # an uncertainty as a text -> what is wrong with it, some only in a world
    "": "entry 1 is empty",
    "latency_s": "must be quantity=half-width",
    "latency_s=-0.1": "must be quantity=half-width",
    "latency_s=nan": "must be quantity=half-width",
    "latency_s=1e999": "must be a finite number",
    "latency_s=100%": "must be a share",
    "latency_s.vehicle_0=0.1": "must be quantity=half-width",
    "latency_s.pair_1=0.1": "only gaps_m may name a pair",
    "latency_s=0.1,latency_s.vehicle_2=0.2": "intervals of the same quantity",
    "friction.vehicle_2=0.1": "friction is one number",
    "mass_t.vehicle_4=0.1": "there is no such vehicle",
    "mass_t=1": "must be above 0",
    "gaps_m=1e308": "must be finite",
    "latency_s=0.1,mass_t=0.1,speeds_mps=1,gaps_m=1": "at most 1024",
    "friction=0.1": "no value of friction",
}


@pytest.mark.parametrize("text", TEXTS)
def test_uncertainty__as_a_text_is_refused(text: str) -> None:
    with refused(TEXTS[text]):
        parse_uncertainty(text).members(WORLD)


def evaluated(spec: str, **changes: Any) -> object:
    scenario = PAPER.replace(**changes)
    return eb.evaluate(scenario.sample(2, 7), {"own": make_agent(spec, scenario=scenario)}, scenario=scenario)


REFUSED: dict[str, Callable[[], object]] = {
    "uncertainty: no interval": lambda: Uncertainty(()),
    "must be a tuple of Interval objects": lambda: Uncertainty("gaps_m=0.5"),
    "half-width of gaps_m = True": lambda: Interval("gaps_m", True),
    "gaps_m: place = -1": lambda: Interval("gaps_m", 0.5, place=-1),
    "uncertainty = 0.1: must be an Uncertainty or a text": lambda: checked_uncertainty(0.1),
    "friction=1: the value 0.6 in world 0 may be as low as -0.4": lambda: parse_uncertainty("friction=1").members(
        PAPER.replace(friction=0.6).sample(1, 7).worlds
    ),
    "ppo+robust': mode robust needs a value of uncertainty": lambda: make_agent("ppo+robust", scenario=PAPER),
    "ShieldedEnv: mode robust needs a value of uncertainty": lambda: ShieldedEnv(eb.EthBrakeEnv(), mode="robust"),
    "mode step does not use uncertainty": lambda: ShieldOptions(mode="step", uncertainty="gaps_m=1"),
    "may have at most one search": lambda: make_agent("coast+step:estimated+robust", scenario=PERIODIC),
    "already decides only on received": lambda: make_agent(
        "e_v2x_bm:estimated+episode:estimated", scenario=PERIODIC
    ),
    "estimated = True: not a setting of mode episode": lambda: ShieldOptions(mode="episode", estimated=True),
    "allowance = 1.0: must be 0.0 if estimated": lambda: ShieldOptions(estimated=True, allowance=1.0),
    "uncertainty = 'gaps_m=0.5': must be None if estimated": lambda: ShieldOptions(
        estimated=True, mode="robust", uncertainty="gaps_m=0.5"
    ),
    "estimated = 'yes': must be True or False": lambda: ShieldOptions(estimated="yes"),
    "can control only one learner": lambda: HybridShield(eb.parallel_env(PAIR), mode="step", estimated=True),
    "e_v2x_bm:estimated': needs a scenario": lambda: make_agent("e_v2x_bm:estimated"),
    "is a mixture of scenarios": lambda: make_agent("e_v2x_bm:estimated", scenario="mixture-delays"),
    ":estimated: the result would not be exact, because brakes": lambda: evaluated(
        "full_brake+step:estimated", brake_rate_mps3=9
    ),
    ":estimated: a vehicle of world 0 follows a braking profile": lambda: evaluated(
        "full_brake+step:estimated", roles={"vehicle_1": "profile:0=3,1=5", "vehicle_2": "learner"}
    ),
    "make 16384 combinations (corners)": lambda: make_agent(
        "coast+robust:estimated",
        scenario=PAPER.replace(
            vehicles=4, braking_capacity_mps2={"uniform": [3, 9]}, mass_t={"uniform": [2, 9]}, latency_s=0.1,
            driving_capacity_mps2=3.0, v2x="nominal", roles={"vehicle_2": "learner"},
        ),
    ),
    "may be as late as 1000.5 s": lambda: begun(
        PAPER, PAPER.sample(1, 3).worlds, RobustShield, uncertainty=parse_uncertainty("latency_s=1000")
    ),
    "none of the agents uses this setting; agents with +robust use it": lambda: make_lineup(
        ["coast"], PAPER, uncertainty="gaps_m=1"
    ),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_use__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


NAMES: dict[str, Callable[[], object]] = {
    "'latencys'; did you mean 'latency_s'?": lambda: parse_uncertainty("latencys=0.1"),
    "'robus'; did you mean 'robust'?": lambda: ShieldOptions(mode="robus"),
    "'believed'; it is now called 'estimated'": lambda: make_agent("e_v2x_bm:believed", scenario=PERIODIC),
    "'step:pairwise:estimated'; did you mean": lambda: make_agent("coast+step:pairwise:estimated", scenario=PERIODIC),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


def test_team__goes_behind_no_robust_shield(monkeypatch) -> None:
    team = Team.of(make_agent("coast"), [1, 2])
    entry = Entry("team", "team@RUN", "", (), lambda argument, settings: team)
    monkeypatch.setitem(registry.AGENTS.loaded, "team", entry)
    with refused("+robust works for one controlled vehicle only"):
        make_lineup(["team@run+robust"], PAIR)


def test_evaluation__of_a_robust_shield_needs_an_uncertainty(refuse: Refuse) -> None:
    refuse("evaluate --agents ppo+robust", "agent 'ppo+robust': mode robust needs a value of uncertainty")
