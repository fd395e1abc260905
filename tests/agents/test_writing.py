"""Worlds belong to everybody: an agent of the user that writes into what it is given is refused; nothing is lost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import worlds_sha256
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.shield import HybridAgent, ShieldedDriver


class _Writes:
    """Writes into what it is given, when an episode begins or at each decision."""

    knows = "own sensors"

    def __init__(self, when: str, *, state_free: bool) -> None:
        self.name, self.when, self.state_free = "kmh", when, state_free

    def begin(self, alert, vehicle, scripts):
        if self.when == "begin":
            alert.gaps_m[:] = 1000.0
        return np.zeros(alert.n)

    def act(self, worlds, memory, vehicle):
        memory += 1.0  # in its own copy
        if self.when == "attribute":
            self.name = "other"
        if self.when == "act":
            speeds = worlds.speeds_mps
            speeds *= 3.6  # a beginner's slip: km/h, in place
        if self.when == "vehicles":
            worlds.vehicles.mass_t[:] = 1.0
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle], memory


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


@pytest.mark.parametrize("around", WRAPPED)
@pytest.mark.parametrize("state_free", [True, False])
def test_agent_that_keeps_something_in_itself__is_refused_by_name(around: str, state_free: bool) -> None:
    agent = WRAPPED[around](_Writes("attribute", state_free=state_free))
    told = r"of vehicle_2: keeps something in its attribute 'name'; one that remembers has begin\(alert, "
    with pytest.raises(InvalidInput, match=told):
        evaluate(SCENARIO.sample(3, 3), {"kmh": agent}, scenario=SCENARIO)


@pytest.mark.parametrize(
    ("begun", "kept", "told"),
    [
        (lambda n: None, lambda m, n: np.zeros(n), "another form"),  # rows that begin anew would keep the old one
        (lambda n: {"a": np.zeros(n)}, lambda m, n: m | {"b": np.zeros(n)}, "another form"),
        (lambda n: np.zeros(n), lambda m, n: np.zeros(n, np.int64), "another form.*int64.*float64"),
        (lambda n: np.zeros((n, 1)), lambda m, n: np.zeros((n, 2)), "another form"),
        (lambda n: {"a": (np.zeros(n), {"b.c": np.zeros(n)})}, lambda m, n: m, "key 'b.c'; must be a name"),
        (lambda n: {0: np.zeros(n)}, lambda m, n: m, "key 0; must be a name"),
        (lambda n: np.array([[]] * n + [[1]], object)[:n], lambda m, n: m, "an array of objects"),
    ],
)
def test_memory_of_another_form__is_refused_by_name(begun: Any, kept: Any, told: str) -> None:
    class Remembers:
        name = "mine"

        def begin(self, alert: Worlds, vehicle: int, scripts: object) -> Any:
            return begun(alert.n)

        def act(self, worlds: Worlds, memory: Any, vehicle: int) -> tuple[Floats, Any]:
            return np.zeros(worlds.n), kept(memory, worlds.n)

    with pytest.raises(InvalidInput, match=f"agent 'mine' of vehicle_2.*{told}"):
        evaluate(SCENARIO.sample(3, 3), {"mine": Remembers()}, scenario=SCENARIO)


def test_agent_that_makes_an_attribute__is_refused_by_name() -> None:
    class Plans:
        name = "mine"

        def begin(self, alert: Worlds, vehicle: int, scripts: object) -> None:
            self.plan = alert.speeds_mps[:, 0]

        def act(self, worlds: Worlds, memory: None, vehicle: int) -> tuple[Floats, None]:
            return np.zeros(worlds.n), None

    with pytest.raises(InvalidInput, match="keeps something in its attribute 'plan'"):
        evaluate(SCENARIO.sample(3, 3), {"mine": Plans()}, scenario=SCENARIO)


def test_agent_that_writes_into_its_memory__writes_into_its_own() -> None:
    sample = SCENARIO.sample(20, 3)
    agents = {"full_brake": make_agent("full_brake"), "kmh": _Writes("memory", state_free=False)}
    result = evaluate(sample, agents, scenario=SCENARIO)
    full, kmh = (result.outcomes[name].ledger.world_harm("first") for name in agents)
    assert np.array_equal(full, kmh)


def test_read_only__same_values_and_the_given_ones_stay_writable() -> None:
    worlds = SCENARIO.sample(5, 3).worlds
    seen = worlds.read_only()
    assert worlds_sha256(seen, np.arange(5)) == worlds_sha256(worlds, np.arange(5))
    assert worlds.gaps_m.flags.writeable and not seen.gaps_m.flags.writeable
    assert np.shares_memory(worlds.gaps_m, seen.gaps_m)
    with pytest.raises(ValueError, match="read-only"):
        seen.vehicles.latency_s[0] = 0.0
