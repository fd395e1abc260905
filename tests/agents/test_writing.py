"""Worlds belong to everybody: an agent of the user that writes into what it is given is refused; nothing is lost."""

from __future__ import annotations

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import worlds_sha256
from ethbrake_marl.physics.worlds import read_only
from ethbrake_marl.shield import HybridAgent, ShieldedDriver


class _Writes:
    """Writes into what it is given, when an episode begins or at each decision."""

    knows = "own sensors"

    def __init__(self, when: str, *, state_free: bool) -> None:
        self.name, self.when, self.state_free = "kmh", when, state_free

    def begin(self, worlds, vehicle, rows):
        if self.when == "begin":
            worlds.gaps_m[:] = 1000.0
        if self.when == "rows":
            rows[:] = 0

    def act(self, worlds, vehicle):
        if self.when == "act":
            speeds = worlds.speeds_mps
            speeds *= 3.6  # a beginner's slip: km/h, in place
        if self.when == "vehicles":
            worlds.vehicles.mass_t[:] = 1.0
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle]


SCENARIO = eb.load_scenario("paper-random")
WRAPPED = {
    "alone": lambda agent: agent,
    "episode": lambda agent: HybridAgent(agent, SCENARIO),
    "step": lambda agent: ShieldedDriver(agent, SCENARIO),
}


@pytest.mark.parametrize("around", WRAPPED)
@pytest.mark.parametrize("state_free", [True, False])
@pytest.mark.parametrize("when", ["begin", "act", "vehicles"])
def test_agent_that_writes_into_worlds__is_refused_by_name(around: str, when: str, state_free: bool) -> None:
    sample = SCENARIO.sample(20, 3)
    before = worlds_sha256(sample.worlds, sample.index)
    agent = WRAPPED[around](_Writes(when, state_free=state_free))
    with pytest.raises(InvalidInput, match=r"agent 'kmh' of vehicle_2: (begin|act) on .*read-only"):
        evaluate(sample, {"full_brake": make_agent("full_brake"), "kmh": agent}, scenario=SCENARIO)
    assert worlds_sha256(sample.worlds, sample.index) == before


def test_agent_that_writes_into_rows__writes_into_its_own() -> None:
    sample = SCENARIO.sample(20, 3)
    agents = {"full_brake": make_agent("full_brake"), "kmh": _Writes("rows", state_free=False)}
    result = evaluate(sample, agents, scenario=SCENARIO)
    full, kmh = (result.outcomes[name].ledger.world_harm("first") for name in agents)
    assert np.array_equal(full, kmh)


def test_read_only__same_values_and_the_given_ones_stay_writable() -> None:
    worlds = SCENARIO.sample(5, 3).worlds
    seen = read_only(worlds)
    assert worlds_sha256(seen, np.arange(5)) == worlds_sha256(worlds, np.arange(5))
    assert worlds.gaps_m.flags.writeable and not seen.gaps_m.flags.writeable
    assert np.shares_memory(worlds.gaps_m, seen.gaps_m)
    with pytest.raises(ValueError, match="read-only"):
        seen.vehicles.latency_s[0] = 0.0
